//! Verifying an adapter: that everything is compared, that each comparison proves itself, and what the command
//! says.
#![cfg(feature = "cli")]

use std::collections::BTreeSet;
use std::path::Path;

use crate::common::device;
use crate::known::{XYZ, command, model};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabot::benchmark::{Adapter, Weights};
use whereabot::gpu::{AdapterRequest, Device, Precision};
use whereabot::network::Model;
use whereabot::verification::{Outcome, Report, Verdict, verify};

/// A model whose joints follow what is behind the mask by `gain`.
fn with_gain(gain: f32) -> Vec<u8> {
    model("cube", XYZ, gain, &json!({}))
}

/// What `device` gives with a small model, and the progress that it told.
fn report(device: &Device) -> (Report, Vec<(usize, usize)>) {
    let bytes = with_gain(0.01);
    let model = Model::from_bytes(&bytes, "model").unwrap();
    let weights = Weights::new(&model, &bytes);
    let mut told = Vec::new();
    let mut progress = |done, count, _: &str| told.push((done, count));
    let both = [Precision::F32, Precision::F16];
    let adapter = Adapter::of(device);
    let report = verify(device, adapter, &model, weights, &both, &mut progress);
    let report = pollster::block_on(report);
    (report, told)
}

/// The kernels in `shaders/` that layers and the stages between the networks are made of.
fn kernels() -> BTreeSet<String> {
    // Parts of others, what measures an adapter, and what renders recordings.
    let others = [
        "conv2d_lattice",
        "conv2d_matrix",
        "conv2d_pixels",
        "conv2d_planes",
        "conv2d_pooled",
        "conv2d_rows",
        "estimate_layout",
        "gaze",
        "layout",
        "overlay_share",
        "probe_arithmetic",
        "probe_copy",
        "rectify",
        "render",
        "zoom_camera",
    ];
    std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned())
        .filter(|name| !others.contains(&name.as_str()))
        .collect()
}

#[test]
fn every_kernel_and_the_cascade_agree_and_each_comparison_proves_itself() {
    let (report, told) = report(&device());
    assert_eq!(report.verdict, Verdict::Agrees, "{report}");

    let mut expected = kernels();
    expected.extend(["mask", "coverage", "joints"].map(|part| format!("cascade.{part}")));
    let name = |subject: &str| subject.split('/').next().unwrap().to_owned();
    let subjects: BTreeSet<_> = report.checks.iter().map(|c| name(&c.subject)).collect();
    assert_eq!(subjects, expected);
    for check in &report.checks {
        match &check.outcome {
            Outcome::Agrees(figures) => {
                assert!(figures.difference <= figures.allowed && figures.cases > 1);
                assert!(figures.control > figures.allowed, "{check:?}");
            }
            Outcome::CannotRun { .. } => assert!(check.subject.starts_with("conv2d"), "{check:?}"),
            other => panic!("{other}"),
        }
    }

    let text = report.to_string();
    assert!(text.ends_with(&format!("\n{}\n", report.line)), "{text}");
    for part in [&report.adapter.name, &report.program.version, "agrees"] {
        assert!(report.line.contains(part), "{}", report.line);
    }
    // One after the other, and never beyond the count.
    let count = told[0].1;
    assert!(
        told.iter()
            .copied()
            .eq((0..count).map(|done| (done, count)))
    );
}

#[test]
fn a_lost_device_agrees_with_nothing() {
    let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
    device.wgpu().destroy();
    let (report, _) = report(&device);
    assert_eq!(report.verdict, Verdict::Disagrees);
    assert!(report.line.contains("DISAGREES") && report.line.contains("FAILED"));
    let without_figures = |outcome: &Outcome| outcome.figures().is_none();
    assert!(
        report
            .checks
            .iter()
            .all(|check| without_figures(&check.outcome)),
        "{report}"
    );
}

/// A folder with that model.
fn folder(gain: f32) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("model.safetensors"), with_gain(gain)).unwrap();
    folder
}

/// Standard output, standard error and the exit code of `verify` on the model in `folder`.
fn run(folder: &Path, arguments: &[&str]) -> (String, String, i32) {
    let output = command(folder)
        .args(["verify", "--weights", "model.safetensors"])
        .args(arguments)
        .output()
        .unwrap();
    (
        String::from_utf8(output.stdout).unwrap(),
        String::from_utf8(output.stderr).unwrap(),
        output.status.code().unwrap(),
    )
}

#[test]
fn the_command_tells_programs() {
    let folder = folder(0.01);
    let (stdout, stderr, code) = run(folder.path(), &["--json", "--precision", "f32"]);
    assert_eq!(code, 0, "{stdout}{stderr}");
    let report: Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(report["schema"], 1);
    assert_eq!(report["verdict"], "agrees");
    assert_eq!(report["weights"]["robot"], "cube");
    assert!(report["line"].as_str().unwrap().contains("agrees"));
    let checks = report["checks"].as_array().unwrap();
    assert!(checks.iter().all(|check| check["precision"] == "f32"));
    let sigmoid = checks
        .iter()
        .find(|check| check["subject"] == "sigmoid")
        .unwrap();
    assert_eq!(sigmoid["outcome"], "agrees");
    assert!(sigmoid["control"].as_f64().unwrap() > sigmoid["allowed"].as_f64().unwrap());
}

#[test]
fn what_cannot_be_proven_is_a_failure() {
    // Joints that are the same whatever the picture.
    let folder = folder(0.0);
    let (stdout, _, code) = run(folder.path(), &["--precision", "f32"]);
    assert_eq!(code, 1, "{stdout}");
    let last = stdout.lines().last().unwrap();
    assert!(
        last.contains("DISAGREES") && last.contains("cascade.joints"),
        "{last}"
    );
    assert!(last.contains("UNPROVEN"), "{last}");
}

#[test]
fn wrong_usage_exits_with_2_and_missing_weights_with_1() {
    let folder = folder(0.0);
    for arguments in [
        &["--adapter", "cpu"],
        &["--adapter", "no such card"],
        &["--backend", "glide"],
        &["--precision", "f64"],
    ] {
        let (stdout, stderr, code) = run(folder.path(), arguments);
        assert_eq!(code, 2, "{stderr}");
        assert!(
            stdout.is_empty() && stderr.contains(arguments[1]),
            "{stderr}"
        );
    }
    let (_, stderr, _) = run(folder.path(), &["--adapter", "cpu"]);
    assert!(stderr.contains("Usage: whereabot verify"), "{stderr}");
    std::fs::remove_file(folder.path().join("model.safetensors")).unwrap();
    let (_, stderr, code) = run(folder.path(), &[]);
    assert_eq!(code, 1);
    assert!(stderr.contains("model.safetensors"), "{stderr}");
}
