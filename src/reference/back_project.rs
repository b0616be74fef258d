use super::Tensor;

/// From `(x / z, y / z, ln z)` to the point `(x, y, z)`, joint by joint: `[3 * joints, 1, 1]` to the
/// same. A depth beyond f32 gives values that are not finite.
pub fn back_project(input: &Tensor) -> Tensor {
    let mut output = input.clone();
    for point in output.data_mut().chunks_exact_mut(3) {
        let z = point[2].exp();
        point[0] *= z;
        point[1] *= z;
        point[2] = z;
    }
    output
}
