use std::sync::Arc;

use image::RgbaImage;

use super::Estimate;
#[cfg(not(target_arch = "wasm32"))]
use super::Mask;
use super::view::View;
use crate::camera::{Camera, CameraError, Crop, Gaze, Rectification, Texels};
use crate::gpu::{Device, Frame, GpuError, Plan, Precision};
use crate::network::{Description, Model, Shape};
use crate::reference;

/// Finds the robot of one model in images.
///
/// The networks run on a GPU ([`Locator::on_gpu`]) or in plain Rust ([`Locator::on_cpu`]); the
/// answers agree: masks within 1e-4, joints within 0.1 mm.
#[derive(Debug)]
pub struct Locator {
    engine: Engine,
    description: Description,
    /// Of the last image's camera: a camera's images come one after the other.
    view: Option<View>,
}

#[derive(Debug)]
enum Engine {
    Gpu {
        device: Arc<Device>,
        plan: Box<Plan>,
    },
    Cpu {
        model: Box<Model>,
    },
}

/// What to work out besides the robot's presence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Output {
    /// Read the mask back.
    pub mask: bool,
    /// Run the mask network only: there are no joints.
    pub mask_only: bool,
}

/// Why an image could not be searched.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LocateError {
    /// The GPU failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The camera is not that of the image.
    #[error(
        "image: expected the camera's {expected_width} x {expected_height} pixels, found {width} x {height}"
    )]
    Size {
        /// Columns that the camera has.
        expected_width: u32,
        /// Rows that the camera has.
        expected_height: u32,
        /// Columns of the image.
        width: u32,
        /// Rows of the image.
        height: u32,
    },
    /// The camera cannot be one.
    #[error("camera: {0}")]
    Camera(#[from] CameraError),
    /// A mask that is not of the model's size.
    #[error("mask: expected {expected} values, found {found}")]
    Mask {
        /// Pixels of the network's image.
        expected: usize,
        /// Values in the mask.
        found: usize,
    },
    /// A frame without an image.
    #[error("image {index} of the batch has no source: give it one before encoding")]
    NoSource {
        /// Which image of the batch.
        index: usize,
    },
    /// A submission with two images of one camera, which has one texture.
    #[error("images of a submission: expected one a camera, found two of camera {place}")]
    SameCamera {
        /// The camera's place.
        place: usize,
    },
    /// A part of an image that it does not have.
    #[error("crop: expected a part of {width} x {height} texels, found {crop:?}")]
    Crop {
        /// Columns of the source.
        width: u32,
        /// Rows of the source.
        height: u32,
        /// What was asked for.
        crop: Crop,
    },
    /// The networks do not fit together: a defect of this library.
    #[error("{0}: a layer's shape differs from its description")]
    Shape(&'static str),
}

impl Locator {
    /// Plans `model` on `device`: allocates, compiles and binds everything that an image needs, with
    /// activations in `precision`.
    ///
    /// # Errors
    /// A layer that exceeds the adapter's limits, or a driver's refusal.
    pub fn on_gpu(
        device: Arc<Device>,
        model: &Model,
        precision: Precision,
    ) -> Result<Self, LocateError> {
        let plan = Box::new(Plan::new(&device, model, 1, precision)?);
        Ok(Self {
            engine: Engine::Gpu { device, plan },
            description: model.description.clone(),
            view: None,
        })
    }

    /// Runs `model` in plain Rust, on all cores, without a GPU.
    pub fn on_cpu(model: &Model) -> Self {
        Self {
            engine: Engine::Cpu {
                model: Box::new(model.clone()),
            },
            description: model.description.clone(),
            view: None,
        }
    }

    /// The adapter's name; `cpu` for the reference.
    pub fn adapter_name(&self) -> &str {
        match &self.engine {
            Engine::Gpu { device, .. } => &device.info().name,
            Engine::Cpu { .. } => "cpu",
        }
    }

    /// The model's description.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// Searches `image`, taken by `camera`. Its alpha is ignored.
    ///
    /// # Errors
    /// An image of another size than the camera's, or beyond the adapter's limits; a camera that
    /// [`Camera::check`] refuses; a GPU that failed, was lost or does not answer.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn locate(
        &mut self,
        image: &RgbaImage,
        camera: &Camera,
        output: Output,
    ) -> Result<Estimate, LocateError> {
        pollster::block_on(self.locate_async(image, camera, output))
    }

    /// As [`Locator::locate`]: in a browser without blocking, elsewhere blocking all the same.
    ///
    /// # Errors
    /// Those.
    pub async fn locate_async(
        &mut self,
        image: &RgbaImage,
        camera: &Camera,
        output: Output,
    ) -> Result<Estimate, LocateError> {
        let view = self.view(image, camera)?;
        let rectification = view.rectification;
        let frame = match &mut self.engine {
            Engine::Gpu { device, plan } => {
                plan.write(device, 0, image, &rectification)?;
                plan.run_async(device, !output.mask_only, output.mask)
                    .await?
                    .pop()
                    .ok_or(LocateError::Shape("batch"))?
            }
            Engine::Cpu { model } => run_reference(model, image, &rectification, output)?,
        };
        Ok(Estimate::new(&self.description, frame, &view, output))
    }

    /// Where the joint network, and the kinematic fit where the model has an arm, put the joints of the robot that
    /// `mask` shows in `image`: what they make of a better mask than the mask network's, or of a mask in which too
    /// little is sure. As they say so, also where that cannot be: in the model's order, camera optical frame, metres.
    ///
    /// # Errors
    /// As [`Locator::locate`], and a mask of another size than the model's.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn joints_with_mask(
        &mut self,
        image: &RgbaImage,
        camera: &Camera,
        mask: &Mask,
    ) -> Result<Vec<[f64; 3]>, LocateError> {
        let rectification = self.view(image, camera)?.rectification;
        let input = self.description.input;
        let (expected, found) = (
            input.width as usize * input.height as usize,
            mask.probability.len(),
        );
        if expected != found {
            return Err(LocateError::Mask { expected, found });
        }
        let values = match &mut self.engine {
            Engine::Gpu { device, plan } => {
                plan.write(device, 0, image, &rectification)?;
                plan.run_with_masks(device, &mask.probability)?
                    .pop()
                    .ok_or(LocateError::Shape("batch"))?
            }
            Engine::Cpu { model } => {
                let shape = model.mask_network.output();
                let image = rectified(image, &rectification, shape, &Gaze::CANONICAL);
                let mask = reference::Tensor::new(shape, mask.probability.clone())
                    .ok_or(LocateError::Shape("mask network"))?;
                reference::joints(model, &image, &mask)
                    .ok_or(LocateError::Shape("joint network"))?
            }
        };
        let joints = values.as_chunks().0.iter();
        Ok(joints.map(|xyz: &[f32; 3]| xyz.map(f64::from)).collect())
    }

    /// What the networks see of `image`, taken by `camera`.
    fn view(&mut self, image: &RgbaImage, camera: &Camera) -> Result<View, LocateError> {
        let size = image.dimensions().into();
        let view = View::of(self.view, camera, size, Texels::PLAIN, &self.description)?;
        self.view = Some(view);
        Ok(view)
    }
}

fn rectified(
    image: &RgbaImage,
    rectification: &Rectification,
    shape: Shape,
    gaze: &Gaze,
) -> reference::Tensor {
    reference::rectify(image, rectification, gaze, shape.height, shape.width)
}

fn run_reference(
    model: &Model,
    image: &RgbaImage,
    rectification: &Rectification,
    output: Output,
) -> Result<Frame, LocateError> {
    let description = &model.description;
    let shape = model.mask_network.input();
    let rectified = |gaze: &Gaze| rectified(image, rectification, shape, gaze);
    let image = rectified(&Gaze::CANONICAL);
    let mask = reference::mask(model, &image, rectified);
    let mask = mask.ok_or(LocateError::Shape("mask network"))?;
    let presence = description.presence;
    let coverage = reference::coverage(&mask, presence.mask_threshold, presence.sure_threshold);
    let joints = if output.mask_only {
        Vec::new()
    } else {
        reference::joints(model, &image, &mask).ok_or(LocateError::Shape("joint network"))?
    };
    Ok(Frame {
        coverage,
        joints,
        mask: if output.mask {
            mask.data().to_vec()
        } else {
            Vec::new()
        },
    })
}
