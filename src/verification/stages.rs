use image::metadata::Orientation;
use image::{Rgba, RgbaImage};
use wgpu::{BufferUsages, TextureFormat, TextureUsages};

use super::comparison::Comparison;
use super::kernel::{BATCHES, Case, rounding_of, storable, submit, with_first};
use super::random::Random;
use crate::camera::{
    Camera, Crop, Distortion, Gaze, Intrinsics, Rectification, Texels, Unrectification,
};
use crate::gpu::{
    self, Device, Gazes, GpuError, Layout, Planes, Rectify, Sight, Tensor, Totals, Unrectify, Yuv,
};
use crate::network::{Coverage, Overlay, Shape};
use crate::reference;

/// What an image to rectify is in: `shaders/rectify_*.wgsl`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Source {
    Storage,
    Texture,
    Srgb,
    Nv12,
}

const RATIONAL: Distortion = Distortion::Rational {
    k: [-0.2, 0.03, 0.0, 0.01, 0.0, 0.0],
    p: [0.002, -0.001],
};
const FISHEYE: Distortion = Distortion::Equidistant {
    k: [-0.03, 0.01, 0.0, 0.0],
};

/// Of a camera with images of `columns` x `rows` that sees 71 degrees from left to right.
pub(super) fn canonical(columns: usize, rows: usize) -> Intrinsics {
    Intrinsics {
        fx: 0.7 * columns as f64,
        fy: 0.7 * columns as f64,
        cx: 0.5 * (columns - 1) as f64,
        cy: 0.5 * (rows - 1) as f64,
    }
}

/// A camera's image as bytes, and as the colours that they stand for.
struct Picture {
    bytes: RgbaImage,
    colours: RgbaImage,
}

impl Picture {
    /// Grain on waves: steep enough that a wrong position shows.
    fn new(width: u32, height: u32, random: &mut Random, source: Source) -> Self {
        let bytes = RgbaImage::from_fn(width, height, |x, y| {
            let mut value = |f: f32| {
                let wave = (x as f32 * f).sin() + (y as f32 * f * 0.7).cos();
                (120.0 + 50.0 * wave + 10.0 * random.value()) as u8
            };
            Rgba([value(0.1), value(0.05), value(0.02), 255])
        });
        Self::of(bytes, source)
    }

    fn of(bytes: RgbaImage, source: Source) -> Self {
        let colours = match source {
            Source::Nv12 => RgbaImage::from_fn(bytes.width(), bytes.height(), |x, y| {
                let [luma, ..] = bytes.get_pixel(x, y).0;
                let [_, cb, cr, _] = bytes.get_pixel(x / 2 * 2, y / 2 * 2).0;
                bt601_full([luma, cb, cr])
            }),
            _ => bytes.clone(),
        };
        Self { bytes, colours }
    }

    /// With the middle pixel's values made wrong.
    fn control(&self, source: Source) -> Self {
        let mut bytes = self.bytes.clone();
        let (x, y) = (bytes.width() / 2, bytes.height() / 2);
        bytes.get_pixel_mut(x, y).0 = bytes.get_pixel(x, y).0.map(|v| v ^ 0x80);
        Self::of(bytes, source)
    }

    /// In textures of a host. NV12's chroma is that of the first of each four pixels.
    fn planes(&self, device: &Device, source: Source) -> Result<Planes, GpuError> {
        let [width, height] = [self.bytes.width(), self.bytes.height()];
        device.scoped(|| {
            Ok(match source {
                Source::Nv12 => {
                    let luma: Vec<u8> = self.bytes.pixels().map(|pixel| pixel.0[0]).collect();
                    let half = [width.div_ceil(2), height.div_ceil(2)];
                    let chroma = (0..half[0] * half[1])
                        .map(|at| self.bytes.get_pixel(at % half[0] * 2, at / half[0] * 2))
                        .flat_map(|pixel| [pixel.0[1], pixel.0[2]]);
                    let chroma: Vec<u8> = chroma.collect();
                    Planes::Nv12 {
                        luma: plane(device, TextureFormat::R8Unorm, [width, height], &luma),
                        chroma: plane(device, TextureFormat::Rg8Unorm, half, &chroma),
                        encoding: Yuv::Bt601Full,
                    }
                }
                Source::Srgb => {
                    let format = TextureFormat::Rgba8UnormSrgb;
                    Planes::Rgba(plane(device, format, [width, height], &self.bytes))
                }
                Source::Texture | Source::Storage => {
                    let format = TextureFormat::Rgba8Unorm;
                    Planes::Rgba(plane(device, format, [width, height], &self.bytes))
                }
            })
        })
    }
}

