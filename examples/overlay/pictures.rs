//! What a camera would give: the frames of a video, or the pictures of a recording or of any folder.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use image::RgbaImage;
use whereabot::camera::{Camera, Distortion};
use whereabot::recording::{Reader, Sample};

use crate::video::Video;

/// How long a picture of a folder stays.
const PACE: Duration = Duration::from_millis(700);

/// They go on for ever: behind the last comes the first.
pub enum Pictures {
    Files(Files),
    Video { video: Video, camera: Camera },
}

pub struct Files {
    all: Vec<(PathBuf, Camera)>,
    next: usize,
    due: Instant,
}

impl Pictures {
    /// A recording's, each seen by its own camera; a folder's or a video's, seen by that of the
    /// `camera_info.yaml` beside them, or by a phone's main camera.
    pub fn open(path: &Path) -> Result<Self, Box<dyn Error>> {
        if path.is_file() {
            let video = Video::open(path)?;
            let [width, height] = video.size();
            let camera = camera(path.parent().unwrap_or(path), width, height)?;
            return Ok(Self::Video { video, camera });
        }
        let mut all = if path.join("recording.json").exists() {
            of_recording(path)?
        } else {
            of_folder(path)?
        };
        if all.is_empty() {
            return Err(format!("{}: no images", path.display()).into());
        }
        all.sort_by(|a, b| a.0.cmp(&b.0));
        let due = Instant::now();
        Ok(Self::Files(Files { all, next: 0, due }))
    }

    /// The size of the first.
    pub fn size(&self) -> [u32; 2] {
        match self {
            Self::Files(files) => [files.all[0].1.width, files.all[0].1.height],
            Self::Video { video, .. } => video.size(),
        }
    }

    /// The file that was shown last.
    pub fn name(&self) -> String {
        let file = match self {
            Self::Files(Files { all, next, .. }) => &all[(next + all.len() - 1) % all.len()].0,
            Self::Video { video, .. } => video.file(),
        };
        let name = file.file_name().unwrap_or_default();
        name.to_string_lossy().into_owned()
    }

    /// The next picture and its camera; `None` until it is time for one.
    pub fn next(&mut self) -> Result<Option<(RgbaImage, Camera)>, Box<dyn Error>> {
        match self {
            Self::Files(files) if Instant::now() < files.due => Ok(None),
            Self::Files(files) => {
                let (file, camera) = &files.all[files.next];
                files.next = (files.next + 1) % files.all.len();
                files.due = Instant::now() + PACE;
                let picture =
                    image::open(file).map_err(|error| format!("{}: {error}", file.display()))?;
                Ok(Some((picture.to_rgba8(), *camera)))
            }
            Self::Video { video, camera } => Ok(video.next()?.map(|frame| (frame, *camera))),
        }
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
    let entries =
        std::fs::read_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut all = Vec::new();
    for entry in entries {
        let file = entry?.path();
        if image::ImageFormat::from_path(&file).is_ok() {
            let (width, height) = image::image_dimensions(&file)?;
            all.push((file, camera(folder, width, height)?));
        }
    }
    Ok(all)
}

fn camera(folder: &Path, width: u32, height: u32) -> Result<Camera, Box<dyn Error>> {
    let calibration = folder.join("camera_info.yaml");
    if !calibration.exists() {
        return Ok(Camera::assumed(width, height));
    }
    Ok(Camera::load(calibration)?.for_image(width, height)?)
}
