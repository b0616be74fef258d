use std::pin::Pin;
use std::task::{Context, Poll};

use futures_channel::oneshot;

use super::{Device, GpuError};

/// A buffer on its way to the CPU.
#[derive(Debug)]
pub(crate) struct Mapping {
    receiver: oneshot::Receiver<Result<(), wgpu::BufferAsyncError>>,
    arrived: Option<Mapped>,
}

/// How far a [`Mapping`] is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mapped {
    /// On its way, or not submitted yet.
    Pending,
    /// It can be read, and is to be unmapped then.
    Ready,
    /// What was to fill it was dropped before it was submitted.
    Never,
    /// The device will not fill it.
    Failed,
}

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
        let mapping = Self {
            receiver,
            arrived: None,
        };
        (mapping, callback)
    }

    /// How far it is.
    pub fn state(&mut self) -> Mapped {
        if let Some(arrived) = self.arrived {
            return arrived;
        }
        let state = match self.receiver.try_recv() {
            Ok(None) => return Mapped::Pending,
            Ok(Some(result)) => of(Ok(result)),
            Err(canceled) => of(Err(canceled)),
        };
        self.arrived = Some(state);
        state
    }

    /// Ready once it is no longer pending.
    pub fn poll_arrival(&mut self, context: &mut Context<'_>) -> Poll<Mapped> {
        if let Some(arrived) = self.arrived {
            return Poll::Ready(arrived);
        }
        let state = Pin::new(&mut self.receiver).poll(context).map(of);
        if let Poll::Ready(arrived) = state {
            self.arrived = Some(arrived);
        }
        state
    }

    /// Waits for it. Where threads share a device, what `device` waited for may be told by another one.
    ///
    /// # Errors
    /// [`GpuError::Lost`] where it will never be mapped; not in a browser, [`GpuError::Timeout`] after
    /// [`Device::TIMEOUT`].
    pub async fn finish(mut self, device: &Device) -> Result<(), GpuError> {
        #[cfg(not(target_arch = "wasm32"))]
        let arrived = {
            let start = std::time::Instant::now();
            loop {
                match self.state() {
                    Mapped::Pending if start.elapsed() > Device::TIMEOUT => {
                        return Err(GpuError::Timeout(Device::TIMEOUT));
                    }
                    Mapped::Pending => {
                        device.check()?;
                        std::thread::sleep(std::time::Duration::from_micros(50));
                    }
                    arrived => break arrived,
                }
            }
        };
        #[cfg(target_arch = "wasm32")]
        let arrived = std::future::poll_fn(|context| self.poll_arrival(context)).await;
        if arrived == Mapped::Ready {
            return Ok(());
        }
        device.check()?;
        Err(GpuError::Lost("a buffer was not mapped".into()))
    }
}

fn of(result: Result<Result<(), wgpu::BufferAsyncError>, oneshot::Canceled>) -> Mapped {
    match result {
        Ok(Ok(())) => Mapped::Ready,
        Ok(Err(_)) => Mapped::Failed,
        Err(oneshot::Canceled) => Mapped::Never,
    }
}
