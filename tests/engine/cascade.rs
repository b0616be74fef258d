//! The whole cascade: GPU against reference, on the paper's shape at its size.

use crate::common::{
    Driver, coarse, description, device, difference, driver, joints, model_file, noise,
};
use image::RgbaImage;
use whereabot::camera::{Camera, Rectification};
use whereabot::cascade::{
    BatchImage, BatchLocator, BatchOptions, Estimate, HostLocator, HostOptions, LocateError,
    Locator, Mask, Output, Status,
};
use whereabot::gpu::{Frame, GpuError, Plan, Precision};
use whereabot::network::{Layer, Model, Network, Operation};

const ALL: Output = Output {
    mask: true,
    mask_only: false,
};

/// The keys of a description that turn a network's camera.
const LOOKS: [&str; 2] = ["coarse", "zoom"];

/// A random model that finds a robot in everything, so that there are joints to compare; with these [`LOOKS`].
fn model(seed: u64, looks: &[&str]) -> Model {
    let mut description = looking(description(256, 212, 32), looks);
    description["presence"]["min_sure"] = 0.0.into();
    Model::from_bytes(&model_file(&description, seed), "random").unwrap()
}

/// `description` with these [`LOOKS`].
fn looking(mut description: serde_json::Value, looks: &[&str]) -> serde_json::Value {
    for &look in looks {
        description[look] = match look {
            "coarse" => coarse(zoomed()),
            _ => zoomed(),
        };
    }
    description
}

/// A random mask covers half of everywhere: near enough to show something else than the image.
fn zoomed() -> serde_json::Value {
    serde_json::json!({"spread": 2.0, "least": 0.5, "most": 4.0})
}

/// Smooth colours with some noise, as a photo has.
fn picture(width: u32, height: u32, seed: u64) -> RgbaImage {
    let grain = noise((width * height) as usize, seed);
    RgbaImage::from_fn(width, height, |x, y| {
        let wave = |f: f32, p: f32| 110.0 + 80.0 * (x as f32 * f + y as f32 * (0.07 - f) + p).sin();
        let g = 20.0 * grain[(y * width + x) as usize];
        image::Rgba(
            [
                wave(0.05, 0.0) + g,
                wave(0.02, 1.0) + g,
                wave(0.04, 2.0) + g,
                255.0,
            ]
            .map(|v| v as u8),
        )
    })
}

fn mask(estimate: &Estimate) -> &[f32] {
    &estimate.mask.as_ref().unwrap().probability
}

#[test]
fn gpu_and_reference_agree() {
    for (seed, width, height, looks) in [
        (1, 512, 424, &[][..]),
        (2, 640, 480, &[]),
        (3, 300, 700, &[]),
        (2, 640, 480, &LOOKS),
    ] {
        let model = model(seed, looks);
        let image = picture(width, height, seed);
        let camera = Camera::from_hfov(width, height, 70_f64.to_radians());
        let gpu = Locator::on_gpu(device(), &model, Precision::F32)
            .unwrap()
            .locate(&image, &camera, ALL)
            .unwrap();
        let cpu = Locator::on_cpu(&model)
            .locate(&image, &camera, ALL)
            .unwrap();
        assert!(difference(mask(&gpu), mask(&cpu)).unwrap() <= 1e-4);
        assert_eq!((gpu.status, cpu.status), (Status::Found, Status::Found));
        // 0.1 mm
        assert!(difference(&joints(&gpu), &joints(&cpu)).unwrap() <= 1e-4);
    }
}

#[test]
fn another_picture_is_noticed() {
    let model = model(1, &[]);
    let camera = Camera::from_hfov(512, 424, 70_f64.to_radians());
    let mut locator = Locator::on_gpu(device(), &model, Precision::F32).unwrap();
    let first = locator.locate(&picture(512, 424, 1), &camera, ALL).unwrap();
    let second = locator.locate(&picture(512, 424, 9), &camera, ALL).unwrap();
    let again = locator.locate(&picture(512, 424, 1), &camera, ALL).unwrap();
    assert!(difference(mask(&first), mask(&second)).unwrap() > 1e-3);
    assert!(difference(&joints(&first), &joints(&second)).unwrap() > 1e-3);
    assert_eq!(first, again);
}

