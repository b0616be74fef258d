use std::sync::Arc;

use wasm_bindgen::prelude::*;
use web_sys::{HtmlCanvasElement, HtmlVideoElement, ImageBitmap};
use whereabot::benchmark::{self, Adapter, Options, Weights};
use whereabot::camera::Camera;
use whereabot::cascade::{HostLocator, HostOptions, MaskSize, Source};
use whereabot::gpu::{AdapterRequest, Device, Precision};
use whereabot::network::Model;
use whereabot::verification;

use crate::screen::Screen;
use crate::{answer, progress};

/// A robot's model on the browser's GPU. Pictures go to a texture, from there through the networks to the
/// canvas, in one submission; only what was found comes back.
#[wasm_bindgen]
pub struct Gpu {
    device: Arc<Device>,
    adapter: String,
    screen: Screen,
    finder: Option<Finder>,
    picture: Option<wgpu::TextureView>,
    frame: u64,
}

struct Finder {
    model: Model,
    weights: Weights,
    locator: HostLocator,
}

#[wasm_bindgen]
impl Gpu {
    /// Opens the adapter that the browser offers, to draw on `canvas`. `adapter` is its name, which a
    /// browser does not tell wgpu, `format` the texture format that it prefers for canvases.
    pub async fn open(
        canvas: HtmlCanvasElement,
        adapter: String,
        format: String,
    ) -> Result<Self, JsError> {
        let device = Device::open_async(&AdapterRequest::default()).await?;
        Ok(Self {
            screen: Screen::new(device.wgpu(), canvas, &format)?,
            device: Arc::new(device),
            adapter,
            finder: None,
            picture: None,
            frame: 0,
        })
    }

    /// Reads and plans a model file; `name` stands for it in errors.
    pub fn load(&mut self, file: &[u8], name: &str) -> Result<(), JsError> {
        let model = Model::from_bytes(file, name)?;
        let options = HostOptions {
            mask: MaskSize::Source,
            ..HostOptions::default()
        };
        self.finder = Some(Finder {
            weights: Weights::new(&model, file),
            locator: HostLocator::new(Arc::clone(&self.device), &model, options)?,
            model,
        });
        Ok(())
    }

    /// Searches `picture`, a video's current frame or a bitmap, taken by a camera with a horizontal field of
    /// view of `hfov` degrees, and draws it with the robot tinted.
    pub async fn locate(
        &mut self,
        picture: JsValue,
        width: u32,
        height: u32,
        hfov: f64,
    ) -> Result<String, JsError> {
        let view = self.take(&picture, width, height)?;
        let camera = Camera::from_hfov(width, height, hfov.to_radians());
        let finder = self.finder.as_mut().ok_or_else(not_loaded)?;
        let locator = &mut finder.locator;
        locator.set_source(0, &Source::new(view.clone(), camera))?;

        let mut encoder = self
            .device
            .wgpu()
            .create_command_encoder(&Default::default());
        locator.encode(&mut encoder)?;
        let mask = locator.mask(0).ok_or_else(not_loaded)?;
        let drawn = self.screen.draw(&mut encoder, &view, mask)?;
        self.frame += 1;
        locator.read_back(&mut encoder, self.frame)?;
        self.device.queue().submit([encoder.finish()]);
        self.device.queue().present(drawn);

        let located = locator.next().await?;
        let estimate = located.and_then(|mut located| located.estimates.pop());
        Ok(answer::to_json(&estimate.ok_or_else(not_loaded)?))
    }

    /// The last picture's mask at the network's size, row by row.
    pub async fn probabilities(&self) -> Result<Vec<f32>, JsError> {
        let finder = self.finder.as_ref().ok_or_else(not_loaded)?;
        let probabilities = finder.locator.probabilities_async().await?;
        probabilities.ok_or_else(|| JsError::new("the last picture was not searched"))
    }

