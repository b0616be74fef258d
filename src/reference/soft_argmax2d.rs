use super::Tensor;
use crate::network::Shape;

/// Where the cells of each heat map vote for, on average (Sun et al. 2018, "Integral Human Pose
/// Regression").
///
/// `heat` has shape `[joints, height, width]`: logits. Under their softmax over a joint's cells,
/// the output `[3 * joints, 1, 1]` is the mean of `origin + step * (column, row)` plus the joint's
/// first two channels of `votes` `[3 * joints, height, width]`, and the mean of the third.
pub fn soft_argmax2d(heat: &Tensor, votes: &Tensor, origin: [f32; 2], step: [f32; 2]) -> Tensor {
    let Shape {
        channels,
        height,
        width,
    } = heat.shape();
    let mut output = Tensor::full(Shape::new(3 * channels, 1, 1), 0.0);
    for (joint, out) in output.data_mut().chunks_exact_mut(3).enumerate() {
        let logits = || (0..height).flat_map(|y| heat.row(joint, y)).copied();
        // Less the greatest logit, no exponential overflows and one of them is 1.
        let greatest = f64::from(logits().fold(f32::MIN, f32::max));
        // In f64 the rounding of some thousand terms stays out of the comparison.
        let mut weights = 0.0;
        let mut sums = [0.0; 3];
        for (cell, logit) in logits().enumerate() {
            let (row, column) = (cell / width, cell % width);
            let vote = |axis: usize| f64::from(votes.row(3 * joint + axis, row)[column]);
            let place = |axis: usize, index: usize| {
                f64::from(origin[axis]) + f64::from(step[axis]) * index as f64 + vote(axis)
            };
            let weight = (f64::from(logit) - greatest).exp();
            weights += weight;
            sums[0] += weight * place(0, column);
            sums[1] += weight * place(1, row);
            sums[2] += weight * vote(2);
        }
        for (out, sum) in out.iter_mut().zip(sums) {
            *out = (sum / weights) as f32;
        }
    }
    output
}
