//! Pictures: the mask resampled to the image, and the annotated image.

use image::{GrayImage, Luma, Rgba, RgbaImage};
use whereabot::camera::{Camera, Distortion, Intrinsics};
use whereabot::cascade::Mask;
use whereabot::draw::mask_image;

const CANONICAL: Intrinsics = Intrinsics {
    fx: 40.0,
    fy: 40.0,
    cx: 31.5,
    cy: 23.5,
};

/// 64 x 48; probability rises from left to right.
fn ramp() -> Mask {
    Mask {
        width: 64,
        height: 48,
        probability: (0..64 * 48).map(|i| (i % 64) as f32 / 63.0).collect(),
    }
}

fn twin(scale: u32) -> Camera {
    let s = f64::from(scale);
    Camera {
        width: 64 * scale,
        height: 48 * scale,
        intrinsics: Intrinsics {
            fx: 40.0 * s,
            fy: 40.0 * s,
            cx: 0.5 * (64.0 * s - 1.0),
            cy: 0.5 * (48.0 * s - 1.0),
        },
        distortion: Distortion::None,
    }
}

#[test]
fn a_camera_like_the_canonical_one_sees_the_mask_itself() {
    let mask = ramp();
    let picture = mask_image(&mask, &CANONICAL, &twin(1), None);
    assert_eq!(picture.dimensions(), (64, 48));
    for (x, y, pixel) in picture.enumerate_pixels() {
        let expected = 255.0 * mask.probability[(y * 64 + x) as usize];
        assert_eq!(pixel.0[0], expected.round() as u8, "{x} {y}");
    }
    // A pixel to the right is another picture.
    let mut shifted = twin(1);
    shifted.intrinsics.cx += 1.0;
    assert_ne!(mask_image(&mask, &CANONICAL, &shifted, None), picture);
}

#[test]
fn a_threshold_makes_the_mask_hard() {
    let picture = mask_image(&ramp(), &CANONICAL, &twin(3), Some(0.5));
    assert!(picture.pixels().all(|p| p.0[0] == 0 || p.0[0] == 255));
    let first = (0..192).find(|&x| picture.get_pixel(x, 70).0[0] == 255);
    // Probability 0.5 is at canonical 31.5, which is 95.5 at three times the size.
    assert_eq!(first, Some(96));
}

#[test]
fn what_the_canonical_camera_does_not_see_is_background() {
    let all = Mask {
        width: 64,
        height: 48,
        probability: vec![1.0; 64 * 48],
    };
    // Twice the field of view each way: the middle quarter is seen.
    let mut wide = twin(4);
    wide.intrinsics.fx /= 2.0;
    wide.intrinsics.fy /= 2.0;
    let picture = mask_image(&all, &CANONICAL, &wide, Some(0.5));
    for (x, y, pixel) in picture.enumerate_pixels() {
        let seen = (64..192).contains(&x) && (48..144).contains(&y);
        assert_eq!(pixel.0[0] == 255, seen, "{x} {y}");
    }
}

#[test]
fn a_lens_bends_the_mask_as_it_bends_the_image() {
    let mut camera = twin(4);
    camera.distortion = Distortion::Rational {
        k: [-0.25, 0.06, 0.0, 0.0, 0.0, 0.0],
        p: [0.001, -0.002],
    };
    // A disc about the ray (0.5, 0.3): how far inside a ray is.
    let disc = |ray: [f64; 2]| 0.15 - (ray[0] - 0.5).hypot(ray[1] - 0.3);
    let mask = Mask {
        width: 64,
        height: 48,
        probability: (0..64 * 48)
            .map(|i| {
                let [x, y] = [f64::from(i % 64), f64::from(i / 64)];
                let inside = 40.0 * disc([(x - 31.5) / 40.0, (y - 23.5) / 40.0]);
                (0.5 + inside as f32).clamp(0.0, 1.0)
            })
            .collect(),
    };
    let lens = camera.lens();
    let wrong = |drawn_with: &Camera| {
        let picture = mask_image(&mask, &CANONICAL, drawn_with, Some(0.5));
        let expected = GrayImage::from_fn(256, 192, |x, y| {
            let ray = lens.unproject([f64::from(x), f64::from(y)]);
            Luma([if ray.is_some_and(|ray| disc(ray) > 0.0) {
                255
            } else {
                0
            }])
        });
        let area = expected.pixels().filter(|p| p.0[0] > 0).count();
        let differing = picture
            .pixels()
            .zip(expected.pixels())
            .filter(|(a, b)| a != b)
            .count();
        differing as f64 / area as f64
    };
    // The network's pixels are four times larger than the picture's.
    assert!(wrong(&camera) < 0.05, "{}", wrong(&camera));
    let pinhole = twin(4);
    assert!(wrong(&pinhole) > 0.3, "{}", wrong(&pinhole));
}