    /// Measures the model, tells `script` what is being measured, and gives the report's JSON.
    pub async fn benchmark(&self, script: js_sys::Function) -> Result<String, JsError> {
        let finder = self.finder.as_ref().ok_or_else(not_loaded)?;
        let (options, weights) = (Options::default(), finder.weights.clone());
        let mut progress = progress(&script);
        let report = benchmark::on_gpu_async(
            &self.device,
            &finder.model,
            weights,
            &options,
            &mut progress,
        );
        let mut report = report.await?;
        report.adapter.name.clone_from(&self.adapter);
        Ok(serde_json::to_string_pretty(&report)?)
    }

    /// Holds the browser's GPU to plain Rust, tells `script` what is being compared, and gives the report's JSON.
    pub async fn verify(&self, script: js_sys::Function) -> Result<String, JsError> {
        let finder = self.finder.as_ref().ok_or_else(not_loaded)?;
        let adapter = Adapter {
            name: self.adapter.clone(),
            ..Adapter::of(&self.device)
        };
        let mut tell = progress(&script);
        let mut tell = |done: usize, all: usize, what: &str| {
            tell(&format!("{} of {all}, {what}", done + 1));
        };
        let report = verification::verify(
            &self.device,
            adapter,
            &finder.model,
            finder.weights.clone(),
            &[Precision::F32, Precision::F16],
            &mut tell,
        );
        Ok(serde_json::to_string_pretty(&report.await)?)
    }

    /// Copies `picture`, which must have the size that the answer is of, to a texture, which is made anew only for
    /// another size.
    fn take(
        &mut self,
        picture: &JsValue,
        width: u32,
        height: u32,
    ) -> Result<wgpu::TextureView, JsError> {
        let source = if let Some(video) = picture.dyn_ref::<HtmlVideoElement>() {
            wgpu::ExternalImageSource::HTMLVideoElement(video.clone())
        } else if let Some(bitmap) = picture.dyn_ref::<ImageBitmap>() {
            wgpu::ExternalImageSource::ImageBitmap(bitmap.clone())
        } else {
            return Err(JsError::new("picture: expected a video or a bitmap"));
        };
        let found = (source.width(), source.height());
        if found != (width, height) {
            // A browser copies no more than there is, and wgpu panics where it refuses.
            let why = format!(
                "picture: expected {width} x {height} pixels, found {} x {}",
                found.0, found.1
            );
            return Err(JsError::new(&why));
        }
        let size = wgpu::Extent3d {
            width,
            height,
            depth_or_array_layers: 1,
        };
        let view = self
            .picture
            .take_if(|view| view.texture().size() == size)
            .unwrap_or_else(|| {
                let texture = self.device.wgpu().create_texture(&wgpu::TextureDescriptor {
                    label: Some("picture"),
                    size,
                    mip_level_count: 1,
                    sample_count: 1,
                    dimension: wgpu::TextureDimension::D2,
                    format: wgpu::TextureFormat::Rgba8Unorm,
                    // A browser renders what it copies.
                    usage: wgpu::TextureUsages::TEXTURE_BINDING
                        | wgpu::TextureUsages::COPY_DST
                        | wgpu::TextureUsages::RENDER_ATTACHMENT,
                    view_formats: &[],
                });
                texture.create_view(&Default::default())
            });
        self.device.queue().copy_external_image_to_texture(
            &wgpu::CopyExternalImageSourceInfo {
                source,
                origin: wgpu::Origin2d::ZERO,
                flip_y: false,
            },
            wgpu::CopyExternalImageDestInfo {
                texture: view.texture(),
                mip_level: 0,
                origin: wgpu::Origin3d::ZERO,
                aspect: wgpu::TextureAspect::All,
                color_space: wgpu::PredefinedColorSpace::Srgb,
                premultiplied_alpha: false,
            },
            size,
        );
        self.picture = Some(view.clone());
        Ok(view)
    }
}

fn not_loaded() -> JsError {
    JsError::new("no model is loaded")
}
