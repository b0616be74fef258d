use std::sync::{Mutex, PoisonError, mpsc};
use std::time::Duration;

/// Tells whether a host's device is lost without its loss callback, of which there is one only: a device
/// that is lost refuses to map a buffer at once.
pub(super) struct Loss {
    device: wgpu::Device,
    /// Never submitted, never mapped for long. One caller at a time may ask for it.
    buffer: Mutex<wgpu::Buffer>,
}

impl Loss {
    pub fn new(device: &wgpu::Device) -> Self {
        Self {
            device: device.clone(),
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
        if matches!(receiver.try_recv(), Ok(Err(_))) {
            return true;
        }
        if !self.unmap(&buffer) {
            // A submission of the host's, in another thread, is about to map it: that takes no time.
            let _ = receiver.recv_timeout(Duration::from_secs(1));
            self.unmap(&buffer);
        }
        false
    }

    /// Whether it could be unmapped. The host hears nothing of it if not.
    fn unmap(&self, buffer: &wgpu::Buffer) -> bool {
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::Validation);
        buffer.unmap();
        pollster::block_on(scope.pop()).is_none()
    }
}
