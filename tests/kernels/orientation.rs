//! Turned and cropped cameras, and the frame and projection of graphics.

use crate::common::ORIENTATIONS;
use glam::{Vec3, Vec4Swizzles};
use whereabot::camera::graphics::{projection, to_graphics};
use whereabot::camera::{Camera, Crop, Distortion, Intrinsics, Orientation, Texels};

fn sensor() -> Camera {
    Camera {
        width: 640,
        height: 480,
        intrinsics: Intrinsics {
            fx: 520.0,
            fy: 560.0,
            cx: 300.0,
            cy: 250.0,
        },
        distortion: Distortion::Rational {
            k: [-0.1, 0.02, 0.0, 0.0, 0.0, 0.0],
            p: [0.004, -0.007],
        },
    }
}

/// A point that stands still, in the frame of a camera that turns with its pictures.
fn turned([x, y, z]: [f64; 3], texels: &Texels) -> [f64; 3] {
    let along = |step: [i32; 2]| f64::from(step[0]) * x + f64::from(step[1]) * y;
    [along(texels.across), along(texels.down), z]
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[test]
fn a_turned_camera_sees_a_point_where_the_turned_picture_has_it() {
    let stored = sensor();
    let point = [0.3, -0.2, 1.1];
    let at = stored.project(point).unwrap();
    for orientation in ORIENTATIONS {
        let texels = Texels::new(Crop::whole(640, 480), orientation);
        let upright = stored.oriented(orientation);
        let [width, height] = Crop::whole(640, 480).turned(orientation);
        assert_eq!((upright.width, upright.height), (width, height));
        let found = upright.project(turned(point, &texels)).unwrap();
        assert!(distance(found, texels.pixel(at)) < 1e-9, "{orientation:?}");
        // Negative control: the lens turns as well.
        if orientation != Orientation::NoTransforms {
            let lens = Camera {
                distortion: stored.distortion,
                ..upright
            };
            let found = lens.project(turned(point, &texels)).unwrap();
            assert!(distance(found, texels.pixel(at)) > 0.1, "{orientation:?}");
        }
    }
}

#[test]
fn a_cropped_camera_sees_a_point_where_the_part_has_it() {
    let (crop, point) = (
        Crop {
            x: 100,
            y: 40,
            width: 300,
            height: 200,
        },
        [0.1, 0.05, 0.9],
    );
    let part = sensor().cropped(crop);
    let [u, v] = sensor().project(point).unwrap();
    assert!(distance(part.project(point).unwrap(), [u - 100.0, v - 40.0]) < 1e-9);
    assert_eq!((part.width, part.height), (300, 200));
}

#[test]
fn texels_and_pixels_are_each_other_s_inverse() {
    let crop = Crop {
        x: 3,
        y: 5,
        width: 7,
        height: 4,
    };
    for orientation in ORIENTATIONS {
        let texels = Texels::new(crop, orientation);
        let [width, height] = crop.turned(orientation).map(|v| v as i32);
        for pixel in [[0, 0], [width - 1, 0], [0, height - 1], [2, 1]] {
            let [x, y] = texels.at(pixel);
            assert!((3..10).contains(&x) && (5..9).contains(&y));
            assert_eq!(texels.pixel([x, y].map(f64::from)), pixel.map(f64::from));
        }
    }
}

#[test]
fn what_is_drawn_is_where_the_camera_sees_it() {
    let camera = Camera {
        distortion: Distortion::None,
        ..sensor()
    };
    let matrix = projection(&camera, 0.1, 20.0);
    let drawn = |point: [f64; 3]| {
        let clip = matrix * to_graphics(point).extend(1.0);
        clip.xyz() / clip.w
    };
    for point in [[0.0, 0.0, 1.0], [0.4, -0.3, 1.5], [-1.0, 0.7, 4.0]] {
        let Vec3 { x, y, z } = drawn(point);
        // From clip space to the viewport, whose first pixel's centre is at half a pixel.
        let u = f64::from(0.5 * (x + 1.0)) * 640.0 - 0.5;
        let v = f64::from(0.5 * (1.0 - y)) * 480.0 - 0.5;
        assert!(distance([u, v], camera.project(point).unwrap()) < 1e-3);
        assert!((0.0..1.0).contains(&z));
    }
    // Depth runs from 0 to 1, as WebGPU's, and what is in front hides what is behind.
    assert!(drawn([0.0, 0.0, 0.1]).z.abs() < 1e-6);
    assert!((drawn([0.0, 0.0, 20.0]).z - 1.0).abs() < 1e-6);
    assert!(drawn([0.0, 0.0, 1.0]).z < drawn([0.0, 0.0, 2.0]).z);
    // Negative control: y is up.
    assert!(drawn([0.0, 0.2, 1.0]).y < drawn([0.0, -0.2, 1.0]).y);
}
