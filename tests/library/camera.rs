//! Cameras: projection and its inverse, fields of view, ROS calibration files.

use proptest::prelude::*;
use whereabot::camera::{Camera, CameraError, Distortion, Intrinsics};

const CANONICAL: Intrinsics = Intrinsics {
    fx: 182.5,
    fy: 182.5,
    cx: 127.5,
    cy: 105.5,
};

const CANONICAL_CAMERA: Camera = Camera {
    width: 256,
    height: 212,
    intrinsics: CANONICAL,
    distortion: Distortion::None,
};

fn camera(distortion: Distortion) -> Camera {
    Camera {
        width: 640,
        height: 480,
        intrinsics: Intrinsics {
            fx: 500.0,
            fy: 510.0,
            cx: 322.0,
            cy: 236.0,
        },
        distortion,
    }
}

fn plumb_bob(k1: f64) -> Distortion {
    Distortion::Rational {
        k: [k1, 0.0, 0.0, 0.0, 0.0, 0.0],
        p: [0.0; 2],
    }
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Distortions of the size that lenses have.
fn distortions() -> impl Strategy<Value = Distortion> {
    let within = |size: f64| -size..size;
    prop_oneof![
        Just(Distortion::None),
        (
            within(0.35),
            within(0.15),
            within(0.05),
            within(0.1),
            within(0.05),
            within(0.02),
            within(0.003),
            within(0.003),
        )
            .prop_map(|(k1, k2, k3, k4, k5, k6, p1, p2)| Distortion::Rational {
                k: [k1, k2, k3, k4, k5, k6],
                p: [p1, p2],
            }),
        (within(0.1), within(0.05), within(0.02), within(0.01)).prop_map(|(k1, k2, k3, k4)| {
            Distortion::Equidistant {
                k: [k1, k2, k3, k4],
            }
        }),
    ]
}

proptest! {
    #[test]
    fn a_pixel_that_a_ray_reaches_is_where_the_ray_is_projected(
        distortion in distortions(),
        u in -0.5..639.5,
        v in -0.5..479.5,
    ) {
        let camera = camera(distortion);
        if let Some([x, y]) = camera.unproject([u, v]) {
            // Any distance along the ray is the same pixel.
            let back = camera.project([2.5 * x, 2.5 * y, 2.5]).unwrap();
            prop_assert!(distance(back, [u, v]) < 1e-6, "{:?} for {:?}", back, [u, v]);
        }
    }

    #[test]
    fn a_ray_within_the_limit_comes_back_from_its_pixel(
        distortion in distortions(),
        share in 0.0..0.95,
        direction in 0.0..std::f64::consts::TAU,
    ) {
        let camera = camera(distortion);
        let r = share * camera.max_radius().min(1.2);
        let ray = [r * direction.cos(), r * direction.sin()];
        let pixel = camera.project([ray[0], ray[1], 1.0]).unwrap();
        let back = camera.unproject(pixel).unwrap();
        prop_assert!(distance(back, ray) < 1e-8, "{:?} for {:?}", back, ray);
    }

    /// The same comparison with two different lenses fails.
    #[test]
    fn another_lens_does_not_lead_back(k1 in -0.2..0.2) {
        let ray = camera(plumb_bob(k1)).unproject([100.0, 80.0]).unwrap();
        let back = camera(plumb_bob(k1 + 0.01)).project([ray[0], ray[1], 1.0]).unwrap();
        prop_assert!(distance(back, [100.0, 80.0]) > 1e-2);
    }
}

#[test]
fn a_lens_whose_formula_has_a_pole_leads_back_too() {
    // The denominator is 0 at a radius of 1.812, and the distorted radius of this ray beyond it.
    let camera = camera(Distortion::Rational {
        k: [0.2591447, 0.1199944, 0.0, -0.0904717, 0.0, -0.0198382],
        p: [0.0; 2],
    });
    for r in [0.3, 1.1, 1.5] {
        let pixel = camera.project([r, 0.0, 1.0]).unwrap();
        let back = camera.unproject(pixel).unwrap();
        assert!(distance(back, [r, 0.0]) < 1e-8, "{back:?} for {r}");
        // Negative control: an answer at the pole is noticed.
        assert!(distance([1.812, 0.0], [r, 0.0]) > 1e-2);
    }
}

#[test]
fn distortion_is_that_of_the_published_formulas() {
    // Worked out by hand from OpenCV's documentation at (0.3, -0.2): r^2 = 0.13.
    let rational = Distortion::Rational {
        k: [0.1, 0.01, 0.001, 0.2, 0.02, 0.002],
        p: [0.01, 0.02],
    };
    let radial = (1.0 + 0.013 + 0.000169 + 0.000002197) / (1.0 + 0.026 + 0.000338 + 0.000004394);
    let expected = [
        0.3 * radial + 2.0 * 0.01 * 0.3 * -0.2 + 0.02 * (0.13 + 2.0 * 0.09),
        -0.2 * radial + 0.01 * (0.13 + 2.0 * 0.04) + 2.0 * 0.02 * 0.3 * -0.2,
    ];
    assert!(distance(rational.distort([0.3, -0.2]), expected) < 1e-15);

    let fisheye = Distortion::Equidistant {
        k: [0.1, 0.01, 0.001, 0.0001],
    };
    let angle = 1.0_f64.atan();
    let [x, y] = fisheye.distort([1.0, 0.0]);
    let expected = angle
        * (1.0
            + 0.1 * angle.powi(2)
            + 0.01 * angle.powi(4)
            + 0.001 * angle.powi(6)
            + 0.0001 * angle.powi(8));
    assert!((x - expected).abs() < 1e-15 && y == 0.0);
    assert_eq!(fisheye.distort([0.0, 0.0]), [0.0, 0.0]);
}

#[test]
fn what_the_lens_would_fold_back_is_not_in_the_picture() {
    let distortion = plumb_bob(-0.5);
    let camera = camera(distortion);
    // d/dr (r - 0.5 r^3) = 0 at r = sqrt(2 / 3).
    assert!((camera.max_radius() - (2.0_f64 / 3.0).sqrt()).abs() < 1e-9);
    assert!(camera.project([0.8, 0.0, 1.0]).is_some());
    assert_eq!(camera.project([1.2, 0.0, 1.0]), None);
    // The bare formula puts it inside the image: what the limit is for.
    let [x, _] = distortion.distort([1.2, 0.0]);
    assert!((0.0..640.0).contains(&(500.0 * x + 322.0)));
}

#[test]
fn a_pixel_that_no_ray_reaches_has_none() {
    // The largest distorted radius is 2/3 sqrt(2/3) = 0.544, at u = 322 + 500 * 0.544 = 594.
    let camera = camera(plumb_bob(-0.5));
    assert!(camera.unproject([590.0, 236.0]).is_some());
    assert_eq!(camera.unproject([600.0, 236.0]), None);
    assert_eq!(camera.unproject([f64::NAN, 236.0]), None);
}

#[test]
fn points_behind_the_camera_or_not_finite_have_no_pixel() {
    let camera = camera(Distortion::None);
    assert!(camera.project([0.1, 0.1, 1.0]).is_some());
    for point in [
        [0.1, 0.1, -1.0],
        [0.1, 0.1, 0.0],
        [f64::NAN, 0.1, 1.0],
        [0.1, f64::INFINITY, 1.0],
        [0.1, 0.1, f64::INFINITY],
        [0.1, 0.1, f64::NAN],
    ] {
        assert_eq!(camera.project(point), None, "{point:?}");
    }
}

#[test]
fn fields_of_view_give_the_focal_length() {
    let right_angle = Camera::from_hfov(640, 480, std::f64::consts::FRAC_PI_2);
    assert!((right_angle.intrinsics.fx - 320.0).abs() < 1e-9);
    assert_eq!(right_angle.intrinsics.cx, 319.5);
    assert_eq!(right_angle.intrinsics.cy, 239.5);

    // On an image of film's own shape, 36 mm of focal length is the image's width.
    let film = Camera::from_focal_35mm(3600, 2400, 36.0);
    assert!((film.intrinsics.fx - 3600.0).abs() < 1e-9);
    let upright = Camera::from_focal_35mm(2400, 3600, 36.0);
    assert_eq!(upright.intrinsics.fx, film.intrinsics.fx);

    for (width, height) in [(4000, 3000), (3000, 4000)] {
        let focal = Camera::assumed(width, height).intrinsics.fx;
        let degrees = 2.0 * (2000.0 / focal).atan().to_degrees();
        assert!((degrees - 69.4).abs() < 0.05, "{degrees}");
    }
}

#[test]
fn the_field_is_the_share_that_the_canonical_camera_sees() {
    let twin = Camera {
        width: 256,
        height: 212,
        intrinsics: CANONICAL,
        distortion: Distortion::None,
    };
    assert_eq!(twin.field_of(&CANONICAL_CAMERA), 1.0);
    // Half the focal length: twice the field each way.
    let mut wide = twin;
    wide.intrinsics.fx /= 2.0;
    wide.intrinsics.fy /= 2.0;
    let field = wide.field_of(&CANONICAL_CAMERA);
    assert!((field - 0.25).abs() < 0.02, "{field}");
    // One pixel looks straight ahead.
    assert_eq!(Camera::assumed(1, 1).field_of(&CANONICAL_CAMERA), 1.0);
    // A camera whose principal point is far off looks past it.
    let mut aside = twin;
    aside.intrinsics.cx = 5000.0;
    assert_eq!(aside.field_of(&CANONICAL_CAMERA), 0.0);
}

const CALIBRATOR: &str = "\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.78, 0., 305.59, 0., 437.3, 243.73, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361976, 0.110510, 0.001014, 0.000505, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.6, 0, 305.6, 0, 0, 436.0, 243.7, 0, 0, 0, 1, 0]
";

const ECHO: &str = "\
header:
  stamp:
    sec: 1690000000
    nanosec: 0
  frame_id: camera_optical
height: 480
width: 640
distortion_model: rational_polynomial
d:
- 0.5
- -2.6
- 0.0007
- -0.0002
- 1.5
- 0.38
- -2.4
- 1.4
k:
- 607.0
- 0.0
- 639.0
- 0.0
- 607.5
- 366.0
- 0.0
- 0.0
- 1.0
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [607.0, 0.0, 639.0, 0.0, 0.0, 607.0, 366.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
";

#[test]
fn the_calibrators_file_is_read() {
    let camera = Camera::from_camera_info(CALIBRATOR).unwrap();
    assert_eq!((camera.width, camera.height), (640, 480));
    assert_eq!(
        camera.intrinsics,
        Intrinsics {
            fx: 438.78,
            fy: 437.3,
            cx: 305.59,
            cy: 243.73
        }
    );
    assert_eq!(
        camera.distortion,
        Distortion::Rational {
            k: [-0.361976, 0.11051, 0.0, 0.0, 0.0, 0.0],
            p: [0.001014, 0.000505],
        }
    );
}

#[test]
fn a_printed_message_is_read_in_the_names_of_both_ros_versions() {
    let camera = Camera::from_camera_info(ECHO).unwrap();
    assert_eq!(camera.intrinsics.cx, 639.0);
    assert_eq!(
        camera.distortion,
        Distortion::Rational {
            k: [0.5, -2.6, 1.5, 0.38, -2.4, 1.4],
            p: [0.0007, -0.0002],
        }
    );
    let ros1 = ECHO
        .replace("\nd:", "\nD:")
        .replace("\nk:", "\nK:")
        .replace("\nr:", "\nR:")
        .replace("\np:", "\nP:");
    assert_ne!(ros1, ECHO);
    assert_eq!(Camera::from_camera_info(&ros1).unwrap(), camera);
}

#[test]
fn lenses_without_distortion_are_told_from_fisheyes_without_coefficients() {
    let flat = |model: &str, d: &str| {
        format!(
            "width: 64\nheight: 48\nk: [50, 0, 32, 0, 50, 24, 0, 0, 1]\ndistortion_model: '{model}'\nd: {d}\n"
        )
    };
    let read = |model, d| Camera::from_camera_info(&flat(model, d)).map(|c| c.distortion);
    assert_eq!(
        read("plumb_bob", "[0, 0, 0, 0, 0]").unwrap(),
        Distortion::None
    );
    assert_eq!(read("", "[]").unwrap(), Distortion::None);
    assert_eq!(
        read("equidistant", "[0, 0, 0, 0]").unwrap(),
        Distortion::Equidistant { k: [0.0; 4] }
    );
    for (model, d) in [
        ("double_sphere", "[0, 0]"),
        ("plumb_bob", "[0.1]"),
        ("equidistant", "[0.1, 0, 0]"),
        ("rational_polynomial", "[1, 0, 0, 0, 0, 0, 0, 0, 0.1]"),
    ] {
        assert!(
            matches!(read(model, d), Err(CameraError::Value { .. })),
            "{model} {d}"
        );
    }
}

#[test]
fn a_camera_that_was_never_calibrated_is_refused() {
    let zero = ECHO
        .replace("- 607.0\n", "- 0.0\n")
        .replace("- 639.0\n", "- 0.0\n")
        .replace("- 607.5\n", "- 0.0\n")
        .replace("- 366.0\n", "- 0.0\n")
        .replace("- 1.0\n", "- 0.0\n");
    assert!(matches!(
        Camera::from_camera_info(&zero),
        Err(CameraError::Uncalibrated)
    ));
}

#[test]
fn what_is_no_camera_is_refused_with_a_reason() {
    let cases = [
        ("", "no document"),
        ("just text", "camera_info in YAML"),
        ("[1, 2", "camera_info in YAML"),
        ("width: 640\nheight: 480\n", "camera_matrix"),
        ("width: -1\nheight: 480\nk: []\n", "line 1"),
        ("width: 640\nheight: 480\nk: many\n", "a list of numbers"),
        ("width: 640\nheight: 480\nk: [1, 2]\n", "[fx, 0, cx"),
        (
            "width: 0\nheight: 480\nk: [5, 0, 3, 0, 5, 2, 0, 0, 1]\n",
            "width",
        ),
        (
            "width: 9\nheight: 9\nk: [-5, 0, 3, 0, 5, 2, 0, 0, 1]\n",
            "fx",
        ),
        (
            "width: 9\nheight: 9\nk: [5, 0, .nan, 0, 5, 2, 0, 0, 1]\n",
            ".nan",
        ),
        (
            "width: 9\nheight: 9\nk: [5, 7, 3, 0, 5, 2, 0, 0, 1]\n",
            "7.0",
        ),
        (
            "width: 9\nheight: 9\nk: [5, 0, 3, 0, 5, 2, 0, 0, 1]\ndistortion_model: plumb_bob\nd: [.inf, 0, 0, 0, 0]\n",
            ".inf",
        ),
    ];
    for (yaml, part) in cases {
        let message = Camera::from_camera_info(yaml).unwrap_err().to_string();
        assert!(message.contains(part), "{yaml:?}: {message}");
    }
}

#[test]
fn values_that_no_camera_has_are_named() {
    let good = camera(plumb_bob(0.1));
    assert!(good.check().is_ok());
    let broken = |change: &dyn Fn(&mut Camera)| {
        let mut camera = good;
        change(&mut camera);
        camera.check().unwrap_err().to_string()
    };
    assert!(broken(&|c| c.height = 0).starts_with("height"));
    assert!(broken(&|c| c.intrinsics.fx = f64::NAN).starts_with("fx"));
    assert!(broken(&|c| c.intrinsics.fy = -1.0).starts_with("fy"));
    assert!(broken(&|c| c.intrinsics.cy = f64::INFINITY).starts_with("cy"));
    assert!(broken(&|c| c.distortion = plumb_bob(f64::NAN)).starts_with("distortion"));
}

#[test]
fn an_error_from_a_file_names_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("front.yaml");
    let missing = Camera::load(&file).unwrap_err().to_string();
    assert!(missing.contains("front.yaml"), "{missing}");
    std::fs::write(&file, "k: 3").unwrap();
    let broken = Camera::load(&file).unwrap_err().to_string();
    assert!(broken.contains("front.yaml"), "{broken}");
    std::fs::write(&file, CALIBRATOR).unwrap();
    assert!(Camera::load(&file).is_ok());
}

#[test]
fn an_image_of_another_size_is_refused_with_both_sizes() {
    let camera = camera(Distortion::None);
    assert_eq!(camera.for_image(640, 480).unwrap(), camera);
    let message = camera.for_image(480, 640).unwrap_err().to_string();
    assert!(
        message.contains("640 x 480") && message.contains("480 x 640"),
        "{message}"
    );
}
