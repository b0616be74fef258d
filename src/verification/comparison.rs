use serde::Serialize;

use super::report::Outcome;

/// What the adapter makes of an input, beside what the reference makes of it.
#[derive(Debug, Clone)]
pub(super) struct Comparison {
    pub found: Vec<f32>,
    pub expected: Vec<f32>,
    /// What the adapter makes of another input: the negative control.
    pub control: Vec<f32>,
    /// The largest difference that rounding explains.
    pub allowed: f32,
}

/// How far apart adapter and reference are.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Figures {
    /// How many inputs were compared.
    pub cases: usize,
    /// The largest absolute difference between a value of the adapter's and the reference's, in the case that
    /// comes nearest to what is allowed. Infinite (`null` in JSON) where a value is no number or is missing.
    pub difference: f32,
    /// What is allowed in that case.
    pub allowed: f32,
    /// The same difference after one value of the adapter's input was made wrong, in the case where it is
    /// least; more than is allowed, or the comparison proves nothing.
    pub control: f32,
}

/// Sums up `comparisons`, of which there is at least one.
pub(super) fn judge(comparisons: &[Comparison]) -> Outcome {
    let mut figures = Figures {
        cases: comparisons.len(),
        difference: 0.0,
        allowed: 0.0,
        control: f32::INFINITY,
    };
    let mut nearest = -1.0;
    let (mut agrees, mut proven) = (true, true);
    for comparison in comparisons {
        let allowed = comparison.allowed;
        let found = difference(&comparison.found, &comparison.expected);
        let control = difference(&comparison.control, &comparison.expected);
        agrees &= found <= allowed;
        proven &= control > allowed;
        figures.control = figures.control.min(control);
        // Where nothing is allowed, no difference is 0 of it.
        let share = if found == 0.0 { 0.0 } else { found / allowed };
        if share > nearest {
            nearest = share;
            (figures.difference, figures.allowed) = (found, allowed);
        }
    }
    match (agrees, proven) {
        (false, _) => Outcome::Disagrees(figures),
        (true, false) => Outcome::Unproven(figures),
        (true, true) => Outcome::Agrees(figures),
    }
}

/// The largest absolute difference; infinite for values that are no numbers, and for different lengths.
fn difference(a: &[f32], b: &[f32]) -> f32 {
    if a.len() != b.len() {
        return f32::INFINITY;
    }
    let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    differences.fold(0.0, |greatest, d| {
        if d.is_nan() {
            f32::INFINITY
        } else {
            greatest.max(d)
        }
    })
}

#[cfg(test)]
#[allow(clippy::panic)]
mod tests {
    use super::*;

    fn comparison(found: f32, control: f32, allowed: f32) -> Comparison {
        Comparison {
            found: vec![0.0, found],
            expected: vec![0.0; 2],
            control: vec![0.0, control],
            allowed,
        }
    }

    #[test]
    fn the_case_nearest_to_its_bound_is_told() {
        let cases = [comparison(0.2, 7.0, 1.0), comparison(-0.1, 5.0, 0.125)];
        let expected = Figures {
            cases: 2,
            difference: 0.1,
            allowed: 0.125,
            control: 5.0,
        };
        assert_eq!(judge(&cases), Outcome::Agrees(expected));
    }

    #[test]
    fn one_wrong_case_is_enough() {
        let right = comparison(0.0, 5.0, 0.0);
        for wrong in [0.3, f32::NAN, f32::INFINITY] {
            let outcome = judge(&[right.clone(), comparison(wrong, 5.0, 0.2)]);
            let Outcome::Disagrees(figures) = outcome else {
                panic!("{outcome:?}");
            };
            assert_eq!(figures.allowed, 0.2);
            assert!(figures.difference >= 0.3);
        }
        let mut short = comparison(0.0, 5.0, 0.2);
        short.found.pop();
        assert!(matches!(judge(&[right, short]), Outcome::Disagrees(_)));
    }

    #[test]
    fn a_control_that_is_not_noticed_proves_nothing() {
        let cases = [comparison(0.0, 5.0, 0.0), comparison(0.0, 0.1, 0.1)];
        assert!(matches!(judge(&cases), Outcome::Unproven(_)));
    }
}
