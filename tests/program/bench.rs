//! The benchmark: that its figures fit each other and the model, that a comparison says what differs, and
//! what it says to bad input. How fast anything is, is not asked.
#![cfg(feature = "cli")]

use std::path::Path;

use crate::common::{coarse, description, model_file};
use crate::known::{XYZ, command, model};
use image::RgbaImage;
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabot::benchmark::{self, Options, Report, Timing, Weights, compare};
use whereabot::camera::{Camera, Rectification};
use whereabot::gpu::{AdapterRequest, Device, GpuError, Plan, Precision};
use whereabot::network::Model;

/// A folder with a model of four layers.
fn folder() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let bytes = model("cube", XYZ, 0.0, &json!({}));
    std::fs::write(folder.path().join("model.safetensors"), bytes).unwrap();
    folder
}

/// Standard output, standard error and the exit code of `bench`.
fn bench(folder: &Path, arguments: &[&str]) -> (String, String, i32) {
    let output = command(folder)
        .arg("bench")
        .args(arguments)
        .output()
        .unwrap();
    (
        String::from_utf8(output.stdout).unwrap(),
        String::from_utf8(output.stderr).unwrap(),
        output.status.code().unwrap(),
    )
}

/// Whether the figures of a report fit each other.
fn consistent(report: &Value) -> Result<(), String> {
    let ensure = |what: &str, fits: bool| fits.then_some(()).ok_or_else(|| what.to_owned());
    let equal = |a: f64, b: f64| (a - b).abs() <= 1e-3 * b.abs() + 1e-9;
    let number = |entry: &Value, key: &str| entry[key].as_f64().ok_or_else(|| key.to_owned());
    ensure("schema", report["schema"] == 1)?;
    for entry in report["cascade"].as_array().unwrap() {
        let mut gflop = 0.0;
        for layer in report["layers"].as_array().unwrap() {
            if layer["batch"] != entry["batch"] {
                continue;
            }
            gflop += number(layer, "gflop")?;
            let ms = number(layer, "ms_p50")?;
            ensure("least", number(layer, "ms_min")? <= ms)?;
            ensure("bytes", number(layer, "mb")? > 0.0)?;
            if ms > 0.0 {
                let operations = number(layer, "gflop_per_s")? * ms / 1e3;
                let bytes = number(layer, "gb_per_s")? * ms;
                ensure("GFLOP/s", equal(operations, number(layer, "gflop")?))?;
                ensure("GB/s", equal(bytes, number(layer, "mb")?))?;
            }
        }
        ensure("sum of GFLOP", equal(gflop, number(entry, "gflop")?))?;
        let batch = number(entry, "batch")?;
        let wall = ["wall_ms_p50", "wall_ms_p95", "wall_ms_p99"].map(|key| number(entry, key));
        let [p50, p95, p99] = wall.map(Result::unwrap);
        ensure("percentiles", 0.0 < p50 && p50 <= p95 && p95 <= p99)?;
        ensure("least", number(entry, "wall_ms_min")? <= p50)?;
        let rate = number(entry, "frames_per_s")?;
        ensure("images a second", equal(rate * p50, 1e3 * batch))?;
        for part in ["upload_ms_p50", "compute_ms_p50", "readback_ms_p50"] {
            let part = entry[part].as_f64().unwrap_or_default();
            ensure("parts", part <= p50)?;
        }
    }
    Ok(())
}