#[test]
fn a_batch_gives_what_single_images_give() {
    for looks in [&[][..], &LOOKS] {
        let description = looking(description(48, 40, 5), looks);
        let model = Model::from_bytes(&model_file(&description, 4), "random").unwrap();
        gives_what_single_images_give(&model);
    }
}

fn gives_what_single_images_give(model: &Model) {
    let device = device();
    let sizes = [(48, 40), (61, 33), (100, 90)];
    let frames = |batch: &[(u32, u32)]| -> Vec<Frame> {
        let mut plan = Plan::new(&device, model, batch.len(), Precision::F32).unwrap();
        for (index, &(width, height)) in batch.iter().enumerate() {
            let camera = Camera::from_hfov(width, height, 1.2);
            let image = picture(width, height, width.into());
            let params = Rectification::new(&camera, &model.description.camera, 48, 40);
            plan.write(&device, index, &image, &params).unwrap();
        }
        plan.run(&device, true, true).unwrap()
    };
    let together = frames(&sizes);
    assert_eq!(together.len(), 3);
    for (size, frame) in sizes.iter().zip(&together) {
        let alone = frames(&[*size]);
        assert_eq!(alone[0].coverage, frame.coverage);
        assert!(difference(&alone[0].mask, &frame.mask).unwrap() <= 1e-6);
        assert!(difference(&alone[0].joints, &frame.joints).unwrap() <= 1e-6);
    }
    // Negative control: the images differ.
    assert!(difference(&together[0].mask, &together[1].mask).unwrap() > 1e-3);
    assert!(matches!(
        Plan::new(&device, model, 1, Precision::F32).unwrap().write(
            &device,
            1,
            &picture(48, 40, 1),
            &Rectification::new(
                &Camera::from_hfov(48, 40, 1.0),
                &model.description.camera,
                48,
                40
            )
        ),
        Err(GpuError::Size { .. })
    ));
}

#[test]
fn only_what_was_asked_for_is_answered() {
    let model = Model::from_bytes(&model_file(&description(48, 40, 5), 4), "random").unwrap();
    let camera = Camera::from_hfov(48, 40, 1.2);
    let image = picture(48, 40, 1);
    for mut locator in [
        Locator::on_gpu(device(), &model, Precision::F32).unwrap(),
        Locator::on_cpu(&model),
    ] {
        let mask_only = Output {
            mask: false,
            mask_only: true,
        };
        let found = locator.locate(&image, &camera, mask_only).unwrap();
        assert!(found.joints.is_empty() && found.mask.is_none());
        let all = locator.locate(&image, &camera, ALL).unwrap();
        assert_eq!(all.mask.unwrap().probability.len(), 48 * 40);
    }
}

/// A model whose mask is `value` everywhere, and whose joints are `joint` metres in x, y and z.
fn constant(value: f32, joint: f32) -> Model {
    let description = description(48, 40, 4);
    let bytes = model_file(&description, 1);
    let mut model = Model::from_bytes(&bytes, "constant").unwrap();
    let fill = |network: &Network, input: &str, last: f32| {
        let layers: Vec<_> = network.nodes().iter().map(|n| n.layer.clone()).collect();
        let count_with_parameters = network
            .nodes()
            .iter()
            .filter(|n| n.parameters.is_some())
            .count();
        let mut index = 0;
        Network::new(input, network.input(), layers, |_, weight, bias| {
            index += 1;
            Ok(whereabot::network::Parameters {
                weight: vec![0.0; weight.iter().product()],
                bias: vec![
                    if index == count_with_parameters {
                        last
                    } else {
                        0.0
                    };
                    bias[0]
                ],
            })
        })
        .unwrap()
    };
    model.mask_network = fill(&model.mask_network, "image", (value / (1.0 - value)).ln());
    model.joint_network = fill(&model.joint_network, "overlay", joint);
    model
}

