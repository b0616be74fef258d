//! What the page's script calls: a robot's model on the browser's GPU, or in plain Rust.
#![cfg(target_arch = "wasm32")]

use std::sync::Arc;

use image::RgbaImage;
use wasm_bindgen::prelude::*;
use whereabot::benchmark::{self, Options, Weights};
use whereabot::camera::Camera;
use whereabot::cascade::{Estimate, Locator, Output, Status};
use whereabot::gpu::{AdapterRequest, Device, Precision};
use whereabot::network::Model;

/// The browser's GPU.
#[wasm_bindgen]
pub struct Gpu(Arc<Device>);

#[wasm_bindgen]
impl Gpu {
    /// Opens the adapter that the browser offers.
    pub async fn open() -> Result<Self, JsError> {
        let device = Device::open_async(&AdapterRequest::default()).await?;
        Ok(Self(Arc::new(device)))
    }
}

/// Finds the robot of one model.
#[wasm_bindgen]
pub struct Finder {
    model: Model,
    weights: Weights,
    gpu: Option<Arc<Device>>,
    locator: Locator,
}

#[wasm_bindgen]
impl Finder {
    /// Reads a model file and plans it, on `gpu` or else in plain Rust.
    #[wasm_bindgen(constructor)]
    pub fn new(file: &[u8], name: &str, gpu: Option<Gpu>) -> Result<Self, JsError> {
        let model = Model::from_bytes(file, name)?;
        let gpu = gpu.map(|gpu| gpu.0);
        let locator = match &gpu {
            Some(device) => Locator::on_gpu(Arc::clone(device), &model, Precision::F32)?,
            None => Locator::on_cpu(&model),
        };
        Ok(Self {
            weights: Weights::new(&model, file),
            model,
            gpu,
            locator,
        })
    }

    pub async fn locate(&mut self, pixels: Vec<u8>, width: u32, height: u32, hfov: f64) -> Result<Answer, JsError> {
        let image = RgbaImage::from_raw(width, height, pixels).ok_or_else(|| JsError::new("pixels"))?;
        let camera = Camera::from_hfov(width, height, hfov.to_radians());
        let estimate = self.locator.locate_async(&image, &camera, Output { mask: true, mask_only: false }).await?;
        Ok(Answer {
            status: format!("{:?}", estimate.status),
            mask: estimate.mask.map(|m| m.probability).unwrap_or_default(),
            joints: estimate.joints.iter().flat_map(|j| j.xyz_m).collect(),
        })
    }

    pub async fn benchmark(&self, progress: &js_sys::Function) -> Result<String, JsError> {
        let mut tell = |text: &str| {
            let _ = progress.call1(&JsValue::NULL, &text.into());
        };
        let options = Options { runs: Some(1), ..Options::default() };
        let report = match &self.gpu {
            Some(device) => {
                benchmark::on_gpu_async(device, &self.model, self.weights.clone(), &options, &mut tell).await?
            }
            None => benchmark::on_cpu(&self.model, self.weights.clone(), &options, &mut tell)?,
        };
        Ok(serde_json::to_string_pretty(&report)?)
    }
}

#[wasm_bindgen(getter_with_clone)]
pub struct Answer {
    pub status: String,
    pub joints: Vec<f64>,
    pub mask: Vec<f32>,
}
