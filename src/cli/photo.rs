//! Reading images from files, as cameras and people leave them.

use std::fs::File;
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail, ensure};
use exif::{In, Tag};
use image::{DynamicImage, ImageDecoder, ImageReader, Limits, RgbaImage};

use crate::image_file;

/// An image as a person sees it, and what its file says about the camera.
pub struct Photo {
    /// Upright: EXIF's orientation is applied.
    pub image: RgbaImage,
    /// EXIF's `FocalLengthIn35mmFilm`, in millimetres.
    pub focal_35mm: Option<f64>,
}

/// The longest side of an image, in pixels.
const MAX_SIDE: u32 = 32_768;
/// The largest file, and the largest image in memory.
const MAX_BYTES: u64 = 1 << 30;

/// Reads an image of any depth and colour model to 8-bit RGBA.
pub fn read(path: &Path) -> anyhow::Result<Photo> {
    let mut bytes = Vec::new();
    File::open(path)
        .and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes))
        .context("cannot be read")?;
    ensure!(
        bytes.len() as u64 <= MAX_BYTES,
        "expected a file of at most 1 GiB"
    );
    let mut reader = ImageReader::new(Cursor::new(&bytes)).with_guessed_format()?;
    let Some(format) = reader.format() else {
        bail!("expected an image (JPEG, PNG, WebP, BMP, TIFF, GIF), found none of these formats");
    };
    let mut limits = Limits::default();
    limits.max_alloc = Some(MAX_BYTES);
    reader.limits(limits);
    let mut decoder = reader.into_decoder().context("cannot be decoded")?;

    // The header's word is enough: nothing is allocated for an image that is too large.
    let (width, height) = decoder.dimensions();
    ensure!(
        width <= MAX_SIDE && height <= MAX_SIDE,
        "expected an image of at most {MAX_SIDE} pixels on a side, found {width} x {height}"
    );
    let rgba = 4 * u64::from(width) * u64::from(height);
    ensure!(
        decoder.total_bytes().max(rgba) <= MAX_BYTES,
        "expected an image of at most 1 GiB in memory, found {width} x {height} pixels"
    );
    ensure!(
        width > 0 && height > 0,
        "expected an image, found no pixels"
    );
    // Its message holds its cause's.
    image_file::ensure_complete(format, &bytes).map_err(|error| anyhow!("{error}"))?;

    // Broken metadata is no reason to refuse a picture.
    let focal_35mm = decoder
        .exif_metadata()
        .ok()
        .flatten()
        .and_then(focal_length_35mm);
    let orientation = decoder.orientation().ok();
    let mut image = DynamicImage::from_decoder(decoder).context("cannot be decoded")?;
    if let Some(orientation) = orientation {
        image.apply_orientation(orientation);
    }
    Ok(Photo {
        image: image.into_rgba8(),
        focal_35mm,
    })
}

/// The images in a folder, one at least ([`image_file::in_folder`]).
pub fn in_folder(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let images = image_file::in_folder(folder).context("cannot be read")?;
    ensure!(!images.is_empty(), "no images in this folder");
    Ok(images)
}

fn focal_length_35mm(exif: Vec<u8>) -> Option<f64> {
    let exif = exif::Reader::new().read_raw(exif).ok()?;
    let field = exif.get_field(Tag::FocalLengthIn35mmFilm, In::PRIMARY)?;
    // 0 means unknown.
    field
        .value
        .get_uint(0)
        .filter(|&millimetres| millimetres > 0)
        .map(f64::from)
}
