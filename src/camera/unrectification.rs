use image::metadata::Orientation;

use rayon::prelude::*;

use super::{Camera, Crop, Intrinsics, Texels};

/// Where the texels of a camera's image lie in the canonical image: the way back from
/// [`Rectification`](super::Rectification), for masks. What `shaders/unrectify.wgsl` and its reference read.
///
/// The inverse of the lens at the nodes of a coarse grid, linear in between. For a pinhole that is exact.
#[derive(Debug, Clone, PartialEq)]
pub struct Unrectification {
    /// Columns and rows of the camera's image, as it is stored.
    pub size: [u32; 2],
    /// Columns of nodes.
    pub columns: u32,
    /// Canonical pixels, row by row: node `[i, j]` is at texel `[8 i, 8 j]`.
    pub nodes: Vec<[f32; 2]>,
}

impl Unrectification {
    /// Texels between two nodes. A lens bends a line by far less than a pixel over so short a way.
    pub const STEP: u32 = 8;

    /// Stands for what the canonical camera does not see.
    const NOWHERE: [f32; 2] = [-1e6; 2];

    /// Into the part `crop` of an image that is `camera`'s once it is turned as `orientation` says, from
    /// the pinhole `canonical`.
    pub fn new(
        camera: &Camera,
        canonical: &Intrinsics,
        crop: Crop,
        orientation: Orientation,
    ) -> Self {
        let lens = camera.lens();
        let here = Crop { x: 0, y: 0, ..crop };
        let texels = Texels::new(here, orientation);
        Self::with([crop.width, crop.height], |at| {
            let pixel = lens
                .unproject(texels.pixel(at))
                .map(|ray| canonical.pixel(ray));
            pixel.map_or(Self::NOWHERE, |pixel| pixel.map(|v| v as f32))
        })
    }

    /// Into the canonical image itself, of `width` x `height`.
    pub fn identity(width: u32, height: u32) -> Self {
        Self::with([width, height], |at| at.map(|v| v as f32))
    }

    fn with(size: [u32; 2], canonical: impl Fn([f64; 2]) -> [f32; 2] + Sync) -> Self {
        let [columns, rows] = size.map(|side| side.div_ceil(Self::STEP) + 1);
        let nodes = (0..columns * rows)
            .into_par_iter()
            .map(|index| [index % columns, index / columns])
            .map(|node| canonical(node.map(|v| f64::from(v * Self::STEP))))
            .collect();
        Self {
            size,
            columns,
            nodes,
        }
    }
}
