//! Image files, as cameras leave them.

use std::io::Cursor;
use std::path::Path;

use image::error::{DecodingError, ImageFormatHint};
use image::{DynamicImage, ImageError, ImageFormat, ImageReader};

/// Reads an image as it is stored.
///
/// # Errors
/// A file that cannot be read, and one that is no image of a known format, or not a whole one.
pub(crate) fn read(path: &Path) -> Result<DynamicImage, ImageError> {
    DynamicImage::from_decoder(decoder(path)?)
}

/// Reads an image upright: EXIF's orientation is applied.
///
/// # Errors
/// As [`read`].
#[cfg(feature = "live")]
pub(crate) fn read_upright(path: &Path) -> Result<DynamicImage, ImageError> {
    let mut decoder = decoder(path)?;
    let orientation = image::ImageDecoder::orientation(&mut decoder).ok();
    let mut image = DynamicImage::from_decoder(decoder)?;
    if let Some(orientation) = orientation {
        image.apply_orientation(orientation);
    }
    Ok(image)
}

fn decoder(path: &Path) -> Result<impl image::ImageDecoder, ImageError> {
    let bytes = std::fs::read(path)?;
    let format = image::guess_format(&bytes)?;
    ensure_complete(format, &bytes)?;
    ImageReader::with_format(Cursor::new(bytes), format).into_decoder()
}

/// The images in a folder (not below it), in the order of their names. Pictures that `locate` wrote are left out.
///
/// # Errors
/// A folder that cannot be read.
#[cfg(feature = "live")]
pub(crate) fn in_folder(folder: &Path) -> std::io::Result<Vec<std::path::PathBuf>> {
    let mut images = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let known = ImageFormat::from_path(&path).is_ok_and(|format| format.reading_enabled());
        let own = path
            .file_name()
            .map(|name| name.to_string_lossy())
            .is_some_and(|name| name.ends_with(".mask.png") || name.ends_with(".annotated.png"));
        if known && !own && !path.is_dir() {
            images.push(path);
        }
    }
    images.sort();
    Ok(images)
}

/// A JPEG without its end is no image: the decoder fills what is missing with grey, and says nothing.
///
/// # Errors
/// [`ImageError::Decoding`].
pub(crate) fn ensure_complete(format: ImageFormat, bytes: &[u8]) -> Result<(), ImageError> {
    if format != ImageFormat::Jpeg || jpeg_is_complete(bytes) {
        return Ok(());
    }
    let hint = ImageFormatHint::Exact(format);
    let what = "the JPEG is truncated: its end is missing";
    Err(ImageError::Decoding(DecodingError::new(hint, what)))
}

/// Whether a JPEG has its end marker, behind all its scans.
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    const END: u8 = 0xd9;
    let mut at = 2;
    loop {
        // Between segments, and in a scan's data, the next marker is FF and neither 0 nor FF.
        let Some(found) = bytes.get(at..).and_then(|rest| {
            rest.windows(2)
                .position(|w| w[0] == 0xff && !matches!(w[1], 0 | 0xff))
        }) else {
            return false;
        };
        let marker = bytes.get(at + found + 1).copied();
        at += found + 2;
        match marker {
            Some(END) => return true,
            // Restarts and TEM stand alone.
            Some(0x01 | 0xd0..=0xd8) => {}
            _ => {
                let Some(&[high, low]) = bytes.get(at..at + 2) else {
                    return false;
                };
                at += usize::from(u16::from_be_bytes([high, low]));
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn half_a_jpeg_is_no_image() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("picture.jpg");
        image::RgbImage::new(64, 48).save(&file).unwrap();
        assert_eq!(read(&file).unwrap().height(), 48);
        let bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, bytes.split_at(bytes.len() - 2).0).unwrap();
        let error = read(&file).unwrap_err().to_string();
        assert!(error.contains("its end is missing"), "{error}");
    }

    #[cfg(feature = "live")]
    #[test]
    fn pictures_of_our_own_are_not_of_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["b.png", "a.jpg", "a.mask.png", "a.annotated.png", "a.txt"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let images = in_folder(folder.path()).unwrap();
        assert_eq!(
            images,
            ["a.jpg", "b.png"].map(|name| folder.path().join(name))
        );
    }
}
