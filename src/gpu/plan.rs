use image::RgbaImage;

use super::coarse::{Coarse, Merged};
use super::coverage::{Totals, coverage};
use super::kinematic_fit::kinematic_fit;
use super::overlay::overlay;
use super::rectify::{Rectify, Sight};
use super::source::Planes;
use super::step::Step;
use super::tensor::{Tensor, staging_buffer, storage_buffer};
use super::zoom::Gazes;
use super::{Device, GpuError, NetworkPlan, Precision};
use crate::camera::Rectification;
use crate::network::{Coverage, Model, Shape};

/// The whole cascade planned for a batch of images: rectify, coarse network, mask network, overlay, joint network,
/// coverage. Everything is allocated, compiled and bound once; a frame is one submission and one
/// small readback.
#[derive(Debug)]
pub struct Plan {
    /// What sees the pictures: the canonical cameras and, behind a coarse network, the mask network's.
    sights: Vec<Sight>,
    /// Of the canonical image.
    shape: Shape,
    rectify: Vec<Rectify>,
    coarse: Option<Coarse>,
    mask: NetworkPlan,
    merged: Option<Merged>,
    coverage: Step,
    totals: wgpu::Buffer,
    /// How many frames ran to their end: a `u32`.
    runs: wgpu::Buffer,
    /// What it was in the newest frame whose results were read.
    last_run: u32,
    /// From the mask to the joint network's input.
    overlay: Vec<Step>,
    joint: NetworkPlan,
    /// From what the joint network says to the joints.
    behind: Vec<Behind>,
    results: wgpu::Buffer,
    masks: wgpu::Buffer,
}

/// A step behind the joint network: its joints in the canonical camera's frame, where it looks through a camera of its own, or
/// where an arm can have them.
#[derive(Debug)]
struct Behind {
    step: Step,
    joints: Tensor,
}

/// What the networks made of one image.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The mask's extent, in pixels of the network's image.
    pub coverage: Coverage,
    /// `x, y, z` a joint, in metres, in the canonical camera's frame. Empty where only the mask was asked for.
    pub joints: Vec<f32>,
    /// The mask `[row][column]`, in [0, 1]. Empty unless asked for.
    pub mask: Vec<f32>,
}

impl Plan {
    /// Plans `model` for `batch` images a frame, with activations in `precision`.
    ///
    /// # Errors
    /// A batch of none, a layer that exceeds the adapter's limits, or a driver's refusal.
    pub fn new(
        device: &Device,
        model: &Model,
        batch: usize,
        precision: Precision,
    ) -> Result<Self, GpuError> {
        Self::with_progress(device, model, batch, precision, &mut |_, _| {})
    }

