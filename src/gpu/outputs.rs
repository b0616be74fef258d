use super::estimate::{estimate, estimate_size};
use super::step::Step;
use super::tensor::storage_buffer;
use super::{Device, GpuError, Plan, Unrectify};
use crate::camera::Unrectification;

/// What a plan's frames leave on the GPU for a host's own passes: a mask texture an image, and what was
/// found in each.
#[derive(Debug)]
pub struct Outputs {
    masks: Vec<Unrectify>,
    estimate: Step,
    estimates: wgpu::Buffer,
    max_radius: wgpu::Buffer,
}

impl Outputs {
    /// Of `plan`, with masks of the network's size. `min_sure` pixels must surely be robot.
    ///
    /// # Errors
    /// As [`Plan::new`].
    pub fn new(device: &Device, plan: &Plan, min_sure: u32) -> Result<Self, GpuError> {
        let (joints, mask) = (plan.joints(), plan.mask());
        let batch = joints.batch;
        let canonical =
            Unrectification::identity(mask.shape.width as u32, mask.shape.height as u32);
        device.scoped(|| {
            let masks = (0..batch)
                .map(|index| Unrectify::new(device, mask, index, &canonical))
                .collect::<Result<_, _>>()?;
            let size = batch as u64 * estimate_size(joints.shape.channels / 3);
            let estimates = storage_buffer(device, "estimates", size)?;
            let max_radius = storage_buffer(device, "estimate: max_radius", 4 * batch as u64)?;
            let estimate = estimate(
                device,
                joints,
                plan.totals(),
                &max_radius,
                &estimates,
                min_sure,
            )?;
            Ok(Self {
                masks,
                estimate,
                estimates,
                max_radius,
            })
        })
    }

    /// From the queue's next submission on, the lens of image `index` shows nothing farther from its axis
    /// than `max_radius`, at z = 1.
    pub fn set_max_radius(&self, device: &Device, index: usize, max_radius: f32) {
        let bytes = max_radius.to_le_bytes();
        let offset = bytes.len() as u64 * index as u64;
        device
            .queue()
            .write_buffer(&self.max_radius, offset, &bytes);
    }

    /// A mask texture for image `index` as `params` say; `None` where the one that it has is of that size.
    ///
    /// # Errors
    /// An image beyond the adapter's limits, or too little memory.
    pub fn resized_mask(
        &self,
        device: &Device,
        plan: &Plan,
        index: usize,
        params: &Unrectification,
    ) -> Result<Option<Unrectify>, GpuError> {
        let mask = self.masks.get(index);
        if mask.is_none_or(|mask| mask.size() == params.size) {
            return Ok(None);
        }
        device.scoped(|| Unrectify::new(device, plan.mask(), index, params).map(Some))
    }

    /// Makes the mask of image `index` as `params` say, from the queue's next submission on: in the texture that
    /// [`Outputs::resized_mask`] gave for them.
    pub fn set_mask(
        &mut self,
        device: &Device,
        index: usize,
        params: &Unrectification,
        resized: Option<Unrectify>,
    ) {
        if let Some(mask) = self.masks.get_mut(index) {
            match resized {
                Some(resized) => *mask = resized,
                None => mask.write(device, params),
            }
        }
    }

    /// The mask textures, one an image.
    pub fn masks(&self) -> &[Unrectify] {
        &self.masks
    }

    /// What was found: `array<Estimate>`, see [`estimate_wgsl`](super::estimate_wgsl).
    pub fn estimates(&self) -> &wgpu::Buffer {
        &self.estimates
    }

    /// The dispatches behind a frame's.
    pub fn steps(&self) -> impl Iterator<Item = &Step> {
        [&self.estimate]
            .into_iter()
            .chain(self.masks.iter().map(Unrectify::step))
    }

    /// Records what follows the dispatches.
    pub fn copy(&self, encoder: &mut wgpu::CommandEncoder) {
        self.masks.iter().for_each(|mask| mask.copy(encoder));
    }
}
