use super::{Device, GpuError};

/// What holds a camera's image on the GPU. Each view is of one mip level and one layer, and its texture
/// has `TEXTURE_BINDING` among its usages.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Planes {
    /// A texture of `rgba8unorm`, `bgra8unorm` (colours as the camera encoded them) or one of these with
    /// `-srgb` (which gives linear light); alpha is ignored. Its texture's format counts: give a view
    /// in the same format.
    Rgba(wgpu::TextureView),
    /// NV12: luma in `r8unorm` and, at half the size rounded up, Cb and Cr in `rg8unorm`; or the planes of
    /// a texture of `nv12`.
    Nv12 {
        /// The plane of luma.
        luma: wgpu::TextureView,
        /// The plane of Cb and Cr.
        chroma: wgpu::TextureView,
        /// How they stand for colours.
        encoding: Yuv,
    },
}

/// How luma and chroma stand for colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Yuv {
    /// BT.601, luma from 16 to 235: cameras and video up to standard definition.
    Bt601,
    /// BT.601 over the full range: JPEG, and what phones' cameras give.
    Bt601Full,
    /// BT.709, luma from 16 to 235: high definition video.
    Bt709,
    /// BT.709 over the full range.
    Bt709Full,
}

impl Yuv {
    /// Values of the constants of `shaders/rectify_nv12.wgsl`.
    pub(super) fn constants(self) -> [(&'static str, f64); 6] {
        let (red, blue) = match self {
            Self::Bt601 | Self::Bt601Full => (0.299, 0.114),
            Self::Bt709 | Self::Bt709Full => (0.2126, 0.0722),
        };
        // Luma spans 219 of 255 steps, chroma 224.
        let (luma, chroma, black) = match self {
            Self::Bt601 | Self::Bt709 => (255.0 / 219.0, 255.0 / 224.0, 16.0 / 255.0),
            Self::Bt601Full | Self::Bt709Full => (1.0, 1.0, 0.0),
        };
        let green = 1.0 - red - blue;
        let (red_cr, blue_cb) = (2.0 * (1.0 - red), 2.0 * (1.0 - blue));
        [
            ("LUMA_SCALE", luma),
            ("LUMA_BLACK", black),
            ("RED_CR", chroma * red_cr),
            ("GREEN_CB", -chroma * blue_cb * blue / green),
            ("GREEN_CR", -chroma * red_cr * red / green),
            ("BLUE_CB", chroma * blue_cb),
        ]
    }
}

/// Which of the `rectify_*` files reads a source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum SourceKind {
    Storage,
    Texture,
    Srgb,
    Nv12(Yuv),
}

impl SourceKind {
    /// The kernel's text.
    pub fn text(self) -> &'static str {
        macro_rules! rectify {
            ($file:literal) => {
                concat!(
                    include_str!("../../shaders/gaze.wgsl"),
                    include_str!("../../shaders/rectify.wgsl"),
                    include_str!(concat!("../../shaders/", $file, ".wgsl"))
                )
            };
        }
        match self {
            Self::Storage => rectify!("rectify_storage"),
            Self::Texture => rectify!("rectify_texture"),
            Self::Srgb => rectify!("rectify_srgb"),
            Self::Nv12(_) => rectify!("rectify_nv12"),
        }
    }
}

impl Planes {
    /// Columns and rows, in texels.
    pub fn size(&self) -> [u32; 2] {
        let view = match self {
            Self::Rgba(view) | Self::Nv12 { luma: view, .. } => view,
        };
        [view.texture().width(), view.texture().height()]
    }

    /// Bytes of what they hold.
    pub(super) fn bytes(&self) -> u64 {
        let [width, height] = self.size().map(u64::from);
        match self {
            Self::Rgba(_) => 4 * width * height,
            Self::Nv12 { .. } => width * height + 2 * width.div_ceil(2) * height.div_ceil(2),
        }
    }

    /// What reads them, if they can be read.
    pub(super) fn kind(&self, device: &Device) -> Result<SourceKind, GpuError> {
        use wgpu::TextureFormat as F;
        match self {
            Self::Rgba(view) => {
                let format = check(
                    device,
                    "source",
                    view,
                    &[
                        F::Rgba8Unorm,
                        F::Rgba8UnormSrgb,
                        F::Bgra8Unorm,
                        F::Bgra8UnormSrgb,
                    ],
                )?;
                Ok(if format.is_srgb() {
                    SourceKind::Srgb
                } else {
                    SourceKind::Texture
                })
            }
            Self::Nv12 {
                luma,
                chroma,
                encoding,
            } => {
                check(device, "source, luma", luma, &[F::R8Unorm, F::NV12])?;
                let format = check(device, "source, chroma", chroma, &[F::Rg8Unorm, F::NV12])?;
                let [width, height] = self.size();
                let texture = chroma.texture();
                let found = [texture.width(), texture.height()];
                let expected = [width.div_ceil(2), height.div_ceil(2)];
                // Of a texture of both planes, the size is luma's.
                if format != F::NV12 && found != expected {
                    return Err(GpuError::Source {
                        what: "source, chroma: size",
                        expected: format!("{} x {}", expected[0], expected[1]),
                        found: format!("{} x {}", found[0], found[1]),
                    });
                }
                Ok(SourceKind::Nv12(*encoding))
            }
        }
    }
}

/// Refuses what cannot be bound, in words, before wgpu does.
fn check(
    device: &Device,
    what: &'static str,
    view: &wgpu::TextureView,
    formats: &[wgpu::TextureFormat],
) -> Result<wgpu::TextureFormat, GpuError> {
    let texture = view.texture();
    let wrong = |expected: String, found: String| GpuError::Source {
        what,
        expected,
        found,
    };
    let format = texture.format();
    if !formats.contains(&format) {
        let names: Vec<String> = formats.iter().map(|f| format!("{f:?}")).collect();
        return Err(wrong(
            format!("a texture of {}", names.join(", ")),
            format!("{format:?}"),
        ));
    }
    let usage = texture.usage();
    if !usage.contains(wgpu::TextureUsages::TEXTURE_BINDING) {
        return Err(wrong("usage TEXTURE_BINDING".into(), format!("{usage:?}")));
    }
    if texture.dimension() != wgpu::TextureDimension::D2 || texture.sample_count() != 1 {
        return Err(wrong(
            "a 2D texture of one sample".into(),
            format!(
                "{:?}, {} samples",
                texture.dimension(),
                texture.sample_count()
            ),
        ));
    }
    let side = device.wgpu().limits().max_texture_dimension_2d;
    let longest = texture.width().max(texture.height());
    device.require(
        &format!("{what}: pixels along a side"),
        longest.into(),
        side.into(),
    )?;
    Ok(format)
}