#[test]
fn an_image_of_one_pixel_has_a_mask_of_one_pixel() {
    let picture = mask_image(&ramp(), &CANONICAL, &Camera::assumed(1, 1), None);
    assert_eq!(picture.dimensions(), (1, 1));
    assert_eq!(picture.get_pixel(0, 0).0[0], 128);
}

#[cfg(feature = "cli")]
mod annotated {
    use super::*;
    use whereabot::draw::{JOINT_COLOURS, Row, RowChart, annotated, row_chart};

    fn photo() -> RgbaImage {
        RgbaImage::from_fn(256, 192, |x, y| Rgba([x as u8, y as u8, 90, 255]))
    }

    fn mask() -> GrayImage {
        GrayImage::from_fn(256, 192, |x, y| {
            let inside = (40..90).contains(&x) && (30..80).contains(&y);
            Luma([if inside { 255 } else { 0 }])
        })
    }

    #[test]
    fn only_the_mask_is_tinted() {
        let photo = photo();
        let picture = annotated(&photo, &mask(), &[]);
        for (x, y, pixel) in picture.enumerate_pixels() {
            let before = photo.get_pixel(x, y).0;
            let same = pixel.0 == before[..3];
            assert_eq!(same, mask().get_pixel(x, y).0[0] == 0, "{x} {y}");
        }
        // The outline is stronger than the inside.
        let greenness = |x, y| i32::from(picture.get_pixel(x, y).0[1]);
        assert!(greenness(40, 50) > greenness(60, 50) + 20);
    }

    #[test]
    fn each_joint_has_its_colour_at_its_place() {
        let joints: Vec<[f64; 2]> = (0..6)
            .map(|i| [30.0 + 35.0 * f64::from(i), 100.0])
            .collect();
        let picture = annotated(&photo(), &GrayImage::new(256, 192), &joints);
        for (i, colour) in JOINT_COLOURS.into_iter().enumerate() {
            assert_eq!(picture.get_pixel(30 + 35 * i as u32, 100).0, colour);
        }
        // Half way between two joints there is a line, and above it none.
        assert_ne!(picture.get_pixel(47, 100).0, [47, 100, 90]);
        assert_eq!(picture.get_pixel(47, 80).0, [47, 80, 90]);
    }

    #[test]
    fn joints_far_outside_cost_nothing_and_draw_a_line_to_the_border() {
        let start = std::time::Instant::now();
        let far = [
            [128.0, 100.0],
            [1e9, 100.0],
            [-1e300, 1e300],
            [f64::NAN, 5.0],
            [f64::INFINITY, 5.0],
            [f64::MAX, f64::MIN],
        ];
        let picture = annotated(&photo(), &GrayImage::new(256, 192), &far);
        assert!(start.elapsed().as_secs() < 5);
        assert_ne!(picture.get_pixel(255, 100).0, [255, 100, 90]);
        assert_eq!(picture.get_pixel(255, 20).0, [255, 20, 90]);
    }

    #[test]
    fn an_image_without_room_is_drawn() {
        let picture = annotated(&RgbaImage::new(1, 1), &GrayImage::new(1, 1), &[[0.0, 0.0]]);
        assert_eq!(picture.dimensions(), (1, 1));
        let empty = annotated(&RgbaImage::new(0, 0), &GrayImage::new(0, 0), &[[0.0, 0.0]]);
        assert_eq!(empty.dimensions(), (0, 0));
    }

    #[test]
    fn rows_are_as_long_as_their_values_and_coloured_by_kind() {
        let row = |name: &str, kind: &str, value| Row {
            name: name.into(),
            kind: kind.into(),
            value,
            note: String::new(),
        };
        let chart = RowChart {
            title: "where the time goes".into(),
            rows: vec![row("a", "x", 4.0), row("b", "y", 1.0), row("c", "y", 0.0)],
        };
        let picture = row_chart(&chart).unwrap();
        // From the most frequent colours: white, then the bars.
        let mut counts = std::collections::HashMap::new();
        for pixel in picture.pixels() {
            *counts.entry(pixel.0).or_insert(0) += 1;
        }
        let mut counts: Vec<_> = counts.into_iter().map(|(c, n)| (n, c)).collect();
        counts.sort_unstable();
        let [.., (second, _), (first, _), (_, white)] = counts.as_slice() else {
            panic!("{counts:?}")
        };
        assert_eq!(*white, [255; 3]);
        let ratio = f64::from(*first) / f64::from(*second);
        assert!((3.0..5.0).contains(&ratio), "{ratio}");
    }
}
