//! The shipped weights on the bundled images: kernels against reference, and both against the truth.

use std::path::{Path, PathBuf};

use crate::common::{device, difference, joints};
use image::RgbaImage;
use whereabot::camera::Camera;
use whereabot::cascade::{Locator, Output, Status};
use whereabot::draw;
use whereabot::gpu::Precision;
use whereabot::network::Model;
use whereabot::reference;

fn root(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn model(robot: &str) -> Model {
    Model::load(root(&format!("weights/{robot}.safetensors"))).unwrap()
}

fn camera() -> Camera {
    Camera::load(root("examples/images/camera_info.yaml")).unwrap()
}

fn sample(name: &str) -> RgbaImage {
    image::open(root(&format!("examples/images/{name}.jpg")))
        .unwrap()
        .into_rgba8()
}

const ROBOTS: [(&str, &[&str]); 3] = [
    ("ur3", &["ur3_1", "ur3_2"]),
    (
        "ur5",
        &["ur5_1", "ur5_2", "ur5_3", "ur5_4", "ur5_5", "ur5_6"],
    ),
    ("ur10", &["ur10_1", "ur10_2"]),
];
const WITH_MASK: Output = Output {
    mask: true,
    mask_only: false,
};

#[test]
fn every_file_in_weights_loads() {
    let files: Vec<PathBuf> = std::fs::read_dir(root("weights"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "safetensors"))
        .collect();
    assert!(!files.is_empty());
    for file in files {
        Model::load(&file).unwrap();
    }
}

#[test]
fn gpu_and_reference_agree_on_photos() {
    let model = model("ur5");
    let mut gpu = Locator::on_gpu(device(), &model, Precision::F32).unwrap();
    let mut cpu = Locator::on_cpu(&model);
    let mut first = None;
    for name in ["ur5_1", "ur5_4", "no_robot"] {
        let gpu = gpu.locate(&sample(name), &camera(), WITH_MASK).unwrap();
        let cpu = cpu.locate(&sample(name), &camera(), WITH_MASK).unwrap();
        let (mask, expected) = (gpu.mask.clone().unwrap(), cpu.mask.clone().unwrap());
        let found = difference(&mask.probability, &expected.probability).unwrap();
        assert!(found <= 1e-4, "{name}: mask differs by {found}");
        assert_eq!(gpu.status, cpu.status, "{name}");
        // 0.1 mm
        let found = difference(&joints(&gpu), &joints(&cpu)).unwrap();
        assert!(found <= 1e-4, "{name}: joints differ by {found} m");
        // Negative control: another picture's answer.
        let (other_mask, other_joints) =
            first.get_or_insert((mask.probability.clone(), joints(&gpu)));
        if name == "ur5_4" {
            assert!(difference(other_mask, &mask.probability).unwrap() > 1e-2);
            assert!(difference(other_joints, &joints(&gpu)).unwrap() > 1e-2);
        }
    }
}

/// How much of each pixel the joint network is shown behind a mask.
fn shown(model: &Model, probability: &[f32]) -> Vec<f32> {
    let one = model.mask_network.output();
    let mask = reference::Tensor::new(one, probability.to_vec()).unwrap();
    let white = reference::Tensor::full(one, 1.0);
    let (seen, _) = reference::joint_input(&white, &mask, &model.description);
    seen.data().to_vec()
}

#[test]
fn halves_say_the_same() {
    // Joints move with what the overlay lets through: by less than half a millimetre for a whole pixel more or less.
    for (name, images) in ROBOTS {
        let model = model(name);
        let [mut full, mut half] = [Precision::F32, Precision::F16]
            .map(|precision| Locator::on_gpu(device(), &model, precision).unwrap());
        let mut before: Option<(Vec<bool>, Vec<f32>)> = None;
        for image in images {
            let [full, half] = [&mut full, &mut half].map(|locator| {
                let estimate = locator
                    .locate(&sample(image), &camera(), WITH_MASK)
                    .unwrap();
                let threshold = model.description.presence.mask_threshold;
                let probability = &estimate.mask.as_ref().unwrap().probability;
                let mask: Vec<bool> = probability.iter().map(|p| *p >= threshold).collect();
                (
                    estimate.status,
                    mask,
                    joints(&estimate),
                    shown(&model, probability),
                )
            });
            assert_eq!(full.0, half.0, "{name}, {image}");
            let overlap = iou(&full.1, &half.1);
            assert!(overlap >= 0.99, "{name}, {image}: IoU {overlap}");
            let metres = difference(&full.2, &half.2).unwrap();
            let moved: f32 = full.3.iter().zip(&half.3).map(|(a, b)| (a - b).abs()).sum();
            println!(
                "{name}, {image}: IoU {overlap:.4}, {moved:.2} pixels more or less, joints differ by {metres} m"
            );
            assert!(
                metres <= 1e-4 + 5e-4 * moved,
                "{name}, {image}: joints differ by {metres} m"
            );
            // Negative control: another picture's answer.
            if let Some((mask, joints)) = before.replace((half.1, half.2)) {
                assert!(iou(&full.1, &mask) < 0.9, "{name}, {image}");
                assert!(difference(&full.2, &joints).unwrap_or(1.0) > 1e-2);
            }
        }
    }
}

/// Share of pixels in both among those in either.
fn iou(a: &[bool], b: &[bool]) -> f64 {
    let count = |both: fn(bool, bool) -> bool| {
        a.iter().zip(b).filter(|&(&a, &b)| both(a, b)).count() as f64
    };
    count(|a, b| a && b) / count(|a, b| a || b).max(1.0)
}

#[test]
fn the_robot_is_found_where_it_is() {
    let truth: serde_json::Value =
        serde_json::from_slice(&std::fs::read(root("tests/data/samples/truth.json")).unwrap())
            .unwrap();
    let robot = |mask: &image::GrayImage| mask.iter().map(|&v| v > 0).collect::<Vec<_>>();
    let mut before: Option<Vec<bool>> = None;
    let (mut total_iou, mut total_error, mut count) = (0.0, 0.0, 0.0);
    for (name, images) in ROBOTS {
        let model = model(name);
        let mut locator = Locator::on_gpu(device(), &model, Precision::F32).unwrap();
        for image in images {
            let estimate = locator
                .locate(&sample(image), &camera(), WITH_MASK)
                .unwrap();
            assert_eq!(estimate.status, Status::Found, "{image}");
            let found = draw::mask_image(
                estimate.mask.as_ref().unwrap(),
                &model.description.camera,
                &camera(),
                Some(model.description.presence.mask_threshold),
            );
            let expected = image::open(root(&format!("tests/data/samples/{image}.mask.png")))
                .unwrap()
                .into_luma8();
            let (found, expected) = (robot(&found), robot(&expected));
            let error = estimate
                .joints
                .iter()
                .enumerate()
                .map(|(index, joint)| {
                    let at = |axis: usize| truth[*image]["joints_m"][index][axis].as_f64().unwrap();
                    (0..3)
                        .map(|axis| (joint.xyz_m[axis] - at(axis)).powi(2))
                        .sum::<f64>()
                        .sqrt()
                })
                .sum::<f64>()
                / estimate.joints.len() as f64;
            let overlap = iou(&found, &expected);
            println!(
                "{image}: IoU {overlap:.3}, joints off by {:.1} cm",
                100.0 * error
            );
            total_iou += overlap;
            total_error += error;
            count += 1.0;
            // Negative control: the mask of the picture before does not pass.
            if let Some(other) = before.replace(found) {
                assert!(iou(&other, &expected) < 0.45, "{image}");
            }
        }
    }
    assert!(total_iou / count >= 0.7, "{}", total_iou / count);
    assert!(total_error / count <= 0.15, "{}", total_error / count);
}

#[test]
fn without_a_robot_nothing_is_found() {
    let mut locator = Locator::on_gpu(device(), &model("ur5"), Precision::F32).unwrap();
    let estimate = locator
        .locate(&sample("no_robot"), &camera(), WITH_MASK)
        .unwrap();
    assert_eq!(estimate.status, Status::NotFound);
    assert!(estimate.joints.is_empty());
}
