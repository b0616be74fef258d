/// Eigenvalues, smallest first, and their unit eigenvectors, of a symmetric matrix; by cyclic Jacobi rotations, which
/// are exact to rounding for matrices as small as these.
pub(super) fn symmetric_eigen<const N: usize>(mut a: [[f64; N]; N]) -> [(f64, [f64; N]); N] {
    // Columns are the eigenvectors.
    let mut v = [[0.0; N]; N];
    for (i, row) in v.iter_mut().enumerate() {
        row[i] = 1.0;
    }
    // Five sweeps are enough in practice; what is not finite would never end.
    for _ in 0..30 {
        // Summed on their own: of the difference of two large sums too little would be left.
        let (mut off, mut on) = (0.0, 0.0);
        for (i, row) in a.iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                *(if i == j { &mut on } else { &mut off }) += value * value;
            }
        }
        if off <= f64::EPSILON * f64::EPSILON * on {
            break;
        }
        for p in 0..N {
            for q in p + 1..N {
                if a[p][q] == 0.0 {
                    continue;
                }
                let theta = 0.5 * (a[q][q] - a[p][p]) / a[p][q];
                let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
                let c = 1.0 / t.hypot(1.0);
                let s = t * c;
                for row in &mut a {
                    (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
                }
                let (one, two) = (a[p], a[q]);
                a[p] = std::array::from_fn(|k| c * one[k] - s * two[k]);
                a[q] = std::array::from_fn(|k| s * one[k] + c * two[k]);
                for row in &mut v {
                    (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
                }
            }
        }
    }
    let mut pairs: [(f64, [f64; N]); N] =
        std::array::from_fn(|i| (a[i][i], std::array::from_fn(|k| v[k][i])));
    pairs.sort_by(|x, y| x.0.total_cmp(&y.0));
    pairs
}

/// The inverse of a symmetric positive definite matrix; `None` where it is none, to rounding.
pub(super) fn inverse<const N: usize>(a: [[f64; N]; N]) -> Option<[[f64; N]; N]> {
    let pairs = symmetric_eigen(a);
    let (least, most) = (pairs.first()?.0, pairs.last()?.0);
    // Written so that NaN is refused.
    if !(least > 1e-13 * most && most.is_finite()) {
        return None;
    }
    Some(std::array::from_fn(|i| {
        std::array::from_fn(|j| pairs.iter().map(|(value, v)| v[i] * v[j] / value).sum())
    }))
}

#[cfg(test)]
mod tests {
    use super::{inverse, symmetric_eigen};
    use proptest::prelude::*;

    fn symmetric(values: &[f64]) -> [[f64; 6]; 6] {
        std::array::from_fn(|i| std::array::from_fn(|j| values[i.min(j) * 6 + i.max(j)]))
    }

    fn product(a: [[f64; 6]; 6], b: [[f64; 6]; 6]) -> [[f64; 6]; 6] {
        std::array::from_fn(|i| std::array::from_fn(|j| (0..6).map(|k| a[i][k] * b[k][j]).sum()))
    }

    proptest! {
        #[test]
        fn eigenvectors_are_what_the_matrix_only_stretches(values in prop::collection::vec(-1.0..1.0_f64, 36)) {
            let a = symmetric(&values);
            let residual = |value: f64, v: [f64; 6]| -> f64 {
                let off = |i: usize| (0..6).map(|k| a[i][k] * v[k]).sum::<f64>() - value * v[i];
                (0..6).map(off).fold(0.0, |most, r| r.abs().max(most))
            };
            let pairs = symmetric_eigen(a);
            for (value, v) in pairs {
                prop_assert!(residual(value, v) < 1e-12);
                prop_assert!((v.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
                prop_assert!(residual(value + 1e-3, v) > 1e-4);
            }
            prop_assert!(pairs.windows(2).all(|w| w[0].0 <= w[1].0));
        }

        #[test]
        fn inverses_undo(values in prop::collection::vec(-1.0..1.0_f64, 36)) {
            let root = symmetric(&values);
            let mut a = product(root, root);
            for (i, row) in a.iter_mut().enumerate() {
                row[i] += 0.1;
            }
            let found = inverse(a);
            prop_assert!(found.is_some());
            let one = product(a, found.unwrap_or_default());
            for (i, row) in one.iter().enumerate() {
                for (j, &value) in row.iter().enumerate() {
                    prop_assert!((value - f64::from(u8::from(i == j))).abs() < 1e-9);
                }
            }
        }
    }

    #[test]
    fn what_has_no_inverse_has_none() {
        assert_eq!(inverse([[1.0, 1.0], [1.0, 1.0]]), None);
        assert_eq!(inverse([[1.0, 0.0], [0.0, -1.0]]), None);
        assert_eq!(inverse([[f64::NAN, 0.0], [0.0, 1.0]]), None);
        assert_eq!(
            inverse([[2.0, 0.0], [0.0, 4.0]]),
            Some([[0.5, 0.0], [0.0, 0.25]])
        );
    }
}