    /// As [`Plan::new`], telling `progress` how many layers of how many are planned.
    pub(crate) fn with_progress(
        device: &Device,
        model: &Model,
        batch: usize,
        precision: Precision,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Self, GpuError> {
        if batch == 0 {
            return Err(GpuError::Zero { what: "batch" });
        }
        let networks = model.networks();
        let layers = networks.map(|(_, network)| network.nodes().len()).sum();
        let mut done = 0;
        let mut planned = || {
            done += 1;
            progress(done, layers);
        };
        let description = &model.description;
        let layout = device.layout(precision)?;
        device.scoped(|| {
            let input = |what, network| NetworkPlan::input(device, layout, what, network, batch);
            let camera = description.camera;
            let canonical = Gazes::new(device, camera, batch)?;
            let seen = input("image", &model.mask_network)?;
            let (image, coarse) = match model.coarse() {
                None => (seen.clone(), None),
                Some(network) => {
                    let image = input("coarse image", network.0)?;
                    let coarse = Coarse::new(device, network, &image, camera, &mut planned)?;
                    (image, Some(coarse))
                }
            };
            let sight = |label, gazes: &Gazes, image: &Tensor| Sight {
                label,
                gazes: gazes.clone(),
                image: image.clone(),
            };
            let mut sights = vec![sight("rectify", &canonical, &image)];
            sights.extend(
                coarse
                    .as_ref()
                    .map(|c| sight("coarse.rectify", c.gazes(), &seen)),
            );
            let rectify = (0..batch).map(|_| Rectify::new(device)).collect();
            let mask = NetworkPlan::planned(
                device,
                "mask",
                &model.mask_network,
                &seen,
                None,
                &mut planned,
            )?;
            let merged = coarse.as_ref().map(|c| c.merge(device, mask.output()));
            let merged = merged.transpose()?;
            let masked = input("overlay", &model.joint_network)?;
            let joint = NetworkPlan::planned(
                device,
                "joint",
                &model.joint_network,
                &masked,
                None,
                &mut planned,
            )?;
            let totals = storage_buffer(
                device,
                "coverage: totals",
                (batch * size_of::<Totals>()) as u64,
            )?;
            let output = mask_of(&mask, merged.as_ref());
            let presence = description.presence;
            let thresholds = (presence.mask_threshold, presence.sure_threshold);
            let runs = storage_buffer(device, "coverage: runs", size_of::<u32>() as u64)?;
            let coverage = coverage(device, output, &totals, &runs, thresholds)?;
            let rule = description.overlay;
            let seen = joint.output();
            let joints = || Tensor::in_layout(device, layout, "joints", seen.shape, batch, 0);
            let mut behind: Vec<Behind> = Vec::new();
            let overlay = match description.zoom {
                None => vec![overlay(device, &image, output, &masked, rule)?],
                Some(zoom) => {
                    let gazes = Gazes::new(device, camera, batch)?;
                    let joints = joints()?;
                    let step = gazes.zoom_joints(device, seen, &joints)?;
                    behind.push(Behind { step, joints });
                    vec![
                        gazes.zoom(device, output, zoom, rule)?,
                        gazes.zoom_overlay(device, &image, output, &masked, rule)?,
                    ]
                }
            };
            if let Some(arm) = &description.arm {
                let joints = joints()?;
                let before = behind.last().map_or(seen, |step| &step.joints);
                let step = kinematic_fit(device, before, &joints, arm)?;
                behind.push(Behind { step, joints });
            }
            let results = joint.output().staging_size() + totals.size() + runs.size();
            let results = staging_buffer(device, results);
            let masks = staging_buffer(device, output.staging_size());
            Ok(Self {
                sights,
                shape: image.shape,
                rectify,
                coverage,
                totals,
                runs,
                last_run: 0,
                overlay,
                results,
                masks,
                coarse,
                mask,
                merged,
                joint,
                behind,
            })
        })
    }

    /// Gives image `index` of the next frame: `source`, and how it becomes the canonical image.
    ///
    /// # Errors
    /// An `index` beyond the batch, an image beyond the adapter's limits, too little memory.
    pub fn write(
        &mut self,
        device: &Device,
        index: usize,
        source: &RgbaImage,
        rectification: &Rectification,
    ) -> Result<(), GpuError> {
        let (slot, params) = slot(&mut self.rectify, index, rectification)?;
        slot.write(device, &self.sights, source, &params)
    }

    /// Gives image `index` of the frames from the next one on: `planes`, and how they become the canonical
    /// image.
    ///
    /// # Errors
    /// An `index` beyond the batch, planes that cannot be read.
    pub fn bind(
        &mut self,
        device: &Device,
        index: usize,
        planes: &Planes,
        rectification: &Rectification,
    ) -> Result<(), GpuError> {
        let (slot, params) = slot(&mut self.rectify, index, rectification)?;
        slot.bind(device, &self.sights, planes, &params)
    }

    /// Writes `image` to be image `index` of the next submission, of [`Self::steps_of`] this `source` and others; and
    /// how it becomes the canonical image. For those who have more sources than images a frame.
    ///
    /// # Errors
    /// An image beyond the adapter's limits, too little memory.
    #[cfg(not(target_arch = "wasm32"))]
    pub(crate) fn write_source(
        &self,
        device: &Device,
        source: &mut Rectify,
        index: usize,
        image: &RgbaImage,
        rectification: &Rectification,
    ) -> Result<(), GpuError> {
        let params = Rectification {
            index: index as u32,
            ..*rectification
        };
        source.write(device, &self.sights, image, &params)
    }

    /// Images a frame.
    #[cfg(not(target_arch = "wasm32"))]
    pub(crate) fn batch(&self) -> usize {
        self.rectify.len()
    }

    /// The robot's mask: probabilities `[1, height, width]`.
    pub fn mask(&self) -> &Tensor {
        mask_of(&self.mask, self.merged.as_ref())
    }

    /// The joints in the canonical camera's frame: `[3 joints, 1, 1]`.
    pub(super) fn joints(&self) -> &Tensor {
        let joints = self.behind.last().map(|step| &step.joints);
        joints.unwrap_or_else(|| self.joint.output())
    }

    /// What there is to see in the masks: one [`Totals`] an image.
    pub(super) fn totals(&self) -> &wgpu::Buffer {
        &self.totals
    }

    /// The dispatches from the pictures of `sources` to masks.
    fn mask_steps<'a>(
        &'a self,
        sources: impl Iterator<Item = &'a Rectify> + Clone,
    ) -> impl Iterator<Item = &'a Step> {
        let sight = |index| {
            let steps = sources.clone();
            steps.filter_map(move |source| source.steps().get(index))
        };
        let coarse = self.coarse.iter().flat_map(Coarse::steps);
        let merged = self.merged.iter().map(|merged| &merged.step);
        let closer = sight(1);
        let seen = sight(0).chain(coarse).chain(closer);
        seen.chain(self.mask.steps()).chain(merged)
    }

    /// The dispatches from masks to joints.
    fn joint_steps(&self) -> impl Iterator<Item = &Step> {
        let behind = self.behind.iter().map(|behind| &behind.step);
        self.overlay.iter().chain(self.joint.steps()).chain(behind)
    }

    /// The dispatches of a frame, in order; those of the joint network only `with_joints`. Coverage, which counts the
    /// frames that ran, is the last.
    pub fn steps(&self, with_joints: bool) -> impl Iterator<Item = &Step> {
        self.steps_of(self.rectify.iter(), with_joints)
    }

    /// The same of the pictures of others than its own `sources`, one an image of the batch.
    pub(crate) fn steps_of<'a>(
        &'a self,
        sources: impl Iterator<Item = &'a Rectify> + Clone,
        with_joints: bool,
    ) -> impl Iterator<Item = &'a Step> {
        let joints = if with_joints { usize::MAX } else { 0 };
        self.mask_steps(sources)
            .chain(self.joint_steps().take(joints))
            .chain([&self.coverage])
    }

    /// Runs a frame and waits for it: the result of each image of the batch. The masks are read back
    /// only `with_mask`, the joint network runs only `with_joints`.
    ///
    /// # Errors
    /// As [`Device::wait`].
    #[cfg(not(target_arch = "wasm32"))]
    pub fn run(
        &mut self,
        device: &Device,
        with_joints: bool,
        with_mask: bool,
    ) -> Result<Vec<Frame>, GpuError> {
        pollster::block_on(self.run_async(device, with_joints, with_mask))
    }

    /// As [`Plan::run`]: in a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// Those.
    pub async fn run_async(
        &mut self,
        device: &Device,
        with_joints: bool,
        with_mask: bool,
    ) -> Result<Vec<Frame>, GpuError> {
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        self.encode(&mut encoder, with_joints, with_mask, None);
        device.queue().submit([encoder.finish()]);
        self.read_async(device, with_joints, with_mask).await
    }

    /// Records a frame: one compute pass, which writes `timestamps`, and the copies of its results.
    pub fn encode(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        with_joints: bool,
        with_mask: bool,
        timestamps: Option<wgpu::ComputePassTimestampWrites<'_>>,
    ) {
        self.dispatch(encoder, self.steps(with_joints), timestamps);
        self.copy_results(encoder, &self.results);
        if with_mask {
            self.copy_masks(encoder, &self.masks);
        }
    }

    /// Records `steps`, those of a frame and perhaps some behind them, in one compute pass.
    pub(crate) fn dispatch<'a>(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        steps: impl Iterator<Item = &'a Step>,
        timestamps: Option<wgpu::ComputePassTimestampWrites<'_>>,
    ) {
        encoder.clear_buffer(&self.totals, 0, None);
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
            label: None,
            timestamp_writes: timestamps,
        });
        for step in steps {
            step.encode(&mut pass);
        }
    }

    /// A buffer for [`Self::copy_results`], to be mapped.
    pub(crate) fn results_buffer(&self, device: &Device) -> wgpu::Buffer {
        staging_buffer(device, self.results.size())
    }

    /// Records the copy of a frame's results, for [`Self::frames_in`].
    pub(crate) fn copy_results(&self, encoder: &mut wgpu::CommandEncoder, results: &wgpu::Buffer) {
        let joints = self.joints();
        joints.copy_to(encoder, results, 0);
        let mut at = joints.staging_size();
        for buffer in [&self.totals, &self.runs] {
            encoder.copy_buffer_to_buffer(buffer, 0, results, at, buffer.size());
            at += buffer.size();
        }
    }

    /// A buffer for [`Self::copy_masks`], to be mapped.
    #[cfg(not(target_arch = "wasm32"))]
    pub(crate) fn masks_buffer(&self, device: &Device) -> wgpu::Buffer {
        staging_buffer(device, self.mask().staging_size())
    }

    /// Records the copy of a frame's masks, for [`Self::put_masks`].
    pub(crate) fn copy_masks(&self, encoder: &mut wgpu::CommandEncoder, masks: &wgpu::Buffer) {
        self.mask().copy_to(encoder, masks, 0);
    }

    /// Puts what [`Self::copy_masks`] copied into `frames`.
    pub(crate) fn put_masks(&self, frames: &mut [Frame], bytes: &[u8]) {
        let values = self.mask().values(bytes);
        let plane = self.shape.height * self.shape.width;
        for (frame, mask) in frames.iter_mut().zip(values.chunks_exact(plane)) {
            frame.mask = mask.to_vec();
        }
    }

    /// What [`Self::copy_results`] copied: each image's, without masks. `None` where these are an earlier frame's results, as
    /// the GPU did not run this one: a submission that was refused, or that failed on Metal, maps its buffers all the
    /// same. Frames are to be read in the order of their submissions.
    pub(crate) fn frames_in(&mut self, bytes: &[u8]) -> Option<Vec<Frame>> {
        let shape = self.shape;
        let (width, height) = (shape.width as u32, shape.height as u32);
        let (joints, rest) = bytes.split_at(self.joints().staging_size() as usize);
        let (totals, runs) = rest.split_at(self.totals.size() as usize);
        let runs: u32 = bytemuck::pod_read_unaligned(runs);
        if !(1..1 << 31).contains(&runs.wrapping_sub(self.last_run)) {
            return None;
        }
        self.last_run = runs;
        let frames = totals
            .chunks_exact(size_of::<Totals>())
            .zip(self.joints_in(joints))
            .map(|(totals, joints)| Frame {
                coverage: bytemuck::pod_read_unaligned::<Totals>(totals).coverage(width, height),
                joints,
                mask: Vec::new(),
            });
        Some(frames.collect())
    }

    /// Which run the frame was whose results were read last.
    pub(crate) fn last_run(&self) -> u32 {
        self.last_run
    }

    /// The masks `[image][row][column]` of run `run`; `None` where a later one wrote over them. Submits a copy and waits
    /// for it: in a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// As [`Device::wait`].
    pub(crate) async fn masks_of_async(
        &self,
        device: &Device,
        run: u32,
    ) -> Result<Option<Vec<f32>>, GpuError> {
        let masks = self.mask();
        let (end, size) = (masks.staging_size(), self.runs.size());
        let staging = device.scoped(|| Ok(staging_buffer(device, end + size)))?;
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        masks.copy_to(&mut encoder, &staging, 0);
        encoder.copy_buffer_to_buffer(&self.runs, 0, &staging, end, size);
        device.queue().submit([encoder.finish()]);
        let values = device.read_async(&staging, |bytes| {
            let (bytes, runs) = bytes.split_at(end as usize);
            let is_that = bytemuck::pod_read_unaligned::<u32>(runs) == run;
            is_that.then(|| masks.values(bytes))
        });
        values.await
    }

    /// What is wrong with a device of our own where [`Self::frames_in`] finds nothing.
    pub(crate) fn not_run() -> GpuError {
        GpuError::Lost("a frame that was submitted did not run".into())
    }

    /// Waits for a frame that was submitted as [`Plan::encode`] recorded it: the result of each image.
    /// In a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// As [`Device::wait`].
    pub async fn read_async(
        &mut self,
        device: &Device,
        with_joints: bool,
        with_mask: bool,
    ) -> Result<Vec<Frame>, GpuError> {
        let results = self.results.clone();
        let frames = device.read_async(&results, |bytes| self.frames_in(bytes));
        let mut frames = frames.await?.ok_or_else(Self::not_run)?;
        if !with_joints {
            frames.iter_mut().for_each(|frame| frame.joints.clear());
        }
        if with_mask {
            let masks = device.read_async(&self.masks, |bytes| self.put_masks(&mut frames, bytes));
            masks.await?;
        }
        Ok(frames)
    }

    /// Runs the joint network behind `masks` `[image][row][column]`, in [0, 1], in place of what the
    /// mask network says, and waits for it: the [`Frame::joints`] of each image of the batch.
    ///
    /// # Errors
    /// As [`Device::wait`], and another number of values.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn run_with_masks(
        &mut self,
        device: &Device,
        masks: &[f32],
    ) -> Result<Vec<Vec<f32>>, GpuError> {
        self.mask().write(device, masks)?;
        let mut encoder = device.wgpu().create_command_encoder(&Default::default());
        let sources = self
            .rectify
            .iter()
            .filter_map(|source| source.steps().first());
        let steps = sources.chain(self.joint_steps()).chain([&self.coverage]);
        self.dispatch(&mut encoder, steps, None);
        self.copy_results(&mut encoder, &self.results);
        device.queue().submit([encoder.finish()]);
        let frames = pollster::block_on(self.read_async(device, true, false))?;
        Ok(frames.into_iter().map(|frame| frame.joints).collect())
    }

    /// Each image's joints at the beginning of the results as they were copied.
    fn joints_in(&self, bytes: &[u8]) -> Vec<Vec<f32>> {
        let output = self.joints();
        let values = output.values(bytes);
        values
            .chunks_exact(output.shape.channels)
            .map(<[f32]>::to_vec)
            .collect()
    }
}

fn mask_of<'a>(network: &'a NetworkPlan, merged: Option<&'a Merged>) -> &'a Tensor {
    merged.map_or(network.output(), |merged| &merged.mask)
}

/// Where image `index` of a batch is rectified, and how.
fn slot<'a>(
    slots: &'a mut [Rectify],
    index: usize,
    rectification: &Rectification,
) -> Result<(&'a mut Rectify, Rectification), GpuError> {
    let batch = slots.len();
    let slot = slots.get_mut(index).ok_or(GpuError::Size {
        what: "batch: images",
        expected: batch,
        found: index.saturating_add(1),
    })?;
    let params = Rectification {
        index: index as u32,
        ..*rectification
    };
    Ok((slot, params))
}
