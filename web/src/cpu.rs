use image::RgbaImage;
use wasm_bindgen::prelude::*;
use whereabot::benchmark::{self, Options, Weights};
use whereabot::camera::Camera;
use whereabot::cascade::{Locator, Output};
use whereabot::draw::mask_image;
use whereabot::network::Model;

use crate::{answer, progress, screen};

/// A robot's model in plain Rust: for browsers without a GPU.
#[wasm_bindgen]
pub struct Cpu {
    model: Model,
    weights: Weights,
    locator: Locator,
    probabilities: Vec<f32>,
}

#[wasm_bindgen]
impl Cpu {
    /// Reads a model file; `name` stands for it in errors.
    #[wasm_bindgen(constructor)]
    pub fn new(file: &[u8], name: &str) -> Result<Self, JsError> {
        let model = Model::from_bytes(file, name)?;
        Ok(Self {
            weights: Weights::new(&model, file),
            locator: Locator::on_cpu(&model),
            model,
            probabilities: Vec::new(),
        })
    }

    /// Searches a picture of RGBA pixels, taken by a camera with a horizontal field of view of `hfov`
    /// degrees, and tints the robot in it.
    pub async fn locate(
        &mut self,
        pixels: Vec<u8>,
        width: u32,
        height: u32,
        hfov: f64,
    ) -> Result<Tinted, JsError> {
        let mut image = RgbaImage::from_raw(width, height, pixels)
            .ok_or_else(|| JsError::new("pixels: expected width x height x 4 bytes"))?;
        let camera = Camera::from_hfov(width, height, hfov.to_radians());
        let output = Output {
            mask: true,
            mask_only: false,
        };
        let mut estimate = self.locator.locate_async(&image, &camera, output).await?;
        if let Some(mask) = estimate.mask.take() {
            let canonical = &self.model.description.camera;
            let tint = mask_image(&mask, canonical, &camera, None);
            for (pixel, share) in image.pixels_mut().zip(tint.pixels()) {
                let strength = screen::STRENGTH * f32::from(share.0[0]) / 255.0;
                for (value, tint) in pixel.0.iter_mut().zip(screen::TINT) {
                    let from = f32::from(*value);
                    *value = (from + (255.0 * tint - from) * strength).round() as u8;
                }
            }
            self.probabilities = mask.probability;
        }
        Ok(Tinted {
            answer: answer::to_json(&estimate),
            pixels: image.into_raw(),
        })
    }

    /// The last picture's mask at the network's size, row by row.
    pub fn probabilities(&self) -> Vec<f32> {
        self.probabilities.clone()
    }

    /// Measures the model, tells `script` what is being measured, and gives the report's JSON.
    pub fn benchmark(&self, script: &js_sys::Function) -> Result<String, JsError> {
        let (options, weights) = (Options::default(), self.weights.clone());
        let report = benchmark::on_cpu(&self.model, weights, &options, &mut progress(script))?;
        Ok(serde_json::to_string_pretty(&report)?)
    }
}

/// What was found, and the picture to show.
#[wasm_bindgen(getter_with_clone)]
pub struct Tinted {
    /// JSON.
    pub answer: String,
    /// RGBA.
    pub pixels: Vec<u8>,
}