/// The colour of luma, Cb and Cr (ITU-T T.871), to the nearest of 8 bits.
fn bt601_full(yuv: [u8; 3]) -> Rgba<u8> {
    let [y, cb, cr] = yuv.map(f32::from);
    let (cb, cr) = (cb - 128.0, cr - 128.0);
    let colour = [
        y + 1.402 * cr,
        y - 0.344_136 * cb - 0.714_136 * cr,
        y + 1.772 * cb,
    ];
    let [red, green, blue] = colour.map(|v| v.round().clamp(0.0, 255.0) as u8);
    Rgba([red, green, blue, 255])
}

fn plane(
    device: &Device,
    format: TextureFormat,
    [width, height]: [u32; 2],
    bytes: &[u8],
) -> wgpu::TextureView {
    let texture = device.wgpu().create_texture(&wgpu::TextureDescriptor {
        label: Some("verify: source"),
        size: wgpu::Extent3d {
            width,
            height,
            depth_or_array_layers: 1,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: TextureUsages::TEXTURE_BINDING | TextureUsages::COPY_DST,
        view_formats: &[],
    });
    device.queue().write_texture(
        texture.as_image_copy(),
        bytes,
        wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(bytes.len() as u32 / height),
            rows_per_image: None,
        },
        texture.size(),
    );
    texture.create_view(&Default::default())
}

pub(super) async fn rectify(
    device: &Device,
    layout: Layout,
    source: Source,
    mut case: Case,
) -> Result<Comparison, GpuError> {
    let distortion = case.turn(&[Distortion::None, RATIONAL, FISHEYE]);
    let orientation = case.turn(&[
        Orientation::NoTransforms,
        Orientation::FlipHorizontal,
        Orientation::Rotate180,
    ]);
    // Turned by 14 degrees, so that a part of what it sees is beyond the picture.
    let closer = Gaze::towards([0.125, 0.22], 1.5);
    let gaze = case.turn(&[Gaze::CANONICAL, closer]);
    let random = &mut case.random;
    let [width, height] = [0; 2].map(|_| random.of(&[31_u32, 64, 101, 150]));
    let camera = Camera {
        distortion,
        ..Camera::from_hfov(width, height, random.of(&[0.9, 1.2, 1.6]))
    };
    let [columns, rows] = [0; 2].map(|_| random.of(&[33_usize, 40, 61]));
    let canonical = canonical(columns, rows);
    let params = Rectification {
        texels: Texels::new(Crop::whole(width, height), orientation),
        ..Rectification::new(&camera, &canonical, columns as u32, rows as u32)
    };
    let picture = Picture::new(width, height, random, source);
    let expected = reference::rectify(&picture.colours, &params, &gaze, rows, columns);

    let output = Tensor::in_layout(device, layout, "output", expected.shape(), 1, 0)?;
    let (gazes, mut rectify) = device.scoped(|| {
        let gazes = Gazes::new(device, canonical, 1)?;
        gazes.write(device, &[gaze])?;
        Ok((gazes, Rectify::new(device)))
    })?;
    let sights = [Sight {
        label: "rectify",
        gazes,
        image: output.clone(),
    }];
    let mut run = async |picture: &Picture| {
        match source {
            Source::Storage => rectify.write(device, &sights, &picture.bytes, &params)?,
            _ => rectify.bind(device, &sights, &picture.planes(device, source)?, &params)?,
        }
        submit(device, |encoder| {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            for step in rectify.steps() {
                step.encode(&mut pass);
            }
        })?;
        output.read_async(device).await
    };
    let colours = match source {
        // Hardware may be half a step of eight bits off in what it decodes; the reference's are rounded.
        Source::Srgb | Source::Nv12 => 0.5 / 255.0,
        Source::Storage | Source::Texture => 0.0,
    };
    Ok(Comparison {
        found: run(&picture).await?,
        control: run(&picture.control(source)).await?,
        // A quarter of a step: a GPU's arc tangent and division place samples less exactly.
        allowed: 1e-3 + colours + rounding_of(expected.data(), layout),
        expected: expected.data().to_vec(),
    })
}

