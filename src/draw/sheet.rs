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
    let columns = headings.len() as u32;
    let step = LINE + CELL.1 + GAP;
    let width = GAP + columns * (CELL.0 + GAP);
    let height = LINE + rows.len() as u32 * step + GAP;
    let mut sheet = RgbImage::from_pixel(width, height, Rgb([255; 3]));
    let left = |column: usize| GAP + column as u32 * (CELL.0 + GAP);
    let mut texts: Vec<(String, [u32; 2])> = headings
        .iter()
        .enumerate()
        .map(|(column, heading)| ((*heading).to_owned(), [left(column), GAP / 2]))
        .collect();
    for (index, row) in rows.iter().enumerate() {
        let top = LINE + index as u32 * step;
        texts.push((row.caption.clone(), [GAP, top + GAP / 2]));
        for (column, picture) in row.pictures.iter().enumerate() {
            let fitted = fit(picture);
            let x = left(column) + (CELL.0 - fitted.width()) / 2;
            imageops::replace(&mut sheet, &fitted, x.into(), (top + LINE).into());
        }
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
