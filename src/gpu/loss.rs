use std::sync::{Mutex, PoisonError, mpsc};

/// Tells whether a host's device is lost without its loss callback, of which there is one only: a device
/// that is lost refuses to map a buffer at once.
pub(super) struct Loss {
    /// Never submitted, never mapped for long. One caller at a time may ask for it.
    buffer: Mutex<wgpu::Buffer>,
}

impl Loss {
    pub fn new(device: &wgpu::Device) -> Self {
        Self {
            buffer: Mutex::new(device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("whereabot: is the device lost"),
                size: 4,
                usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })),
        }
    }

    /// Always false in a browser, which answers later: there, frames that never arrive tell.
    pub fn happened(&self) -> bool {
        if cfg!(target_arch = "wasm32") {
            return false;
        }
        let buffer = self.buffer.lock().unwrap_or_else(PoisonError::into_inner);
        let (sender, receiver) = mpsc::channel();
        buffer.map_async(wgpu::MapMode::Read, .., move |result| {
            // Nobody listens to what comes after this call.
            let _ = sender.send(result);
        });
        let refused = matches!(receiver.try_recv(), Ok(Err(_)));
        if !refused {
            buffer.unmap();
        }
        refused
    }
}