/// The same, with the joint network's values taken for slopes and logarithms of depth.
fn back_projected(mut model: Model) -> Model {
    let network = &model.joint_network;
    let mut layers: Vec<_> = network.nodes().iter().map(|n| n.layer.clone()).collect();
    layers.push(Layer {
        name: "joints".into(),
        inputs: vec![layers.last().unwrap().name.clone()],
        operation: Operation::BackProject,
    });
    let mut parameters = network.nodes().iter().filter_map(|n| n.parameters.clone());
    model.joint_network = Network::new("overlay", network.input(), layers, |_, _, _| {
        Ok(parameters.next().unwrap())
    })
    .unwrap();
    model
}

#[test]
fn what_is_no_result_is_not_reported_as_one() {
    let camera = Camera::from_hfov(48, 40, 1.2);
    let image = picture(48, 40, 1);
    let cases = [
        (constant(0.9, 2.0), Status::Found),
        // No mask: no robot, whatever the joint network says.
        (constant(0.1, 2.0), Status::NotFound),
        // Joints behind the camera, and joints that are no numbers.
        (constant(0.9, -2.0), Status::Invalid),
        (constant(0.9, f32::NAN), Status::Invalid),
        (back_projected(constant(0.9, 0.5)), Status::Found),
        // A depth beyond f32, and one that rounds to none.
        (back_projected(constant(0.9, 100.0)), Status::Invalid),
        (back_projected(constant(0.9, -200.0)), Status::Invalid),
    ];
    for (model, status) in cases {
        for mut locator in [
            Locator::on_gpu(device(), &model, Precision::F32).unwrap(),
            Locator::on_cpu(&model),
        ] {
            let found = locator.locate(&image, &camera, Output::default()).unwrap();
            assert_eq!(found.status, status);
            assert_eq!(found.joints.is_empty(), status != Status::Found);
        }
    }
}

#[test]
fn a_mask_that_is_no_number_is_not_a_robot() {
    let camera = Camera::from_hfov(48, 40, 1.2);
    let image = picture(48, 40, 1);
    let model = constant(f32::NAN, 2.0);
    let status = |mut locator: Locator| {
        let found = locator.locate(&image, &camera, Output::default()).unwrap();
        assert!(found.joints.is_empty());
        found.status
    };
    assert_eq!(status(Locator::on_cpu(&model)), Status::Invalid);
    // SwiftShader makes numbers of them (tests/engine/drivers.rs), but few.
    let expected = match driver() {
        Some(Driver::SwiftShader) => Status::NotFound,
        _ => Status::Invalid,
    };
    let gpu = Locator::on_gpu(device(), &model, Precision::F32).unwrap();
    assert_eq!(status(gpu), expected);
}

#[test]
fn a_zoomed_network_sees_something_else() {
    let image = picture(512, 424, 3);
    let camera = Camera::from_hfov(512, 424, 70_f64.to_radians());
    let [plain, closer, zoomed] = [&[][..], &["coarse"], &["zoom"]].map(|looks| {
        let mut locator = Locator::on_gpu(device(), &model(3, looks), Precision::F32).unwrap();
        locator.locate(&image, &camera, ALL).unwrap()
    });
    assert!(difference(mask(&plain), mask(&closer)).unwrap() > 1e-2);
    assert_eq!(mask(&plain), mask(&zoomed));
    assert!(difference(&joints(&plain), &joints(&zoomed)).unwrap() > 1e-3);
}

