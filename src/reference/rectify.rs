use image::{Rgba, RgbaImage};
use rayon::prelude::*;

use super::Tensor;
use crate::camera::{Gaze, Rectification};
use crate::network::Shape;

/// Undistorts and resamples `image` into what `gaze` sees, the canonical pinhole camera or one that looks closer:
/// `[3, height, width]`, values in [0, 1], alpha ignored.
///
/// `image` holds the source's pixels where [`Rectification::texels`] says.
///
/// A pixel is the mean of a grid of bilinear samples over its footprint in the source, as many as
/// the footprint has pixels. What the source does not show is black. In f32 as the kernel.
pub fn rectify(
    image: &RgbaImage,
    params: &Rectification,
    gaze: &Gaze,
    height: usize,
    width: usize,
) -> Tensor {
    let mut output = Tensor::full(Shape::new(3, height, width), 0.0);
    let rows: Vec<Vec<[f32; 3]>> = (0..height)
        .into_par_iter()
        .map(|y| {
            (0..width)
                .map(|x| pixel(image, params, gaze, [x as f32, y as f32]))
                .collect()
        })
        .collect();
    let plane = height * width;
    for (index, colour) in rows.iter().flatten().enumerate() {
        for (channel, value) in colour.iter().enumerate() {
            output.data_mut()[channel * plane + index] = *value;
        }
    }
    output
}

fn pixel(image: &RgbaImage, params: &Rectification, gaze: &Gaze, [x, y]: [f32; 2]) -> [f32; 3] {
    let ray = |x, y| at_one(ray_of(params, gaze, [x, y]));
    let [rx, ry] = ray(x, y);
    let [_, _, z] = ray_of(params, gaze, [x, y]);
    if !(z > AHEAD && rx * rx + ry * ry <= params.max_radius * params.max_radius) {
        return [0.0; 3];
    }
    let difference = |a: [f32; 2], b: [f32; 2]| [a[0] - b[0], a[1] - b[1]];
    let centre = project(params, [rx, ry]);
    let along_x = difference(
        project(params, ray(x + 0.5, y)),
        project(params, ray(x - 0.5, y)),
    );
    let along_y = difference(
        project(params, ray(x, y + 0.5)),
        project(params, ray(x, y - 0.5)),
    );
    let [columns, rows] = params.samples;
    let step = [1.0 / columns as f32, 1.0 / rows as f32];
    let mut sum = [0.0; 3];
    for j in 0..rows {
        for i in 0..columns {
            let part = [
                (i as f32 + 0.5) * step[0] - 0.5,
                (j as f32 + 0.5) * step[1] - 0.5,
            ];
            let at = [0, 1].map(|a| centre[a] + along_x[a] * part[0] + along_y[a] * part[1]);
            for (total, value) in sum.iter_mut().zip(sample(image, params, at)) {
                *total += value;
            }
        }
    }
    sum.map(|value| value * (step[0] * step[1]))
}

/// Where a pixel looks, in the canonical camera's frame.
fn ray_of(params: &Rectification, gaze: &Gaze, pixel: [f32; 2]) -> [f32; 3] {
    let [scale_x, scale_y, cx, cy] = params.canonical;
    let seen = [(pixel[0] - cx) * scale_x, (pixel[1] - cy) * scale_y].map(|v| v / gaze.zoom);
    gaze.turned_back([seen[0], seen[1], 1.0])
}

/// What is less far ahead is beside the camera or behind it.
const AHEAD: f32 = 1e-3;

/// At z = 1, for what is ahead.
fn at_one([x, y, z]: [f32; 3]) -> [f32; 2] {
    let z = z.max(AHEAD);
    [x / z, y / z]
}

/// Where a ray at z = 1 lands in the source, in pixels.
fn project(params: &Rectification, ray: [f32; 2]) -> [f32; 2] {
    let [x, y] = ray;
    let r2 = x * x + y * y;
    let [k1, k2, k3, k4] = params.k_low;
    let [k5, k6, p1, p2] = params.k_high;
    let bent = match params.model {
        1 => {
            let radial =
                (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
            let xy = 2.0 * x * y;
            [
                x * radial + p1 * xy + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy,
            ]
        }
        2 => {
            let r = r2.sqrt();
            let theta = r.atan();
            let t2 = theta * theta;
            let bent = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
            // On the axis the ratio tends to 1.
            let ratio = if r > 1e-6 { bent / r } else { 1.0 };
            [x * ratio, y * ratio]
        }
        _ => ray,
    };
    let [fx, fy, cx, cy] = params.source;
    [bent[0] * fx + cx, bent[1] * fy + cy]
}

/// Bilinear, as if black pixels lay round the source: without a step at its border.
fn sample(image: &RgbaImage, params: &Rectification, [x, y]: [f32; 2]) -> [f32; 3] {
    let [width, height] = params.size;
    if !(x > -1.0 && y > -1.0 && x < width && y < height) {
        return [0.0; 3];
    }
    let load = |x: i32, y: i32| {
        let inside = x >= 0 && y >= 0 && (x as f32) < width && (y as f32) < height;
        let [column, row] = params.texels.at([x, y]);
        let texel = u32::try_from(column).ok().zip(u32::try_from(row).ok());
        match texel.and_then(|(column, row)| image.get_pixel_checked(column, row)) {
            Some(Rgba([r, g, b, _])) if inside => [*r, *g, *b].map(|v| f32::from(v) / 255.0),
            _ => [0.0; 3],
        }
    };
    let mix = |a: [f32; 3], b: [f32; 3], t: f32| [0, 1, 2].map(|i| a[i] * (1.0 - t) + b[i] * t);
    let (column, row) = (x.floor() as i32, y.floor() as i32);
    let (part_x, part_y) = (x - x.floor(), y - y.floor());
    let top = mix(load(column, row), load(column + 1, row), part_x);
    let bottom = mix(load(column, row + 1), load(column + 1, row + 1), part_x);
    mix(top, bottom, part_y)
}
