//! What a camera would give: the pictures of a recording, or of any folder, one after the other.

use std::error::Error;
use std::path::{Path, PathBuf};

use image::RgbaImage;
use whereabot::camera::{Camera, Distortion};
use whereabot::recording::{Reader, Sample};

pub struct Pictures {
    all: Vec<(PathBuf, Camera)>,
    next: usize,
}

impl Pictures {
    /// A recording's, each seen by its own camera; or a folder's, seen by that of its `camera_info.yaml`,
    /// or by a phone's main camera.
    pub fn open(folder: &Path) -> Result<Self, Box<dyn Error>> {
        let mut all = if folder.join("recording.json").exists() {
            of_recording(folder)?
        } else {
            of_folder(folder)?
        };
        if all.is_empty() {
            return Err(format!("{}: no images", folder.display()).into());
        }
        all.sort_by(|a, b| a.0.cmp(&b.0));
        Ok(Self { all, next: 0 })
    }

    /// The size of the first.
    pub fn size(&self) -> [u32; 2] {
        let camera = self.all[0].1;
        [camera.width, camera.height]
    }

    /// The file that was shown last.
    pub fn name(&self) -> String {
        let last = (self.next + self.all.len() - 1) % self.all.len();
        let name = self.all[last].0.file_name().unwrap_or_default();
        name.to_string_lossy().into_owned()
    }

    /// The next picture and its camera; the first again behind the last.
    pub fn next(&mut self) -> Result<(RgbaImage, Camera), Box<dyn Error>> {
        let (file, camera) = &self.all[self.next];
        self.next = (self.next + 1) % self.all.len();
        let picture = image::open(file).map_err(|error| format!("{}: {error}", file.display()))?;
        Ok((picture.to_rgba8(), *camera))
    }
}

fn of_recording(folder: &Path) -> Result<Vec<(PathBuf, Camera)>, Box<dyn Error>> {
    let reader = Reader::open(folder)?;
    let header = reader.header();
    let camera = |sample: &Sample| Camera {
        width: header.width,
        height: header.height,
        intrinsics: sample.intrinsics,
        distortion: Distortion::None,
    };
    let samples = reader.samples().iter();
    Ok(samples
        .map(|sample| (folder.join(&sample.image), camera(sample)))
        .collect())
}

fn of_folder(folder: &Path) -> Result<Vec<(PathBuf, Camera)>, Box<dyn Error>> {
    let calibration = folder.join("camera_info.yaml");
    let calibrated = if calibration.exists() {
        Some(Camera::load(calibration)?)
    } else {
        None
    };
    let entries =
        std::fs::read_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut all = Vec::new();
    for entry in entries {
        let file = entry?.path();
        if image::ImageFormat::from_path(&file).is_ok() {
            let (width, height) = image::image_dimensions(&file)?;
            let camera = match calibrated {
                Some(camera) => camera.for_image(width, height)?,
                None => Camera::assumed(width, height),
            };
            all.push((file, camera));
        }
    }
    Ok(all)
}