#[test]
fn joints_are_where_the_arm_can_have_them() {
    let file = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/data/golden/arm.safetensors"
    );
    let model = Model::load(file).unwrap();
    let mut loose = model.clone();
    loose.description.arm = None;
    let image = picture(80, 56, 3);
    let camera = Camera::from_hfov(80, 56, 1.2);
    let mask = Mask {
        width: 20,
        height: 14,
        probability: vec![0.9; 280],
    };
    let joints = |mut locator: Locator| -> Vec<f32> {
        let joints = locator.joints_with_mask(&image, &camera, &mask).unwrap();
        joints.iter().flatten().map(|v| *v as f32).collect()
    };
    let on_gpu = |model: &Model| joints(Locator::on_gpu(device(), model, Precision::F32).unwrap());
    let (gpu, cpu) = (on_gpu(&model), joints(Locator::on_cpu(&model)));
    // The fit makes several times of what roundings bring joints apart.
    let apart = difference(&gpu, &cpu).unwrap();
    assert!(apart <= 5e-4, "{apart}");
    // The forearm is as long as a UR5's.
    let forearm = |joints: &[f32]| {
        let joint = |i: usize| glam::Vec3::from_slice(&joints[3 * i..]);
        joint(2).distance(joint(3))
    };
    assert!((forearm(&gpu) - 0.3922).abs() < 1e-4);
    // Negative control: where the network puts them it is not.
    assert!((forearm(&on_gpu(&loose)) - 0.3922).abs() > 1e-3);
}

#[test]
fn a_batch_of_none_and_a_camera_twice_are_refused_in_words() {
    let model = Model::from_bytes(&model_file(&description(32, 24, 4), 1), "random").unwrap();
    let options = BatchOptions {
        precision: Precision::F32,
        cameras: 3,
        batch: 2,
        in_flight: 1,
        mask: false,
    };
    let new = |options| BatchLocator::new(device(), &model, options);
    let of_none = [
        (
            BatchOptions {
                batch: 0,
                ..options
            },
            "batch",
        ),
        (
            BatchOptions {
                in_flight: 0,
                ..options
            },
            "in_flight",
        ),
    ];
    for (options, what) in of_none {
        let error = new(options).unwrap_err();
        assert!(matches!(&error, LocateError::Gpu(GpuError::Zero { .. })));
        assert!(error.to_string().starts_with(what), "{error}");
    }
    let options_of_host = HostOptions {
        batch: 0,
        ..Default::default()
    };
    let error = HostLocator::new(device(), &model, options_of_host).unwrap_err();
    assert!(matches!(error, LocateError::Gpu(GpuError::Zero { .. })));

    let mut locator = new(options).unwrap();
    let (picture, camera) = (picture(40, 30, 1), Camera::from_hfov(40, 30, 1.0));
    let images = |places: [usize; 2]| {
        places.map(|place| BatchImage {
            place,
            image: &picture,
            camera: &camera,
        })
    };
    let error = locator.submit(&images([1, 1])).unwrap_err();
    assert!(
        matches!(error, LocateError::SameCamera { place: 1 }),
        "{error}"
    );
    // Negative control: nothing was submitted, and two cameras are taken.
    assert!(locator.submit(&images([2, 1])).unwrap());
}

#[test]
fn a_camera_that_cannot_be_one_is_refused_in_words() {
    let model = constant(0.9, 2.0);
    let mut locator = Locator::on_cpu(&model);
    let image = picture(48, 40, 1);
    let right = Camera::from_hfov(48, 40, 1.2);
    for focal in [f64::NAN, f64::INFINITY, 0.0, -30.0] {
        let mut camera = right;
        camera.intrinsics.fy = focal;
        let error = locator.locate(&image, &camera, ALL).unwrap_err();
        assert!(matches!(error, LocateError::Camera(_)), "{error}");
        let expected = format!("expected a positive focal length in pixels, found {focal}");
        assert!(error.to_string().contains(&expected), "{error}");
        // Negative control: the camera as it was.
        locator.locate(&image, &right, ALL).unwrap();
    }
    let none = Camera::from_hfov(0, 0, 1.2);
    let error = locator.locate(&RgbaImage::new(0, 0), &none, ALL);
    assert!(matches!(error, Err(LocateError::Camera(_))), "{error:?}");
}
