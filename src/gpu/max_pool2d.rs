use super::step::Step;
use super::tensor::{Tensor, blocks};
use super::{Device, GpuError};

/// Maximum over windows of `size` x `size`, side by side (`shaders/max_pool2d.wgsl`).
pub(super) fn max_pool2d(
    device: &Device,
    label: &str,
    input: &Tensor,
    output: &Tensor,
    size: usize,
) -> Result<Step, GpuError> {
    let planes = input.batch * blocks(input.shape.channels);
    Step::from_to(
        device,
        label,
        ("max_pool2d", include_str!("../../shaders/max_pool2d.wgsl")),
        &[
            ("PLANES", planes as f64),
            ("IN_HEIGHT", input.shape.height as f64),
            ("IN_WIDTH", input.shape.width as f64),
            ("SIZE", size as f64),
        ],
        (input, output),
        output.texels(),
    )
}
