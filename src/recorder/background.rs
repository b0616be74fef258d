//! Background photos: which there are, and views cut from them.

use std::path::{Path, PathBuf};

use image::RgbImage;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::{HEIGHT, RecorderError, WIDTH};
use crate::image_file;

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
            brightness: rng.random_range(0.7..1.25),
            blur: if blurred {
                rng.random_range(0.7..4.0)
            } else {
                0.0
            },
        }
    }
}

/// The readable photos of a folder.
#[derive(Debug)]
pub struct Backgrounds {
    folder: PathBuf,
    paths: Vec<PathBuf>,
}

impl Backgrounds {
    /// Finds the JPEG and PNG pictures of a folder, in order of their names. Those that cannot be
    /// decoded are left out with a warning.
    ///
    /// # Errors
    /// The folder cannot be read or holds no readable picture.
    pub fn open(folder: &Path) -> Result<Backgrounds, RecorderError> {
        let mut paths = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(RecorderError::io(folder))? {
            let path = entry.map_err(RecorderError::io(folder))?.path();
            let extension = path
                .extension()
                .and_then(|e| e.to_str())
                .map(str::to_ascii_lowercase);
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
            return Err(RecorderError::NoBackgrounds {
                path: folder.to_owned(),
            });
        }
        Ok(Backgrounds {
            folder: folder.to_owned(),
            paths,
        })
    }

    /// How many photos there are; at least one.
    pub fn count(&self) -> usize {
        self.paths.len()
    }

    /// Cuts a view: RGBA, `WIDTH` x `HEIGHT`.
    ///
    /// # Errors
    /// The photo can no longer be read, or the view was drawn for more photos than there are.
    pub fn view(&self, view: &PhotoView) -> Result<Vec<u8>, RecorderError> {
        let Some(path) = self.paths.get(view.photo) else {
            return Err(RecorderError::NoBackgrounds {
                path: self.folder.clone(),
            });
        };
        let mut photo = decode(path)?;
        let aspect = f64::from(WIDTH) / f64::from(HEIGHT);
        let cut_width = |photo: &RgbImage| {
            view.zoom * f64::from(photo.width()).min(f64::from(photo.height()) * aspect)
        };
        let shrink = f64::from(WIDTH) / cut_width(&photo);
        if shrink < 0.75 {
            let (width, height) = (f64::from(photo.width()), f64::from(photo.height()));
            let [width, height] = [width, height].map(|edge| (edge * shrink).ceil() as u32);
            photo = image::imageops::thumbnail(&photo, width, height);
        }
        let step = cut_width(&photo) / f64::from(WIDTH);
        let mut cut = resample(&photo, step, view.place, view.mirrored);
        if view.blur > 0.0 {
            cut = image::imageops::fast_blur(&cut, view.blur);
        }
        let brighter: Vec<u8> = (0..=255u8)
            .map(|c| (f64::from(c) * view.brightness).min(255.0) as u8)
            .collect();
        let bright = |c: u8| brighter.get(usize::from(c)).copied().unwrap_or(c);
        let mut rgba = Vec::with_capacity((4 * WIDTH * HEIGHT) as usize);
        for &[r, g, b] in cut.as_raw().as_chunks::<3>().0 {
            rgba.extend_from_slice(&[bright(r), bright(g), bright(b), 255]);
        }
        Ok(rgba)
    }
}

/// Cuts `WIDTH` x `HEIGHT` pixels, `step` photo pixels apart, out of a photo, with linear interpolation.
/// `place`: where in the photo the part lies, 0 (left, top) to 1.
fn resample(photo: &RgbImage, step: f64, place: [f64; 2], mirrored: bool) -> RgbImage {
    // Photo pixels before and after each output pixel, and the weight of the latter out of 256.
    let taps = |count: u32, extent: u32, place: f64| -> Vec<(usize, usize, u32)> {
        let start = (f64::from(extent) - step * f64::from(count)) * place;
        let last = f64::from(extent.saturating_sub(1));
        (0..count)
            .map(|i| {
                let at = (start + step * (f64::from(i) + 0.5) - 0.5).clamp(0.0, last);
                let before = at.floor();
                (
                    before as usize,
                    (before + 1.0).min(last) as usize,
                    (256.0 * (at - before)) as u32,
                )
            })
            .collect()
    };
    let mut columns = taps(WIDTH, photo.width(), place[0]);
    if mirrored {
        columns.reverse();
    }
    let stride = photo.width() as usize;
    let pixels = photo.as_raw().as_chunks::<3>().0;
    let row = |y: usize| pixels.get(y * stride..(y + 1) * stride).unwrap_or_default();
    let mut out = RgbImage::new(WIDTH, HEIGHT);
    let out_rows = out.as_chunks_mut::<3>().0.chunks_exact_mut(WIDTH as usize);
    for (out_row, (above, below, down)) in out_rows.zip(taps(HEIGHT, photo.height(), place[1])) {
        let (above, below) = (row(above), row(below));
        for (slot, &(left, right, across)) in out_row.iter_mut().zip(&columns) {
            let at =
                |row: &[[u8; 3]], x: usize| row.get(x).copied().unwrap_or_default().map(u32::from);
            let corners = [
                at(above, left),
                at(above, right),
                at(below, left),
                at(below, right),
            ];
            let weights = [
                (256 - across) * (256 - down),
                across * (256 - down),
                (256 - across) * down,
                across * down,
            ];
            for (channel, value) in slot.iter_mut().enumerate() {
                let sum: u32 = corners
                    .iter()
                    .zip(weights)
                    .map(|(c, w)| c[channel] * w)
                    .sum();
                *value = ((sum + (1 << 15)) >> 16) as u8;
            }
        }
    }
    out
}

fn decode(path: &Path) -> Result<RgbImage, RecorderError> {
    let picture = image_file::read(path).map_err(|cause| RecorderError::Picture {
        path: path.to_owned(),
        cause,
    })?;
    Ok(picture.into_rgb8())
}