pub(super) async fn overlay(
    device: &Device,
    layout: Layout,
    mut case: Case,
) -> Result<Comparison, GpuError> {
    let shape = case.shape(3);
    let mask_shape = Shape {
        channels: 1,
        ..shape
    };
    let batch = case.random.of(&BATCHES);
    let rule = case.turn(&[
        Overlay::Multiply {},
        Overlay::Threshold { threshold: 0.25 },
        Overlay::Ramp {
            low: 0.25,
            high: 0.75,
        },
    ]);
    let image = storable(case.random.values(batch * shape.len()), layout);
    let mask = storable(case.random.values(batch * mask_shape.len()), layout);
    // Behind the first pixel, a wrong value shows.
    let mask = with_first(&mask, |_| 0.5);

    let tensor = |what, shape| Tensor::in_layout(device, layout, what, shape, batch, 0);
    let (input, second) = (tensor("image", shape)?, tensor("mask", mask_shape)?);
    let output = tensor("output", shape)?;
    let step = device.scoped(|| gpu::overlay(device, &input, &second, &output, rule))?;
    second.write(device, &mask)?;
    let run = async |image: &[f32]| {
        input.write(device, image)?;
        submit(device, |encoder| {
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
        })?;
        output.read_async(device).await
    };
    let expected: Vec<f32> = image
        .chunks_exact(shape.len())
        .zip(mask.chunks_exact(mask_shape.len()))
        .filter_map(|(image, mask)| {
            let image = reference::Tensor::new(shape, image.to_vec())?;
            let mask = reference::Tensor::new(mask_shape, mask.to_vec())?;
            Some(reference::overlay(&image, &mask, rule))
        })
        .flat_map(|output| output.data().to_vec())
        .collect();
    Ok(Comparison {
        found: run(&image).await?,
        control: run(&with_first(&image, |value| value + 2.0)).await?,
        allowed: 1e-6 + rounding_of(&expected, layout),
        expected,
    })
}

/// A buffer of `size` bytes for a kernel's other data.
fn buffer(device: &Device, size: u64, usage: BufferUsages) -> wgpu::Buffer {
    device.wgpu().create_buffer(&wgpu::BufferDescriptor {
        label: Some("verify"),
        size,
        usage: usage | BufferUsages::COPY_DST,
        mapped_at_creation: false,
    })
}

const STORAGE: BufferUsages = BufferUsages::STORAGE.union(BufferUsages::COPY_SRC);

pub(super) async fn coverage(
    device: &Device,
    layout: Layout,
    mut case: Case,
) -> Result<Comparison, GpuError> {
    const THRESHOLDS: (f32, f32) = (0.25, 0.75);
    let shape = case.shape(1);
    let batch = case.random.of(&BATCHES);
    let mut mask = storable(case.random.values(batch * shape.len()), layout);
    let not_finite = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    for (pixel, value) in mask.iter_mut().skip(1).step_by(5).zip(not_finite) {
        *pixel = value;
    }
    let mask = with_first(&mask, |_| 0.0);

    let tensor = Tensor::in_layout(device, layout, "mask", shape, batch, 0)?;
    let (totals, readback, step) = device.scoped(|| {
        let size = (batch * size_of::<Totals>()) as u64;
        let totals = buffer(device, size, STORAGE);
        let readback = buffer(device, size, BufferUsages::MAP_READ);
        let runs = buffer(device, 4, STORAGE);
        let step = gpu::coverage(device, &tensor, &totals, &runs, THRESHOLDS)?;
        Ok((totals, readback, step))
    })?;
    let (width, height) = (shape.width as u32, shape.height as u32);
    let run = async |mask: &[f32]| {
        tensor.write(device, mask)?;
        submit(device, |encoder| {
            encoder.clear_buffer(&totals, 0, None);
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
            encoder.copy_buffer_to_buffer(&totals, 0, &readback, 0, totals.size());
        })?;
        let read = device.read_async(&readback, |bytes| {
            bytemuck::pod_collect_to_vec::<u8, Totals>(bytes)
                .iter()
                .flat_map(|totals| numbers(totals.coverage(width, height)))
                .collect::<Vec<f32>>()
        });
        read.await
    };
    let (threshold, sure) = THRESHOLDS;
    Ok(Comparison {
        found: run(&mask).await?,
        control: run(&with_first(&mask, |_| 1.0)).await?,
        expected: mask
            .chunks_exact(shape.len())
            .filter_map(|mask| reference::Tensor::new(shape, mask.to_vec()))
            .flat_map(|mask| numbers(reference::coverage(&mask, threshold, sure)))
            .collect(),
        allowed: 0.0,
    })
}

