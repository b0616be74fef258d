use image::RgbaImage;

use super::clock::now_ms;
use super::report::{Adapter, Program};
use super::statistics::{Sample, rounded};
use super::{
    BenchmarkError, CascadeFigures, IMAGE, LayerFigures, LayerWork, Options, Progress, Report,
    Timing, Weights, rectification, source,
};
use crate::camera::{Gaze, Rectification};
use crate::cascade::LocateError;
use crate::gpu::{Precision, Work};
use crate::network::{Model, Network, Node, Shape, Source};
use crate::reference;

pub(super) fn measure(
    model: &Model,
    weights: Weights,
    options: &Options,
    progress: Progress<'_>,
) -> Result<Report, BenchmarkError> {
    for &precision in &options.precisions {
        if precision != Precision::F32 {
            return Err(BenchmarkError::Precision(precision));
        }
    }
    let mut report = Report {
        schema: Report::SCHEMA,
        program: Program::this(),
        adapter: Adapter::cpu(),
        weights,
        image: [IMAGE.0, IMAGE.1],
        timing: Timing::Wall,
        roofline: None,
        layers: Vec::new(),
        cascade: Vec::new(),
        start: None,
    };
    for &batch in &options.batches {
        progress(&format!("batch {batch}, {}", Precision::F32));
        let (cascade, layers) = batch_figures(model, batch, options)?;
        report.cascade.push(cascade);
        report.layers.extend(layers);
    }
    Ok(report)
}

fn batch_figures(
    model: &Model,
    batch: usize,
    options: &Options,
) -> Result<(CascadeFigures, Vec<LayerFigures>), BenchmarkError> {
    let image = source();
    let rectification = rectification(model);
    // Layers in turn, image by image: the sum of a batch's times is a layer's time.
    let run = || -> Result<Vec<f64>, LocateError> {
        let mut sums: Vec<f64> = Vec::new();
        for _ in 0..batch {
            let times = layer_times(model, &image, &rectification)?;
            sums.resize(times.len(), 0.0);
            for (sum, ms) in sums.iter_mut().zip(times) {
                *sum += ms;
            }
        }
        Ok(sums)
    };
    let start = now_ms();
    run()?;
    let first_ms = now_ms() - start;

    let works = layer_works(model, batch);
    let mut layers = vec![Sample::default(); works.len()];
    let mut wall = Sample::default();
    let start = now_ms();
    let mut runs = 0;
    while !options.enough(runs, now_ms() - start) {
        let begin = now_ms();
        let times = run()?;
        wall.push(now_ms() - begin);
        for (sample, ms) in layers.iter_mut().zip(times) {
            sample.push(ms);
        }
        runs += 1;
    }
    let [p50, min, p95, p99] =
        [0.5, 0.0, 0.95, 0.99].map(|share| wall.percentile(share).unwrap_or_default());
    let operations: u64 = works.iter().map(|layer| layer.work.operations).sum();
    let figures = CascadeFigures {
        batch,
        precision: Precision::F32,
        runs,
        gflop: operations as f64 / 1e9,
        gpu_ms_p50: None,
        gpu_ms_min: None,
        wall_ms_p50: rounded(p50),
        wall_ms_min: rounded(min),
        wall_ms_p95: rounded(p95),
        wall_ms_p99: rounded(p99),
        upload_ms_p50: None,
        compute_ms_p50: None,
        readback_ms_p50: None,
        cpu_us_p50: None,
        frames_per_s: rounded(batch as f64 * 1e3 / p50),
        memory_mb: None,
        plan_ms: None,
        first_ms: rounded(first_ms),
    };
    let layers = works
        .into_iter()
        .zip(&layers)
        .map(|(layer, sample)| layer.figures(batch, Precision::F32, sample, None))
        .collect();
    Ok((figures, layers))
}

