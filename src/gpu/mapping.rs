use futures_channel::oneshot;

use super::{Device, GpuError};

/// A buffer on its way to the CPU.
#[derive(Debug)]
pub(crate) struct Mapping(oneshot::Receiver<Result<(), wgpu::BufferAsyncError>>);

impl Mapping {
    /// With what is to be told when the buffer is mapped, or never will be.
    pub fn new() -> (
        Self,
        impl FnOnce(Result<(), wgpu::BufferAsyncError>) + Send + 'static,
    ) {
        let (sender, receiver) = oneshot::channel();
        let callback = move |result| {
            // Whoever waited may be gone.
            let _ = sender.send(result);
        };
        (Self(receiver), callback)
    }

    /// Whether the buffer is mapped by now.
    ///
    /// # Errors
    /// [`GpuError::Lost`] where it never will be.
    pub fn poll(&mut self) -> Result<bool, GpuError> {
        match self.0.try_recv() {
            Ok(None) => Ok(false),
            Ok(Some(Ok(()))) => Ok(true),
            Ok(Some(Err(error))) => Err(GpuError::Lost(error.to_string())),
            Err(oneshot::Canceled) => Err(never()),
        }
    }

    /// Waits for it. Where threads share a device, what `device` waited for may be told by another one.
    ///
    /// # Errors
    /// As [`Self::poll`]; not in a browser, [`GpuError::Timeout`] after [`Device::TIMEOUT`].
    #[cfg(not(target_arch = "wasm32"))]
    pub async fn finish(mut self, device: &Device) -> Result<(), GpuError> {
        let start = std::time::Instant::now();
        while !self.poll()? {
            device.check()?;
            if start.elapsed() > Device::TIMEOUT {
                return Err(GpuError::Timeout(Device::TIMEOUT));
            }
            std::thread::sleep(std::time::Duration::from_micros(50));
        }
        Ok(())
    }

    #[cfg(target_arch = "wasm32")]
    pub async fn finish(self, _device: &Device) -> Result<(), GpuError> {
        match self.0.await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err(GpuError::Lost(error.to_string())),
            Err(oneshot::Canceled) => Err(never()),
        }
    }
}

fn never() -> GpuError {
    GpuError::Lost("a buffer was given up before it was mapped".into())
}
