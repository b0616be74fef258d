use super::step::{Step, Tensors};
use super::tensor::Tensor;
use super::{Device, GpuError};

/// The channels of `first` and then of `second` (`shaders/concat.wgsl`). A plan needs it only where
/// the producers cannot write to their places among the channels themselves.
pub(super) fn concat(
    device: &Device,
    label: &str,
    first: &Tensor,
    second: &Tensor,
    output: &Tensor,
) -> Result<Step, GpuError> {
    Step::by_texel(
        device,
        label,
        ("concat", include_str!("../../shaders/concat.wgsl")),
        &[
            ("FIRST", first.shape.channels as f64),
            ("CHANNELS", output.shape.channels as f64),
        ],
        Tensors::both_to(first, second, output),
    )
}
