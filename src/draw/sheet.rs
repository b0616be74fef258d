use image::imageops::{self, FilterType};
use image::{Rgb, RgbImage};

use super::chart::{ChartError, write};

/// A row of pictures of one thing.
#[derive(Debug, Clone, PartialEq)]
pub struct SheetRow {
    /// What stands above the row.
    pub caption: String,
    /// The pictures, one a column.
    pub pictures: Vec<RgbImage>,
}

/// The box that a picture is scaled to fit, pixels.
const CELL: (u32, u32) = (384, 318);
const GAP: u32 = 8;
const LINE: u32 = 26;
const TEXT: f64 = 16.0;

/// Rows of pictures side by side, with a heading above each column.
///
/// # Errors
/// The drawing library's.
pub fn sheet(headings: &[&str], rows: &[SheetRow]) -> Result<RgbImage, ChartError> {
    let left = |column: usize| GAP + column as u32 * (CELL.0 + GAP);
    let mut texts: Vec<(String, [u32; 2])> = headings
        .iter()
        .enumerate()
        .map(|(column, heading)| ((*heading).to_owned(), [left(column), GAP / 2]))
        .collect();
    let mut top = LINE;
    let mut placed = Vec::new();
    for row in rows {
        texts.push((row.caption.clone(), [GAP, top + GAP / 2]));
        top += LINE;
        let fitted: Vec<RgbImage> = row.pictures.iter().map(fit).collect();
        let tallest = fitted.iter().map(RgbImage::height).max().unwrap_or(0);
        for (column, picture) in fitted.into_iter().enumerate() {
            let x = left(column) + (CELL.0 - picture.width()) / 2;
            placed.push((picture, x, top));
        }
        top += tallest + GAP;
    }
    let mut sheet = RgbImage::from_pixel(left(headings.len()), top, Rgb([255; 3]));
    for (picture, x, y) in placed {
        imageops::replace(&mut sheet, &picture, x.into(), y.into());
    }
    write(&mut sheet, TEXT, &texts)?;
    Ok(sheet)
}

fn fit(picture: &RgbImage) -> RgbImage {
    let (width, height) = picture.dimensions();
    let scale = (f64::from(CELL.0) / f64::from(width.max(1)))
        .min(f64::from(CELL.1) / f64::from(height.max(1)));
    let side = |side: u32, most: u32| ((f64::from(side) * scale).round() as u32).clamp(1, most);
    let (width, height) = (side(width, CELL.0), side(height, CELL.1));
    imageops::resize(picture, width, height, FilterType::Triangle)
}
