use super::LocateError;
use crate::camera::{Camera, Distortion, Intrinsics, Lens, Rectification, Texels};
use crate::network::Description;

/// What the networks see of a camera's image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct View {
    pub camera: Camera,
    /// That of `camera`.
    pub lens: Lens,
    canonical: Intrinsics,
    /// How the image becomes the canonical one.
    pub rectification: Rectification,
    /// Share of the image that lies within the canonical camera's field, in [0, 1].
    pub field: f64,
    /// Share of the canonical image that shows the camera's image, in [0, 1].
    filled: f64,
}

impl View {
    /// From `camera`, whose pixels lie at `texels`, to the pinhole `canonical` with images of
    /// `width` x `height`.
    fn new(
        camera: &Camera,
        texels: Texels,
        canonical: &Intrinsics,
        width: u32,
        height: u32,
    ) -> Self {
        let pinhole = Camera {
            width,
            height,
            intrinsics: *canonical,
            distortion: Distortion::None,
        };
        Self {
            camera: *camera,
            lens: camera.lens(),
            canonical: *canonical,
            rectification: Rectification {
                texels,
                ..Rectification::new(camera, canonical, width, height)
            },
            field: camera.field_of(&pinhole),
            filled: pinhole.field_of(camera),
        }
    }

    /// What the networks of `description` see of an upright image of `size` by `camera`, whose pixels lie at `texels`:
    /// `last` where that is the same still.
    ///
    /// # Errors
    /// A camera of another size than the image, or one that [`Camera::check`] refuses.
    pub fn of(
        last: Option<Self>,
        camera: &Camera,
        [width, height]: [u32; 2],
        texels: Texels,
        description: &Description,
    ) -> Result<Self, LocateError> {
        if [width, height] != [camera.width, camera.height] {
            return Err(LocateError::Size {
                expected_width: camera.width,
                expected_height: camera.height,
                width,
                height,
            });
        }
        let is_same = |last: &Self| last.camera == *camera && last.rectification.texels == texels;
        if let Some(last) = last.filter(is_same) {
            return Ok(last);
        }
        camera.check()?;
        let input = description.input;
        Ok(Self::new(
            camera,
            texels,
            &description.camera,
            input.width,
            input.height,
        ))
    }

    /// Where the camera sees what the canonical camera sees at `pixel`; `None` where its lens shows
    /// nothing.
    fn source_pixel(&self, [u, v]: [f64; 2]) -> Option<[f64; 2]> {
        self.lens.project([
            (u - self.canonical.cx) / self.canonical.fx,
            (v - self.canonical.cy) / self.canonical.fy,
            1.0,
        ])
    }

    /// The nearest point of the camera's image, whose outermost pixels reach half a pixel out.
    fn clamp(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        [
            u.clamp(-0.5, f64::from(self.camera.width) - 0.5),
            v.clamp(-0.5, f64::from(self.camera.height) - 0.5),
        ]
    }

    /// From a share of the canonical image to a share of the camera's image.
    pub fn share_of_image(&self, share: f64) -> f64 {
        if self.filled > 0.0 {
            (share * self.field / self.filled).min(1.0)
        } else {
            0.0
        }
    }

    /// The smallest box in the camera's image round the canonical pixels `[x0, y0, x1, y1]`, both
    /// ends inside.
    pub fn bbox(&self, [x0, y0, x1, y1]: [u32; 4]) -> Option<[f64; 4]> {
        // A lens bends the sides: points along them, not the corners alone.
        const STEPS: u32 = 16;
        let (left, top) = (f64::from(x0) - 0.5, f64::from(y0) - 0.5);
        let (right, bottom) = (f64::from(x1) + 0.5, f64::from(y1) + 0.5);
        let mut bounds: Option<[f64; 4]> = None;
        for step in 0..=STEPS {
            let t = f64::from(step) / f64::from(STEPS);
            let (x, y) = (left + t * (right - left), top + t * (bottom - top));
            for point in [[x, top], [x, bottom], [left, y], [right, y]] {
                if let Some(at) = self.source_pixel(point) {
                    let [u, v] = self.clamp(at);
                    let [a, b, c, d] = bounds.unwrap_or([u, v, u, v]);
                    bounds = Some([a.min(u), b.min(v), c.max(u), d.max(v)]);
                }
            }
        }
        bounds
    }
}