#[test]
fn the_figures_fit_each_other_and_the_model() {
    let folder = folder();
    let arguments = [
        "--weights",
        "model.safetensors",
        "--batch",
        "1,3,1",
        "--frames",
        "3",
        "--json",
        "-",
    ];
    let (stdout, stderr, code) = bench(folder.path(), &arguments);
    assert_eq!(code, 0, "{stderr}");
    let report: Value = serde_json::from_str(&stdout).unwrap();
    consistent(&report).unwrap();
    assert_eq!(report["weights"]["robot"], "cube");
    let features = crate::common::device().wgpu().features();
    let timing = if features.contains(wgpu::Features::TIMESTAMP_QUERY) {
        "timestamps"
    } else {
        "wall"
    };
    assert_eq!(report["timing"], timing);
    assert!(report["start"]["warm_ms"].as_f64().unwrap() > 0.0);
    let adapter = report["adapter"]["name"].as_str().unwrap();
    assert_eq!(adapter, crate::common::device().info().name);

    // 16 x 12 pixels: three channels to one; then 36 values to 18.
    let multiply_adds = 16.0 * 12.0 * 3.0 + 36.0 * 18.0;
    let cascade = report["cascade"].as_array().unwrap();
    let batches: Vec<_> = cascade.iter().map(|entry| &entry["batch"]).collect();
    assert_eq!(batches, [1, 3]);
    for entry in cascade {
        let expected = 2.0 * multiply_adds * entry["batch"].as_f64().unwrap();
        assert_eq!(entry["gflop"].as_f64().unwrap(), expected / 1e9);
        assert_eq!(entry["runs"], 3);
    }
    let layers = report["layers"].as_array().unwrap();
    let conv = layers
        .iter()
        .find(|l| l["layer"] == "mask.conv1" && l["batch"] == 3)
        .unwrap();
    assert!(conv["kernel"].as_str().unwrap().starts_with("conv2d_"));
    let values = 3.0 * (3.0 + 1.0) * 16.0 * 12.0 + 4.0;
    assert_eq!(conv["mb"].as_f64().unwrap(), 4.0 * values / 1e6);

    // The tables are for people, and out of a program's way.
    for part in [
        "adapter",
        "mask.conv1",
        "GFLOP/s",
        "of reach",
        "images/s",
        "cold",
    ] {
        assert!(stderr.contains(part), "{part}: {stderr}");
    }

    // Negative controls: a figure that fits nothing is noticed.
    for (place, what) in [
        ("/schema", "schema"),
        ("/layers/1/gflop", "GFLOP"),
        ("/layers/1/mb", "bytes"),
        ("/cascade/0/gflop", "sum"),
        ("/cascade/1/wall_ms_p95", "percentiles"),
        ("/cascade/1/frames_per_s", "images"),
    ] {
        let mut broken = report.clone();
        *broken.pointer_mut(place).unwrap() = json!(0.0);
        let problem = consistent(&broken).unwrap_err();
        assert!(problem.contains(what), "{place}: {problem}");
    }
    let mut broken = report.clone();
    broken["layers"].as_array_mut().unwrap().remove(1);
    consistent(&broken).unwrap_err();
}

#[test]
fn plain_rust_is_measured_by_the_wall_and_written_to_a_new_file() {
    let folder = folder();
    let arguments = [
        "--weights",
        "model.safetensors",
        "--adapter",
        "cpu",
        "--frames",
        "2",
        "--batch",
        "2",
        "--json",
        "new.json",
        "--plot",
        "new.png",
    ];
    let (stdout, stderr, code) = bench(folder.path(), &arguments);
    assert_eq!(code, 0, "{stderr}");
    let picture = image::open(folder.path().join("new.png")).unwrap();
    // A line a layer, the title and the legend.
    assert!(picture.height() > 22 * 6);
    assert!(stdout.contains("plain Rust") && stdout.contains("mask.conv1"));
    let json = std::fs::read(folder.path().join("new.json")).unwrap();
    let report: Value = serde_json::from_slice(&json).unwrap();
    consistent(&report).unwrap();
    assert_eq!(report["timing"], "wall");
    assert_eq!(report["cascade"][0]["gpu_ms_p50"], Value::Null);
    assert_eq!(report["start"]["cold_ms"], Value::Null);

    // Nothing is overwritten, and that is said before anything is measured.
    let (stdout, stderr, code) = bench(folder.path(), &arguments);
    assert_eq!((stdout.as_str(), code), ("", 1));
    assert!(stderr.contains("new.json: exists already"), "{stderr}");
    assert_eq!(std::fs::read(folder.path().join("new.json")).unwrap(), json);

    // A later run is compared with it, and so are two files.
    let arguments = [
        "--weights",
        "model.safetensors",
        "--adapter",
        "cpu",
        "--frames",
        "1",
        "--batch",
        "2",
        "--compare",
        "new.json",
    ];
    let (stdout, _, code) = bench(folder.path(), &arguments);
    assert_eq!(code, 0);
    assert!(stdout.contains("new  this run") && stdout.contains("ratio"));
    assert!(!stdout.contains("not the same"), "{stdout}");
    let (stdout, _, code) = bench(folder.path(), &["--compare", "new.json", "new.json"]);
    assert_eq!(code, 0);
    assert!(stdout.starts_with("Comparison"), "{stdout}");
    let (_, _, code) = bench(
        folder.path(),
        &["--compare", "new.json", "new.json", "--frames", "1"],
    );
    assert_eq!(code, 2);
}

