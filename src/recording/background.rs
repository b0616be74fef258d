//! Background photos: which there are, and views cut from them.

use std::path::{Path, PathBuf};

use image::RgbImage;
use image::imageops::FilterType;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::{HEIGHT, RecordingError, WIDTH};

/// A random view of one photo.
#[derive(Debug, Clone)]
pub struct PhotoView {
    photo: usize,
    /// The shown part: its width as a share of the largest that fits, and where it lies, 0 to 1.
    zoom: f64,
    place: [f64; 2],
    mirrored: bool,
    brightness: f64,
    /// Standard deviation of the blur, pixels; 0 for none.
    blur: f32,
}

impl PhotoView {
    /// Draws a view of any of `photos` photos.
    pub fn any(rng: &mut ChaCha8Rng, photos: usize, may_blur: bool) -> PhotoView {
        let blurred = rng.random_bool(0.3) && may_blur;
        PhotoView {
            photo: rng.random_range(0..photos.max(1)),
            zoom: rng.random_range(0.45..1.0),
            place: [rng.random_range(0.0..1.0), rng.random_range(0.0..1.0)],
            mirrored: rng.random_bool(0.5),
            brightness: rng.random_range(0.6..1.2),
            blur: if blurred { rng.random_range(0.7..4.0) } else { 0.0 },
        }
    }
}

/// The readable photos of a folder.
#[derive(Debug)]
pub struct Backgrounds {
    paths: Vec<PathBuf>,
}

impl Backgrounds {
    /// Finds the JPEG and PNG pictures of a folder, in order of their names. Those that cannot be
    /// decoded are left out with a warning.
    ///
    /// # Errors
    /// The folder cannot be read or holds no readable picture.
    pub fn open(folder: &Path) -> Result<Backgrounds, RecordingError> {
        let mut paths = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(RecordingError::io(folder))? {
            let path = entry.map_err(RecordingError::io(folder))?.path();
            let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
            if matches!(extension.as_deref(), Some("jpg" | "jpeg" | "png")) {
                paths.push(path);
            }
        }
        paths.sort();
        let readable: Vec<bool> = paths
            .par_iter()
            .map(|path| match decode(path) {
                Ok(_) => true,
                Err(error) => {
                    log::warn!("left out a background: {error}");
                    false
                }
            })
            .collect();
        let mut readable = readable.into_iter();
        paths.retain(|_| readable.next().unwrap_or(false));
        if paths.is_empty() {
            return Err(RecordingError::NoBackgrounds { path: folder.to_owned() });
        }
        Ok(Backgrounds { paths })
    }

    /// How many photos there are; at least one.
    pub fn count(&self) -> usize {
        self.paths.len()
    }

    /// Cuts a view: RGBA, `WIDTH` x `HEIGHT`.
    ///
    /// # Errors
    /// The photo can no longer be read.
    pub fn view(&self, view: &PhotoView) -> Result<Vec<u8>, RecordingError> {
        let path = self.paths.get(view.photo).or(self.paths.first());
        let Some(path) = path else {
            return Err(RecordingError::NoBackgrounds { path: PathBuf::new() });
        };
        let photo = decode(path)?;
        let (width, height) = (f64::from(photo.width()), f64::from(photo.height()));
        let aspect = f64::from(WIDTH) / f64::from(HEIGHT);
        let cut_width = view.zoom * width.min(height * aspect);
        let cut_height = cut_width / aspect;
        let x = (width - cut_width) * view.place[0];
        let y = (height - cut_height) * view.place[1];
        let cut = image::imageops::crop_imm(
            &photo,
            x as u32,
            y as u32,
            (cut_width as u32).max(1),
            (cut_height as u32).max(1),
        );
        let mut cut = image::imageops::resize(&cut.to_image(), WIDTH, HEIGHT, FilterType::Triangle);
        if view.blur > 0.0 {
            cut = image::imageops::fast_blur(&cut, view.blur);
        }
        if view.mirrored {
            image::imageops::flip_horizontal_in_place(&mut cut);
        }
        let brighter: Vec<u8> =
            (0..=255u8).map(|c| (f64::from(c) * view.brightness).min(255.0) as u8).collect();
        let bright = |c: u8| brighter.get(usize::from(c)).copied().unwrap_or(c);
        Ok(cut.pixels().flat_map(|p| [bright(p.0[0]), bright(p.0[1]), bright(p.0[2]), 255]).collect())
    }
}

fn decode(path: &Path) -> Result<RgbImage, RecordingError> {
    let picture = image::ImageReader::open(path)
        .and_then(image::ImageReader::with_guessed_format)
        .map_err(RecordingError::io(path))?
        .decode();
    Ok(picture.map_err(|source| RecordingError::Picture { path: path.to_owned(), source })?.into_rgb8())
}
