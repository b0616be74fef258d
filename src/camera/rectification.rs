use bytemuck::{Pod, Zeroable};

use super::{Camera, Distortion, Intrinsics, Texels};

/// How a camera's image becomes the canonical pinhole image of the networks: what
/// `shaders/rectify.wgsl` and its reference read, in their layout and precision.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Rectification {
    /// `1 / fx, 1 / fy, cx, cy` of the canonical camera.
    pub canonical: [f32; 4],
    /// `fx, fy, cx, cy` of the source.
    pub source: [f32; 4],
    /// Columns and rows of the source.
    pub size: [f32; 2],
    /// Samples across a canonical pixel's footprint in the source, along x and y.
    pub samples: [u32; 2],
    /// `k1 .. k4`.
    pub k_low: [f32; 4],
    /// `k5, k6, p1, p2`.
    pub k_high: [f32; 4],
    /// 0 pinhole, 1 rational, 2 equidistant.
    pub model: u32,
    /// Rays farther than this from the axis, at z = 1, are black.
    pub max_radius: f32,
    /// Which image of a batch is written.
    pub index: u32,
    /// Keeps what follows at a multiple of 8 bytes.
    pub padding: u32,
    /// Where the pixels of the source lie in its texture.
    pub texels: Texels,
    /// Keeps the size a multiple of 16 bytes.
    pub padding_end: [u32; 2],
}

impl Rectification {
    /// Samples along one side of a footprint at most: a 16,384-pixel image needs 64.
    const MAX_SAMPLES: f64 = 64.0;

    /// From `source` to the pinhole `canonical` with images of `width` x `height`.
    pub fn new(source: &Camera, canonical: &Intrinsics, width: u32, height: u32) -> Self {
        let (model, k, p) = match source.distortion {
            Distortion::None => (0, [0.0; 6], [0.0; 2]),
            Distortion::Rational { k, p } => (1, k, p),
            Distortion::Equidistant { k: [a, b, c, d] } => (2, [a, b, c, d, 0.0, 0.0], [0.0; 2]),
        };
        let Intrinsics { fx, fy, cx, cy } = source.intrinsics;
        let [k1, k2, k3, k4, k5, k6] = k.map(|v| v as f32);
        Self {
            canonical: [
                (1.0 / canonical.fx) as f32,
                (1.0 / canonical.fy) as f32,
                canonical.cx as f32,
                canonical.cy as f32,
            ],
            source: [fx, fy, cx, cy].map(|v| v as f32),
            size: [source.width as f32, source.height as f32],
            samples: footprint(source, canonical, width, height)
                .map(|side| side.ceil().clamp(1.0, Self::MAX_SAMPLES) as u32),
            k_low: [k1, k2, k3, k4],
            k_high: [k5, k6, p[0] as f32, p[1] as f32],
            model,
            max_radius: source.max_radius().min(1e9) as f32,
            index: 0,
            padding: 0,
            texels: Texels::PLAIN,
            padding_end: [0; 2],
        }
    }
}

/// Largest width and height, in source pixels, of a canonical pixel's footprint. One size for the
/// whole image, and a hundredth of a pixel of play, so that rounding cannot change the number of
/// samples from one machine to the next.
fn footprint(source: &Camera, canonical: &Intrinsics, width: u32, height: u32) -> [f64; 2] {
    let limit = source.max_radius();
    let pixel = |u: f64, v: f64| {
        let ray = [
            (u - canonical.cx) / canonical.fx,
            (v - canonical.cy) / canonical.fy,
        ];
        (ray[0].hypot(ray[1]) <= limit).then(|| source.pixel_of_ray(ray))
    };
    let inside = |[u, v]: [f64; 2]| {
        (-0.5..=f64::from(source.width) - 0.5).contains(&u)
            && (-0.5..=f64::from(source.height) - 0.5).contains(&v)
    };
    let distance = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let mut largest = [1.0_f64; 2];
    const GRID: u32 = 32;
    for row in 0..=GRID {
        for column in 0..=GRID {
            let u = f64::from(width - 1) * f64::from(column) / f64::from(GRID);
            let v = f64::from(height - 1) * f64::from(row) / f64::from(GRID);
            let (Some(at), Some(right), Some(below)) =
                (pixel(u, v), pixel(u + 1.0, v), pixel(u, v + 1.0))
            else {
                continue;
            };
            if inside(at) {
                largest[0] = largest[0].max(distance(at, right) - 0.01);
                largest[1] = largest[1].max(distance(at, below) - 0.01);
            }
        }
    }
    largest
}
