use super::overlay::share_constants;
use super::step::{Step, StepDescriptor, Tensors, Work};
use super::tensor::{Tensor, storage_buffer};
use super::{Device, GpuError};
use crate::camera::{Gaze, Intrinsics};
use crate::network::{Overlay, Zoom};

/// A network's cameras of a batch: turned to the robots and zoomed in on them, on the GPU.
#[derive(Debug, Clone)]
pub struct Gazes {
    buffer: wgpu::Buffer,
    canonical: Intrinsics,
}

impl Gazes {
    /// For `batch` images, each the `canonical` camera until it is turned. Driver errors reach the caller's
    /// [`Device::scoped`].
    ///
    /// # Errors
    /// More images than a buffer holds.
    pub fn new(device: &Device, canonical: Intrinsics, batch: usize) -> Result<Self, GpuError> {
        let size = size_of::<[f32; GAZE]>() as u64;
        let size = size.saturating_mul(batch as u64);
        let buffer = storage_buffer(device, "zoom: cameras", size)?;
        let gazes = Self { buffer, canonical };
        gazes.write(device, &vec![Gaze::CANONICAL; batch])?;
        Ok(gazes)
    }

    /// Turns them to `each`, from the queue's next submission on.
    ///
    /// # Errors
    /// Another number than there are images.
    pub fn write(&self, device: &Device, each: &[Gaze]) -> Result<(), GpuError> {
        let values: Vec<f32> = each.iter().flat_map(laid_out).collect();
        let bytes: &[u8] = bytemuck::cast_slice(&values);
        if bytes.len() as u64 != self.buffer.size() {
            return Err(GpuError::Size {
                what: "zoom: cameras",
                expected: self.buffer.size() as usize / size_of::<[f32; GAZE]>(),
                found: each.len(),
            });
        }
        device.queue().write_buffer(&self.buffer, 0, bytes);
        Ok(())
    }

    /// For a kernel that sees through them.
    pub(super) fn binding(&self) -> wgpu::BindingResource<'_> {
        self.buffer.as_entire_binding()
    }

    /// Turns them to what the overlay's `rule` shows by each `mask` `[1, height, width]` (`shaders/zoom.wgsl`).
    ///
    /// # Errors
    /// More images than a dispatch holds. Driver errors reach the caller's [`Device::scoped`].
    pub fn zoom(
        &self,
        device: &Device,
        mask: &Tensor,
        zoom: Zoom,
        rule: Overlay,
    ) -> Result<Step, GpuError> {
        let [low, high] = share_constants(rule);
        self.step(
            device,
            (
                "zoom",
                concat!(
                    include_str!("../../shaders/overlay_share.wgsl"),
                    include_str!("../../shaders/zoom.wgsl")
                ),
            ),
            Tensors::from(mask),
            &[
                low,
                high,
                ("SPREAD", f64::from(zoom.spread)),
                ("LEAST", f64::from(zoom.least)),
                ("MOST", f64::from(zoom.most)),
            ],
            mask.batch,
        )
    }

    /// The canonical camera's mask (`shaders/zoom_mask.wgsl`): `closer`, what they see of it, as far as they see, and
    /// `coarse` beyond; all `[1, height, width]`.
    ///
    /// # Errors
    /// More pixels than a dispatch holds. Driver errors reach the caller's [`Device::scoped`].
    pub fn zoom_mask(
        &self,
        device: &Device,
        closer: &Tensor,
        coarse: &Tensor,
        output: &Tensor,
    ) -> Result<Step, GpuError> {
        self.step(
            device,
            ("zoom_mask", include_str!("../../shaders/zoom_mask.wgsl")),
            Tensors::both_to(closer, coarse, output),
            &[],
            output.texels().div_ceil(64),
        )
    }

    /// The joint network's input (`shaders/zoom_overlay.wgsl`): what they see of `image` `[3, height, width]`
    /// masked by `mask` `[1, height, width]`.
    ///
    /// # Errors
    /// More pixels than a dispatch holds. Driver errors reach the caller's [`Device::scoped`].
    pub fn zoom_overlay(
        &self,
        device: &Device,
        image: &Tensor,
        mask: &Tensor,
        output: &Tensor,
        rule: Overlay,
    ) -> Result<Step, GpuError> {
        self.step(
            device,
            (
                "zoom_overlay",
                concat!(
                    include_str!("../../shaders/overlay_share.wgsl"),
                    include_str!("../../shaders/zoom_overlay.wgsl")
                ),
            ),
            Tensors::both_to(image, mask, output),
            &share_constants(rule),
            output.texels().div_ceil(64),
        )
    }

    /// The joints in the canonical camera's frame (`shaders/zoom_joints.wgsl`): from `seen` `[3 joints, 1, 1]`, as
    /// the network sees them, to `output` of the same shape.
    ///
    /// # Errors
    /// More joints than a dispatch holds. Driver errors reach the caller's [`Device::scoped`].
    pub fn zoom_joints(
        &self,
        device: &Device,
        seen: &Tensor,
        output: &Tensor,
    ) -> Result<Step, GpuError> {
        self.step(
            device,
            (
                "zoom_joints",
                include_str!("../../shaders/zoom_joints.wgsl"),
            ),
            Tensors::from_to(seen, output),
            &[("JOINTS", (seen.shape.channels / 3) as f64)],
            output.texels().div_ceil(64),
        )
    }

    fn step(
        &self,
        device: &Device,
        (kernel, source): (&'static str, &str),
        tensors: Tensors<'_>,
        constants: &[(&str, f64)],
        workgroups: usize,
    ) -> Result<Step, GpuError> {
        let camera = concat!(
            include_str!("../../shaders/gaze.wgsl"),
            include_str!("../../shaders/zoom_camera.wgsl")
        );
        let Intrinsics { fx, fy, cx, cy } = self.canonical;
        let mut all = vec![("FX", fx), ("FY", fy), ("CX", cx), ("CY", cy)];
        all.extend(constants);
        let work = Work::new(tensors, 0, 0);
        Step::new(
            device,
            &StepDescriptor {
                label: kernel,
                kernel,
                source: &format!("{camera}{source}"),
                entry_point: "main",
                tensors,
                constants: &all,
                sizes: &[],
                bindings: &[(3, self.binding())],
                workgroups,
                work: Work {
                    bytes: work.bytes + self.buffer.size(),
                    ..work
                },
            },
        )
    }
}

/// Numbers of a camera, as `shaders/gaze.wgsl` lays it out.
const GAZE: usize = 12;

fn laid_out(gaze: &Gaze) -> [f32; GAZE] {
    let [right, down, ahead] = gaze.rotation;
    let rows = [(right, gaze.zoom), (down, 0.0), (ahead, 0.0)];
    let mut values = [0.0; GAZE];
    for (place, ([x, y, z], w)) in values.as_chunks_mut().0.iter_mut().zip(rows) {
        *place = [x, y, z, w];
    }
    values
}
