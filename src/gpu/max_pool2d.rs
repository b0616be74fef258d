use super::step::{Step, Tensors};
use super::tensor::Tensor;
use super::{Device, GpuError};

/// Maximum over windows of `size` x `size`, side by side (`shaders/max_pool2d.wgsl`).
pub(super) fn max_pool2d(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
    size: usize,
) -> Result<Step, GpuError> {
    Step::by_texel(
        device,
        label,
        ("max_pool2d", include_str!("../../shaders/max_pool2d.wgsl")),
        &[("SIZE", size as f64)],
        Tensors::from_to(input, output),
    )
}
