use image::{GrayImage, RgbImage, RgbaImage};
use rayon::prelude::*;
use tiny_skia::{Color, FillRule, LineCap, Paint, PathBuilder, PixmapMut, Stroke, Transform};

use super::JOINT_COLOURS;

const TINT: [u8; 3] = [0, 220, 110];
const TINT_STRENGTH: f32 = 0.45;
const OUTLINE_STRENGTH: f32 = 0.9;
const RIM: [u8; 3] = [20, 20, 24];
const ARM: [u8; 3] = [245, 245, 245];

/// The image with its mask tinted and outlined, and the joints as circles of their own colours,
/// joined along the arm in the order given.
///
/// `mask` has the image's size and is 255 where the robot is; `joints` are in pixels, and may lie
/// anywhere. Lines and circles grow with the image. The image's alpha is ignored.
pub fn annotated(image: &RgbaImage, mask: &GrayImage, joints: &[[f64; 2]]) -> RgbImage {
    let (width, height) = image.dimensions();
    // 1 at the recordings' 512 x 424.
    let unit = f64::from(width).hypot(f64::from(height)) / 665.0;
    let mut picture = tinted(image, mask, unit);
    if let Some(mut canvas) = PixmapMut::from_bytes(&mut picture, width, height) {
        let joints: Vec<_> = joints
            .iter()
            .filter(|joint| joint.iter().all(|v| v.is_finite()))
            .copied()
            .collect();
        draw_arm(&mut canvas, &joints, unit);
    }
    let rgb = picture
        .chunks_exact(4)
        .flat_map(|rgba| [rgba[0], rgba[1], rgba[2]])
        .collect();
    // The buffer has the image's size.
    RgbImage::from_raw(width, height, rgb).unwrap_or_default()
}

/// Opaque RGBA.
fn tinted(image: &RgbaImage, mask: &GrayImage, unit: f64) -> Vec<u8> {
    let (width, height) = image.dimensions();
    let thickness = unit.round().max(1.0) as u32;
    let value = |x: u32, y: u32| mask.get_pixel_checked(x, y).map_or(0, |p| p.0[0]);
    let inside = |x: u32, y: u32| value(x, y) >= 128;
    let on_outline = |x: u32, y: u32| {
        // A mask that goes on beyond the image's border has no outline there.
        let (left, top) = (x.saturating_sub(thickness), y.saturating_sub(thickness));
        let right = (x + thickness).min(width - 1);
        let bottom = (y + thickness).min(height - 1);
        let around = [(left, y), (right, y), (x, top), (x, bottom)];
        inside(x, y) && around.into_iter().any(|(x, y)| !inside(x, y))
    };
    let mut picture = image.as_raw().clone();
    if picture.is_empty() {
        return picture;
    }
    picture
        .par_chunks_mut(4 * width as usize)
        .zip(0..height)
        .for_each(|(row, y)| {
            for (pixel, x) in row.chunks_exact_mut(4).zip(0..) {
                let strength = if on_outline(x, y) {
                    OUTLINE_STRENGTH
                } else {
                    TINT_STRENGTH * f32::from(value(x, y)) / 255.0
                };
                for (channel, tint) in pixel.iter_mut().zip(TINT) {
                    let mixed =
                        f32::from(*channel) + (f32::from(tint) - f32::from(*channel)) * strength;
                    *channel = mixed.round() as u8;
                }
                pixel[3] = 255;
            }
        });
    picture
}

fn draw_arm(canvas: &mut PixmapMut<'_>, joints: &[[f64; 2]], unit: f64) {
    let radius = (7.0 * unit).max(1.5);
    for (width, colour) in [(0.65 * radius, RIM), (0.35 * radius, ARM)] {
        for pair in joints.windows(2) {
            if let [from, to] = *pair {
                draw_line(canvas, from, to, width, colour);
            }
        }
    }
    for (&joint, colour) in joints.iter().zip(JOINT_COLOURS.into_iter().cycle()) {
        draw_circle(canvas, joint, radius, RIM);
        draw_circle(canvas, joint, 0.75 * radius, colour);
    }
}

