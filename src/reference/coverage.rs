use super::Tensor;
use crate::network::Coverage;

/// Counts and bounds the pixels of `mask` `[1, height, width]` that reach `threshold`, and counts
/// those that reach `sure_threshold`.
pub fn coverage(mask: &Tensor, threshold: f32, sure_threshold: f32) -> Coverage {
    let mut result = Coverage {
        pixels: 0,
        sure: 0,
        bbox: None,
        not_finite: 0,
    };
    for (y, row) in mask.data().chunks_exact(mask.shape().width).enumerate() {
        for (x, &probability) in row.iter().enumerate() {
            if !probability.is_finite() {
                result.not_finite += 1;
                continue;
            }
            result.sure += u32::from(probability >= sure_threshold);
            if probability >= threshold {
                let (x, y) = (x as u32, y as u32);
                result.pixels += 1;
                let [x0, y0, x1, y1] = result.bbox.unwrap_or([x, y, x, y]);
                result.bbox = Some([x0.min(x), y0.min(y), x1.max(x), y1.max(y)]);
            }
        }
    }
    result
}