/// Counts, and the box's sides; -1 for those of none.
pub(super) fn numbers(coverage: Coverage) -> [f32; 7] {
    let bbox = coverage.bbox.map(|bbox| bbox.map(|v| v as f32));
    let [left, top, right, bottom] = bbox.unwrap_or([-1.0; 4]);
    let counts = [coverage.pixels, coverage.sure, coverage.not_finite];
    let [pixels, sure, not_finite] = counts.map(|v| v as f32);
    [pixels, sure, not_finite, left, top, right, bottom]
}

pub(super) async fn estimate(
    device: &Device,
    layout: Layout,
    mut case: Case,
) -> Result<Comparison, GpuError> {
    const MIN_SURE: u32 = 10;
    const MAX_RADIUS: f32 = 1.5;
    let random = &mut case.random;
    // More than a workgroup's; in a texture, no more planes than WebGPU's have layers.
    let most = if layout == Layout::Texture { 42 } else { 67 };
    let (count, batch) = (random.of(&[1, 6, 7]), random.of(&[5, most]));
    // The first image shows a robot; of the others some do not, and some have impossible joints.
    let totals: Vec<[u32; 7]> = (0..batch)
        .map(|image| match image {
            0 => [80, 20, 0],
            _ => [
                70,
                random.of(&[MIN_SURE - 1, MIN_SURE]),
                random.of(&[0, 0, 0, 1]),
            ],
        })
        .map(|[pixels, sure, not_finite]| [pixels, sure, not_finite, 0, 0, 0, 0])
        .collect();
    let joints: Vec<f32> = (0..batch)
        .flat_map(|image| {
            let farther = if image == 0 { 2.0 } else { 1.2 };
            let joints = (0..count).flat_map(|_| [0.0, 0.0, farther]);
            let joints = joints.map(|middle| middle + random.value());
            joints.collect::<Vec<f32>>()
        })
        .collect();

    let shape = Shape::new(3 * count, 1, 1);
    let tensor = Tensor::in_layout(device, layout, "joints", shape, batch, 0)?;
    let (estimates, readback, step) = device.scoped(|| {
        let size = batch as u64 * gpu::estimate_size(count);
        let filled = |bytes: &[u8]| {
            let buffer = buffer(device, bytes.len() as u64, STORAGE);
            device.queue().write_buffer(&buffer, 0, bytes);
            buffer
        };
        let totals = filled(bytemuck::cast_slice(&totals));
        let radii = filled(bytemuck::cast_slice(&vec![MAX_RADIUS; batch]));
        let estimates = buffer(device, size, STORAGE);
        let readback = buffer(device, size, BufferUsages::MAP_READ);
        let step = gpu::estimate(device, &tensor, &totals, &radii, &estimates, MIN_SURE)?;
        Ok((estimates, readback, step))
    })?;
    let run = async |joints: &[f32]| {
        tensor.write(device, joints)?;
        submit(device, |encoder| {
            step.encode(&mut encoder.begin_compute_pass(&Default::default()));
            encoder.copy_buffer_to_buffer(&estimates, 0, &readback, 0, estimates.size());
        })?;
        let read = device.read_async(&readback, |bytes| {
            let images = bytes.chunks_exact(gpu::estimate_size(count) as usize);
            let image = |bytes: &[u8]| -> Vec<f32> {
                let (head, joints) = bytes.split_at(16);
                let head: Vec<u32> = bytemuck::pod_collect_to_vec(head);
                let joints: Vec<f32> = bytemuck::pod_collect_to_vec(joints);
                head.into_iter()
                    .take(3)
                    .map(|v| v as f32)
                    .chain(joints)
                    .collect()
            };
            images.flat_map(image).collect::<Vec<f32>>()
        });
        read.await
    };
    let expected = totals.iter().zip(joints.chunks_exact(3 * count));
    let expected = expected.flat_map(|(&[pixels, sure, not_finite, ..], joints)| {
        let joints = joints.as_chunks().0;
        let possible = |[x, y, z]: &[f32; 3]| *z > 0.0 && (x / z).hypot(y / z) <= MAX_RADIUS;
        // As `shaders/estimate_layout.wgsl` has it.
        let status = match (not_finite, sure >= MIN_SURE) {
            (0, false) => 0.0,
            (0, true) if joints.iter().all(possible) => 1.0,
            _ => 2.0,
        };
        let joint = move |&[x, y, z]: &[f32; 3]| match status {
            1.0 => [x, y, z, 1.0],
            _ => [0.0; 4],
        };
        let head = [status, pixels as f32, sure as f32];
        head.into_iter().chain(joints.iter().flat_map(joint))
    });
    Ok(Comparison {
        found: run(&joints).await?,
        expected: expected.collect(),
        control: run(&with_first(&joints, |x| x + 0.125)).await?,
        allowed: 0.0,
    })
}