fn draw_circle(canvas: &mut PixmapMut<'_>, centre: [f64; 2], radius: f64, colour: [u8; 3]) {
    let (width, height) = (f64::from(canvas.width()), f64::from(canvas.height()));
    let [x, y] = corner_coordinates(centre);
    let visible = |at: f64, size: f64| (-radius..=size + radius).contains(&at);
    if !(visible(x, width) && visible(y, height)) {
        return;
    }
    if let Some(circle) = PathBuilder::from_circle(x as f32, y as f32, radius as f32) {
        let paint = paint(colour);
        canvas.fill_path(
            &circle,
            &paint,
            FillRule::Winding,
            Transform::identity(),
            None,
        );
    }
}

fn draw_line(
    canvas: &mut PixmapMut<'_>,
    from: [f64; 2],
    to: [f64; 2],
    width: f64,
    colour: [u8; 3],
) {
    let size = [f64::from(canvas.width()), f64::from(canvas.height())];
    // Single precision would lose the direction of a line to a joint far outside.
    let clipped = clip(
        corner_coordinates(from),
        corner_coordinates(to),
        [-width, -width],
        size.map(|side| side + width),
    );
    let Some([from, to]) = clipped else { return };
    let mut path = PathBuilder::new();
    path.move_to(from[0] as f32, from[1] as f32);
    path.line_to(to[0] as f32, to[1] as f32);
    if let Some(path) = path.finish() {
        let stroke = Stroke {
            width: width as f32,
            line_cap: LineCap::Round,
            ..Stroke::default()
        };
        let paint = paint(colour);
        canvas.stroke_path(&path, &paint, &stroke, Transform::identity(), None);
    }
}

/// tiny-skia's (0, 0) is the corner of the top-left pixel; ours is its centre.
fn corner_coordinates(pixel: [f64; 2]) -> [f64; 2] {
    pixel.map(|v| v + 0.5)
}

fn paint([red, green, blue]: [u8; 3]) -> Paint<'static> {
    let mut paint = Paint::default();
    paint.set_color(Color::from_rgba8(red, green, blue, 255));
    paint
}

/// The part of a line within a box (Liang and Barsky).
fn clip(from: [f64; 2], to: [f64; 2], low: [f64; 2], high: [f64; 2]) -> Option<[[f64; 2]; 2]> {
    let (mut start, mut end) = (0.0_f64, 1.0_f64);
    for axis in 0..2 {
        let way = to[axis] - from[axis];
        if way == 0.0 {
            if !(low[axis]..=high[axis]).contains(&from[axis]) {
                return None;
            }
            continue;
        }
        let (a, b) = (
            (low[axis] - from[axis]) / way,
            (high[axis] - from[axis]) / way,
        );
        start = start.max(a.min(b));
        end = end.min(a.max(b));
    }
    let at = |t: f64| std::array::from_fn(|axis| from[axis] + t * (to[axis] - from[axis]));
    (start <= end).then(|| [at(start), at(end)])
}

#[cfg(test)]
mod tests {
    use super::clip;

    #[test]
    fn a_line_is_clipped_to_the_box_it_crosses() {
        let clipped = |from, to| clip(from, to, [0.0, 0.0], [10.0, 10.0]);
        assert_eq!(
            clipped([-5.0, 5.0], [15.0, 5.0]),
            Some([[0.0, 5.0], [10.0, 5.0]])
        );
        assert_eq!(
            clipped([2.0, 3.0], [4.0, 5.0]),
            Some([[2.0, 3.0], [4.0, 5.0]])
        );
        assert_eq!(clipped([-5.0, 11.0], [15.0, 11.0]), None);
        assert_eq!(clipped([-5.0, 8.0], [8.0, 21.0]), None);
    }
}
