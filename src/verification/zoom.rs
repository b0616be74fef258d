use super::comparison::Comparison;
use super::kernel::{BATCHES, Case, rounding_of, storable, submit, with_first};
use super::stages::canonical;
use crate::gpu::{Device, Gazes, GpuError, Layout, Tensor};
use crate::network::{Overlay, Shape, Zoom};
use crate::reference;

/// Which of the kernels that turn a network's camera: `shaders/zoom*.wgsl`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    Camera,
    Mask,
    Overlay,
    Joints,
}

const ZOOM: Zoom = Zoom {
    spread: 4.0,
    least: 0.5,
    most: 4.0,
};
const RULE: Overlay = Overlay::Ramp {
    low: 0.25,
    high: 0.75,
};
/// What is seen of the camera itself: its axes.
const AXES: [f32; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];

pub(super) async fn compare(
    device: &Device,
    layout: Layout,
    part: Part,
    mut case: Case,
) -> Result<Comparison, GpuError> {
    let shape = case.shape(3);
    let one = Shape {
        channels: 1,
        ..shape
    };
    let batch = case.random.of(&BATCHES);
    // Gentle: a GPU's division places samples less exactly than noise would bear.
    let image: Vec<f32> = (0..batch * shape.len())
        .map(|_| 0.1 * case.random.value())
        .collect();
    let image = storable(image, layout);
    let mask = storable(case.random.values(batch * one.len()), layout);
    let mask = with_first(&mask, |_| 0.9);
    let seen = match part {
        Part::Joints => case.random.values(batch * AXES.len()),
        _ => AXES.repeat(batch),
    };
    let camera = canonical(shape.width, shape.height);

    let tensor = |what, shape| Tensor::in_layout(device, layout, what, shape, batch, 0);
    let axes = Shape::new(AXES.len(), 1, 1);
    let (input, second, sights) = (
        tensor("image", shape)?,
        tensor("mask", one)?,
        tensor("seen", axes)?,
    );
    let (overlay, joints) = (tensor("overlay", shape)?, tensor("joints", axes)?);
    let (closer, merged) = (tensor("closer", one)?, tensor("merged", one)?);
    let steps = device.scoped(|| {
        let gazes = Gazes::new(device, camera, batch)?;
        let zoom = gazes.zoom(device, &second, ZOOM, RULE)?;
        let last = match part {
            Part::Mask => gazes.zoom_mask(device, &closer, &second, &merged)?,
            Part::Overlay => gazes.zoom_overlay(device, &input, &second, &overlay, RULE)?,
            Part::Camera | Part::Joints => gazes.zoom_joints(device, &sights, &joints)?,
        };
        Ok([zoom, last])
    })?;
    let output = match part {
        Part::Overlay => &overlay,
        Part::Mask => &merged,
        Part::Camera | Part::Joints => &joints,
    };
    let run = async |image: &[f32], mask: &[f32], seen: &[f32]| {
        input.write(device, image)?;
        closer.write(device, &first_channels(image, shape))?;
        second.write(device, mask)?;
        sights.write(device, seen)?;
        submit(device, |encoder| {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            for step in &steps {
                step.encode(&mut pass);
            }
        })?;
        output.read_async(device).await
    };
    let found = run(&image, &mask, &seen).await?;
    let control = match part {
        Part::Camera => run(&image, &other_half(&mask, one), &seen).await?,
        Part::Mask | Part::Overlay => {
            run(
                &image.iter().map(|v| v + 1.0).collect::<Vec<_>>(),
                &mask,
                &seen,
            )
            .await?
        }
        Part::Joints => run(&image, &mask, &with_first(&seen, |v| v + 1.0)).await?,
    };
    let images = image.chunks_exact(shape.len());
    let masks = mask.chunks_exact(one.len());
    let sights = seen.chunks_exact(AXES.len());
    let expected: Vec<f32> = images
        .zip(masks)
        .zip(sights)
        .filter_map(|((image, mask), seen)| {
            let image = reference::Tensor::new(shape, image.to_vec())?;
            let mask = reference::Tensor::new(one, mask.to_vec())?;
            let gaze = reference::zoom(&mask, RULE, &camera, ZOOM);
            let output = match part {
                Part::Mask => {
                    let closer = first_channels(image.data(), shape);
                    let closer = reference::Tensor::new(one, closer)?;
                    reference::zoom_mask(&closer, &mask, &camera, &gaze)
                }
                Part::Overlay => reference::zoom_overlay(&image, &mask, RULE, &camera, &gaze),
                Part::Camera | Part::Joints => return Some(reference::zoom_joints(seen, &gaze)),
            };
            Some(output.data().to_vec())
        })
        .flatten()
        .collect();
    Ok(Comparison {
        found,
        control,
        allowed: 1e-3 + rounding_of(&expected, layout),
        expected,
    })
}

/// Of images of `shape`, the first channel.
fn first_channels(images: &[f32], shape: Shape) -> Vec<f32> {
    let plane = shape.height * shape.width;
    let each = images.chunks_exact(shape.len());
    each.flat_map(|image| image.iter().take(plane).copied())
        .collect()
}

/// Masks of which the right or the lower half is left.
fn other_half(masks: &[f32], shape: Shape) -> Vec<f32> {
    let place = |i: usize| (i % shape.width, i / shape.width % shape.height);
    let (columns, rows) = (shape.width, shape.height);
    let kept = |(x, y): (usize, usize)| {
        if columns > rows {
            2 * x + 1 >= columns
        } else {
            2 * y + 1 >= rows
        }
    };
    (0..masks.len())
        .map(|i| if kept(place(i)) { 0.9 } else { 0.0 })
        .collect()
}