pub(super) async fn unrectify(
    device: &Device,
    layout: Layout,
    mut case: Case,
) -> Result<Comparison, GpuError> {
    let distortion = case.turn(&[Distortion::None, RATIONAL, FISHEYE]);
    let orientation = case.turn(&[Orientation::NoTransforms, Orientation::Rotate90]);
    let random = &mut case.random;
    let side = random.of(&[64, 101, 150]);
    // It sees more than the canonical camera.
    let camera = Camera {
        distortion,
        ..Camera::from_hfov(side, side, 1.6)
    };
    let side_of_mask = random.of(&[33, 40, 61]);
    let shape = Shape::new(1, side_of_mask, side_of_mask);
    let canonical = canonical(shape.width, shape.height);
    let params = Unrectification::new(&camera, &canonical, Crop::whole(side, side), orientation);
    let batch = random.of(&BATCHES);
    let masks = random.values(batch * shape.len());
    let masks: Vec<f32> = masks.iter().map(|v| 0.5 + 0.5 * v).collect();
    let masks = storable(masks, layout);
    let masks = with_first(&masks, |_| 0.0);

    let tensor = Tensor::in_layout(device, layout, "mask", shape, batch, 0)?;
    let row = side.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let (unrectify, readback) = device.scoped(|| {
        let unrectify = Unrectify::new(device, &tensor, 0, &params)?;
        let size = u64::from(row) * u64::from(side);
        Ok((unrectify, buffer(device, size, BufferUsages::MAP_READ)))
    })?;
    let run = async |masks: &[f32]| {
        tensor.write(device, masks)?;
        submit(device, |encoder| {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            unrectify.step().encode(&mut pass);
            drop(pass);
            unrectify.copy(encoder);
            let texture = unrectify.view().texture();
            let layout = wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(row),
                rows_per_image: None,
            };
            let copy = wgpu::TexelCopyBufferInfo {
                buffer: &readback,
                layout,
            };
            encoder.copy_texture_to_buffer(texture.as_image_copy(), copy, texture.size());
        })?;
        let read = device.read_async(&readback, |bytes| {
            let rows = bytes.chunks_exact(row as usize);
            let texels = rows.flat_map(|row| row.iter().take(side as usize));
            texels.map(|&v| f32::from(v) / 255.0).collect::<Vec<f32>>()
        });
        read.await
    };
    let first = masks.iter().copied().take(shape.len()).collect();
    let expected =
        reference::Tensor::new(shape, first).map(|mask| reference::unrectify(&mask, &params));
    Ok(Comparison {
        found: run(&masks).await?,
        expected: expected.unwrap_or_default(),
        control: run(&with_first(&masks, |_| 1.0)).await?,
        // Half a step of eight bits, and a hundredth of a pixel of noise.
        allowed: 0.5 / 255.0 + 0.01,
    })
}