/// Milliseconds of each layer of [`layer_works`], for one image.
fn layer_times(
    model: &Model,
    image: &RgbaImage,
    rectification: &Rectification,
) -> Result<Vec<f64>, LocateError> {
    let mut times = Vec::new();
    let mut last = now_ms();
    let mut lap = || {
        let now = now_ms();
        times.push(now - last);
        last = now;
    };
    let shape = model.mask_network.input();
    let rectified =
        |gaze: &Gaze| reference::rectify(image, rectification, gaze, shape.height, shape.width);
    let image = rectified(&Gaze::CANONICAL);
    lap();
    let description = &model.description;
    let run = |network, image: &reference::Tensor, lap: &mut dyn FnMut()| {
        reference::run_each(network, image, |_| lap()).and_then(|mut outputs| outputs.pop())
    };
    let masked = |image: &reference::Tensor, lap: &mut dyn FnMut()| {
        run(&model.mask_network, image, lap).ok_or(LocateError::Shape("mask network"))
    };
    let mask = match model.coarse() {
        None => masked(&image, &mut lap)?,
        Some((network, zoom)) => {
            let coarse = run(network, &image, &mut lap);
            let coarse = coarse.ok_or(LocateError::Shape("coarse network"))?;
            let camera = &description.camera;
            let gaze = reference::mask_gaze(&coarse, camera, zoom);
            lap();
            let seen = rectified(&gaze);
            lap();
            let closer = masked(&seen, &mut lap)?;
            let mask = reference::zoom_mask(&closer, &coarse, camera, &gaze);
            lap();
            mask
        }
    };
    let presence = description.presence;
    reference::coverage(&mask, presence.mask_threshold, presence.sure_threshold);
    lap();
    let (masked, gaze) = reference::joint_input(&image, &mask, description);
    lap();
    let joints = run(&model.joint_network, &masked, &mut lap);
    let joints = joints.ok_or(LocateError::Shape("joint network"))?;
    let mut joints = joints.data().to_vec();
    if let Some(gaze) = gaze {
        joints = reference::zoom_joints(&joints, &gaze);
        lap();
    }
    if let Some(arm) = &description.arm {
        reference::kinematic_fit(&joints, arm);
        lap();
    }
    Ok(times)
}

/// The cascade's layers in order.
fn layer_works(model: &Model, batch: usize) -> Vec<LayerWork> {
    let image = model.mask_network.input();
    let mask = model.mask_network.output();
    let between = |name: &str, values: usize| LayerWork {
        layer: name.to_owned(),
        kernel: name.to_owned(),
        work: Work {
            operations: 0,
            bytes: (4 * batch * values) as u64,
        },
    };
    // Pixels have four bytes, as values have.
    let pixels = IMAGE.0 as usize * IMAGE.1 as usize;
    let rectify = |name| between(name, pixels + image.len());
    let mut layers = vec![rectify("rectify")];
    if let Some(network) = &model.coarse_network {
        layers.extend(network_works("coarse", network, batch));
        layers.push(between("coarse.zoom", mask.len()));
        layers.push(rectify("coarse.rectify"));
    }
    layers.extend(network_works("mask", &model.mask_network, batch));
    if model.coarse_network.is_some() {
        layers.push(between("zoom_mask", 3 * mask.len()));
    }
    layers.push(between("coverage", mask.len()));
    let zooms = model.description.zoom.is_some();
    let name = if zooms { "zoom_overlay" } else { "overlay" };
    layers.push(between(name, 2 * image.len() + mask.len()));
    layers.extend(network_works("joint", &model.joint_network, batch));
    let joints = 2 * model.joint_network.output().len();
    if zooms {
        layers.push(between("zoom_joints", joints));
    }
    if model.description.arm.is_some() {
        layers.push(between("kinematic_fit", joints));
    }
    layers
}

fn network_works<'a>(
    name: &'a str,
    network: &'a Network,
    batch: usize,
) -> impl Iterator<Item = LayerWork> + 'a {
    let shape = |source: &Source| -> Shape {
        match source {
            Source::Input => network.input(),
            Source::Layer(index) => network
                .nodes()
                .get(*index)
                .map_or(network.input(), |node| node.output),
        }
    };
    network.nodes().iter().map(move |node: &Node| {
        let read: usize = node.sources.iter().map(|source| shape(source).len()).sum();
        let parameters = node
            .parameters
            .as_ref()
            .map_or(0, |p| p.weight.len() + p.bias.len());
        LayerWork {
            layer: format!("{name}.{}", node.layer.name),
            kernel: node.layer.operation.name().to_owned(),
            work: Work {
                operations: 2 * batch as u64 * node.layer.operation.macs(node.input),
                bytes: 4 * (batch * (read + node.output.len()) + parameters) as u64,
            },
        }
    })
}