/// A report of a model of seven convolutions, dense and pools, on the tests' adapter.
fn report(options: &Options) -> Report {
    let bytes = model_file(&description(16, 12, 4), 1);
    let model = Model::from_bytes(&bytes, "random").unwrap();
    let weights = Weights::new(&model, &bytes);
    benchmark::on_gpu(
        &crate::common::device(),
        &model,
        weights,
        options,
        &mut |_| (),
    )
    .unwrap()
}

#[test]
fn a_comparison_says_what_became_of_each_layer_and_what_differs() {
    let old = report(&Options {
        batches: vec![1, 2],
        runs: Some(1),
        ..Options::default()
    });
    let json = serde_json::to_vec(&old).unwrap();
    assert_eq!(Report::from_json(&json).unwrap(), old);

    let ratios = |text: &str| -> Vec<String> {
        let last = |line: &str| line.split_whitespace().last().map(str::to_owned);
        text.lines()
            .filter(|line| line.contains("conv") || line.trim_start().starts_with("all"))
            .filter_map(last)
            .collect()
    };
    let same = compare(("a", "b"), &old, &old);
    assert!(ratios(&same).iter().all(|ratio| ratio == "1.00"), "{same}");
    assert!(!same.contains("not the same"), "{same}");

    // Negative control: each change is told.
    let mut new = old.clone();
    for layer in &mut new.layers {
        layer.ms_p50 *= 3.0;
        layer.ms_min *= 2.0;
    }
    new.adapter.name = "Another".to_owned();
    new.weights.fingerprint = "0123".to_owned();
    new.timing = Timing::Wall;
    new.image = [1, 2];
    new.layers[1].kernel = "winograd".to_owned();
    new.layers[2].layer = "mask.other".to_owned();
    let text = compare(("a", "b"), &old, &new);
    for part in [
        "old  a",
        "new  b",
        "not the same: adapters",
        "not the same: weights",
        "not the same: layers were timed by",
        "not the same: images",
        &format!("{} -> winograd", old.layers[1].kernel),
        "(old only)",
        "(new only)",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    let changed = ratios(&text);
    assert!(changed.iter().all(|ratio| ratio != "1.00"), "{text}");
    assert!(changed.contains(&"2.00".to_owned()), "{text}");

    new.cascade.iter_mut().for_each(|entry| entry.batch = 7);
    assert!(compare(("a", "b"), &old, &new).contains("Nothing to compare"));
}

#[test]
fn without_timestamps_the_wall_clock_is_used_and_named() {
    let report = report(&Options {
        runs: Some(1),
        timestamps: false,
        ..Options::default()
    });
    assert_eq!(report.timing, Timing::Wall);
    assert_eq!(report.cascade[0].gpu_ms_p50, None);
    assert!(report.layers.iter().all(|layer| layer.ms_p50 > 0.0));
    assert!(report.to_string().contains("wall time of each"));
}

#[test]
fn a_plan_hands_out_its_steps_in_order_with_all_their_work() {
    let mut description = description(32, 24, 4);
    description["coarse"] = coarse(json!({"spread": 5, "least": 1, "most": 2}));
    let model = Model::from_bytes(&model_file(&description, 1), "random").unwrap();
    let device = crate::common::device();
    let mut plan = Plan::new(&device, &model, 3, Precision::F32).unwrap();
    // What rectifies is made for the kind of source.
    assert!(
        plan.steps(true)
            .next()
            .unwrap()
            .label()
            .starts_with("coarse.conv1")
    );
    let camera = Camera::from_hfov(40, 30, 1.0);
    let params = Rectification::new(&camera, &model.description.camera, 32, 24);
    for index in 0..3 {
        let image = RgbaImage::new(40, 30);
        plan.write(&device, index, &image, &params).unwrap();
    }
    let macs = |joints| {
        let joint = if joints {
            model.joint_network.macs()
        } else {
            0
        };
        let coarse = model.coarse_network.as_ref().unwrap().macs();
        coarse + model.mask_network.macs() + joint
    };
    for joints in [false, true] {
        let operations: u64 = plan.steps(joints).map(|s| s.work().operations).sum();
        assert_eq!(operations, 2 * 3 * macs(joints));
    }
    let mut labels: Vec<_> = plan.steps(true).map(|step| step.label()).collect();
    labels.dedup();
    assert_eq!(labels[0], "rectify");
    let at = |label| labels.iter().position(|l| *l == label).unwrap();
    assert_eq!(at("coarse.rectify") + 1, at("mask.conv1"));
    assert_eq!(at("mask.conv5") + 1, at("zoom_mask"));
    assert_eq!(labels[labels.len() - 2..], ["joint.dense", "coverage"]);
    assert_eq!(plan.steps(false).last().unwrap().label(), "coverage");
}

/// Encoding cannot make pipelines or bind groups: [`Plan::encode`] has no device. What is left to see is
/// memory.
#[test]
fn a_steady_frame_leaves_nothing_behind() {
    // Of its own: tests run side by side.
    let device = Device::open(&AdapterRequest::new(None, None)).unwrap();
    let model = Model::from_bytes(&model_file(&description(32, 24, 4), 1), "random").unwrap();
    let mut plan = Plan::new(&device, &model, 1, Precision::F32).unwrap();
    let mut frame = |width, height| {
        let camera = Camera::assumed(width, height);
        let rectification = Rectification::new(&camera, &model.description.camera, 32, 24);
        let image = image::RgbaImage::new(width, height);
        plan.write(&device, 0, &image, &rectification).unwrap();
        plan.run(&device, true, true).unwrap();
        device.wgpu().generate_allocator_report().map(|report| {
            let allocations = report.allocations.len();
            (allocations, report.total_allocated_bytes)
        })
    };
    frame(40, 30);
    let first = frame(40, 30);
    for _ in 0..5 {
        assert_eq!(frame(40, 30), first);
    }
    // Negative control: a larger image needs a larger texture.
    assert!(first.is_none() || frame(400, 300) != first);
}

#[test]
fn the_fastest_kernels_are_remembered_in_the_users_cache() {
    let folder = folder();
    let (cache, ours) = (folder.path().join("cache"), "cache/whereabot");
    // Of halves, as between textures there is nothing to find out.
    let run = |arguments: &[&str]| {
        let given = ["bench", "--precision", "f16", "--frames", "1"];
        let output = command(folder.path())
            .args(given)
            .args(["--weights", "model.safetensors"])
            .args(arguments)
            .env("XDG_CACHE_HOME", &cache)
            .output()
            .unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{stderr}");
        assert!(!stderr.contains("not used"), "{stderr}");
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(run(&["--no-tuning"]).contains("f16"));
    let file = |begin: &str| {
        let files = std::fs::read_dir(folder.path().join(ours))
            .into_iter()
            .flatten();
        let mut paths = files.map(|entry| entry.unwrap().path());
        paths.find(|path| {
            path.file_name()
                .unwrap()
                .to_str()
                .unwrap()
                .starts_with(begin)
        })
    };
    assert!(file("tuning").is_none());
    // What the driver compiled is kept where the backend gives it; what is damaged is compiled again.
    let pipelines = file("pipelines");
    if let Some(file) = &pipelines {
        std::fs::write(file, "damaged").unwrap();
    }
    run(&[]);
    if let Some(file) = &pipelines {
        assert!(std::fs::read(file).unwrap().len() > 8);
    }
    let file = &file("tuning").unwrap();
    let first = std::fs::read_to_string(file).unwrap();
    assert!(first.contains("conv2d_"), "{first}");
    // What is known stays, whatever was left to find out; what is corrupt is found out again.
    run(&[]);
    let second = std::fs::read_to_string(file).unwrap();
    let known = first.lines().filter(|line| line.contains("conv2d_"));
    for line in known {
        assert!(
            second.contains(line.trim_end_matches(',')),
            "{line}: {second}"
        );
    }
    std::fs::write(file, "{").unwrap();
    run(&[]);
    assert!(std::fs::read_to_string(file).unwrap().contains("conv2d_"));
}

#[test]
fn bad_input_is_an_error_that_says_what_was_expected() {
    let folder = folder();
    std::fs::write(folder.path().join("corrupt.json"), "{\"schema\": 1, ").unwrap();
    std::fs::write(folder.path().join("later.json"), "{\"schema\": 2}").unwrap();
    std::fs::write(folder.path().join("partial.json"), "{\"schema\": 1}").unwrap();
    for (arguments, code, parts) in [
        (["--batch", "0"], 2, ["--batch", "0"]),
        (["--batch", "1,x"], 2, ["--batch", "x"]),
        (["--frames", "0"], 2, ["--frames", "0"]),
        (["--precision", "f64"], 2, ["--precision", "f64"]),
        (
            ["--precision=f32,f16", "--adapter=cpu"],
            1,
            ["precision f16", "f32 only"],
        ),
        (
            ["--batch", "100000000"],
            1,
            ["batch of 100000000", "allows"],
        ),
        (
            ["--adapter", "no such card"],
            2,
            ["no such card", "there are"],
        ),
        (["--compare", "missing.json"], 1, ["missing.json", "read"]),
        (["--compare", "corrupt.json"], 1, ["corrupt.json", "JSON"]),
        (
            ["--compare", "later.json"],
            1,
            ["later.json", "expected 1, found 2"],
        ),
        (
            ["--compare", "partial.json"],
            1,
            ["partial.json", "missing field"],
        ),
        (["--json", "no/such/folder.json"], 1, ["no/such", "folder"]),
        (
            ["--json", "model.safetensors"],
            1,
            ["model.safetensors", "exists"],
        ),
    ] {
        let given = ["--weights", "model.safetensors"];
        let (stdout, stderr, found) = bench(folder.path(), &[given, arguments].concat());
        assert_eq!(found, code, "{arguments:?}: {stderr}");
        assert_eq!(stdout, "", "{arguments:?}");
        for part in parts {
            assert!(stderr.contains(part), "{arguments:?}: {stderr}");
        }
    }
    let (_, stderr, code) = bench(folder.path(), &["--weights", "missing.safetensors"]);
    assert_eq!(code, 1);
    assert!(stderr.contains("missing.safetensors"), "{stderr}");
}

#[test]
fn a_batch_that_does_not_fit_is_a_typed_error() {
    let bytes = model_file(&description(16, 12, 4), 1);
    let model = Model::from_bytes(&bytes, "random").unwrap();
    let options = Options {
        batches: vec![1 << 30],
        ..Options::default()
    };
    let weights = Weights::new(&model, &bytes);
    let error = benchmark::on_gpu(
        &crate::common::device(),
        &model,
        weights,
        &options,
        &mut |_| (),
    )
    .unwrap_err();
    assert!(matches!(
        error,
        benchmark::BenchmarkError::Batch {
            batch: 1_073_741_824,
            cause: GpuError::Limit { .. }
        }
    ));
}
