//! A sweep of all joints through their ranges, in equal steps and in combination (the paper, section 2).

use std::f64::consts::TAU;

use crate::robot::Robot;

/// A grid over the joints' ranges. From one point to the next, one joint moves by one step: the last
/// joint goes to and fro within the strokes of the one before it, and so on to the first.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sweep {
    joints: Vec<Axis>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Axis {
    first: f64,
    step: f64,
    count: usize,
}

impl Sweep {
    /// The grid of at least `points` points. Steps are made finer where a step moves the arm furthest, so
    /// that those near the base get the finest; each joint that can move has two or more.
    ///
    /// A joint that turns by more than a turn is swept through one, in the middle of its range: the rest
    /// would be the same poses again.
    pub(super) fn new(robot: &Robot, points: usize) -> Sweep {
        let origins = robot.joint_origins(&robot.link_poses(&[]));
        let mut spans = Vec::with_capacity(robot.joints.len());
        for (i, joint) in robot.joints.iter().enumerate() {
            let [lower, upper] = joint.range;
            let span = (upper - lower).min(TAU);
            let beyond = origins.get(i..).unwrap_or_default();
            // What hangs on the last joint reaches a little further.
            let length: f64 = beyond
                .windows(2)
                .map(|ends| ends[0].distance(ends[1]))
                .sum();
            spans.push((0.5 * (lower + upper - span), span, span * (length + 0.05)));
        }
        let mut counts: Vec<usize> = spans
            .iter()
            .map(|&(_, span, _)| if span > 0.0 { 2 } else { 1 })
            .collect();
        while counts.iter().product::<usize>() < points {
            let way = |(&(_, _, way), &count): (&(f64, f64, f64), &usize)| way / count as f64;
            let ways: Vec<f64> = spans.iter().zip(&counts).map(way).collect();
            let widest = (0..ways.len()).max_by(|&a, &b| ways[a].total_cmp(&ways[b]));
            match widest.and_then(|i| counts.get_mut(i)) {
                Some(count) if ways.iter().any(|&way| way > 0.0) => *count += 1,
                _ => break,
            }
        }
        let axis = |(&(start, span, _), &count): (&(f64, f64, f64), &usize)| {
            let step = span / count as f64;
            let first = start + 0.5 * step;
            Axis { first, step, count }
        };
        Sweep {
            joints: spans.iter().zip(&counts).map(axis).collect(),
        }
    }

    /// How many points there are.
    pub(super) fn len(&self) -> usize {
        self.joints.iter().map(|axis| axis.count).product()
    }

    /// The joint angles of a point, radians.
    pub(super) fn angles(&self, point: usize) -> Vec<f64> {
        let mut rest = point;
        let mut angles: Vec<f64> = self
            .joints
            .iter()
            .rev()
            .map(|axis| {
                let (stroke, place) = (rest / axis.count, rest % axis.count);
                rest = stroke;
                let there = stroke.is_multiple_of(2);
                let place = if there { place } else { axis.count - 1 - place };
                axis.first + axis.step * place as f64
            })
            .collect();
        angles.reverse();
        angles
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::path::Path;

    use super::{Robot, Sweep, TAU};

    #[test]
    fn a_sweep_moves_one_joint_by_one_step_and_comes_to_all_combinations() {
        let urdf = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/arm/arm.urdf");
        let package = ("arm".to_owned(), urdf.parent().unwrap().to_owned());
        let robot = Robot::load(&urdf, &[package]).unwrap();
        let sweep = Sweep::new(&robot, 100);
        let counts: Vec<usize> = sweep.joints.iter().map(|axis| axis.count).collect();
        assert!(counts.is_sorted_by(|a, b| a >= b), "{counts:?}");
        assert!((100..150).contains(&sweep.len()), "{counts:?}");

        let points: Vec<Vec<f64>> = (0..sweep.len()).map(|i| sweep.angles(i)).collect();
        for pair in points.windows(2) {
            let moved = pair[0].iter().zip(&pair[1]).zip(&sweep.joints);
            let steps: f64 = moved.map(|((a, b), axis)| (a - b).abs() / axis.step).sum();
            assert!((steps - 1.0).abs() < 1e-9, "{pair:?}");
        }
        let mut sorted = points.clone();
        sorted.sort_by(|a, b| a.partial_cmp(b).unwrap());
        sorted.dedup();
        assert_eq!(sorted.len(), points.len());
        for (i, joint) in robot.joints.iter().enumerate() {
            let swept = points.iter().map(|angles| angles[i]);
            let (low, high) = swept.fold((f64::MAX, f64::MIN), |(l, h), a| (l.min(a), h.max(a)));
            let step = sweep.joints[i].step;
            assert!(low >= joint.range[0] && high <= joint.range[1]);
            assert!((high - low + step - (joint.range[1] - joint.range[0]).min(TAU)).abs() < 1e-3);
        }
    }
}
