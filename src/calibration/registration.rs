use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::eigen::{inverse, symmetric_eigen};
use super::{RegistrationError, Spread};

/// A point that is known in two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair {
    /// In the frame to come from, metres.
    pub from: DVec3,
    /// What is known of its error there, square metres.
    pub from_covariance: DMat3,
    /// In the frame to go to, metres.
    pub to: DVec3,
    /// What is known of its error there, square metres; zero for a point that is exact.
    pub to_covariance: DMat3,
    /// How much it counts: 1, or less where it is old.
    pub weight: f64,
    /// Pairs of one group (one image, one pose of the robot) may err together.
    pub group: usize,
}

impl Pair {
    /// The covariance of the pair's residual in the frame to go to.
    fn covariance(&self, rotation: DMat3) -> DMat3 {
        self.to_covariance + rotation * self.from_covariance * rotation.transpose()
    }

    /// Mean variance along an axis, square metres.
    fn variance(&self) -> f64 {
        let both = self.from_covariance + self.to_covariance;
        (both.x_axis.x + both.y_axis.y + both.z_axis.z) / 3.0
    }
}

/// Poses of the robot in which no joint is farther from the other's than this, metres, count as one: what the networks
/// make of them errs alike.
const SAME_POSE_M: f64 = 0.05;

/// Whether these are joints of one pose of the robot, in one frame.
pub(super) fn is_same_pose(a: &[DVec3], b: &[DVec3]) -> bool {
    let mut joints = a.iter().zip(b);
    a.len() == b.len() && joints.all(|(a, b)| a.distance(*b) < SAME_POSE_M)
}

impl Pair {
    /// From a camera's frame to the robot's base frame. Of each image the joints in the camera's optical frame, as they
    /// were found, and the same joints in the base frame, by the robot's joint angles; metres. A group is a pose of the
    /// robot, numbered from 0.
    pub fn of_images<'a>(
        images: impl IntoIterator<Item = (&'a [DVec3], &'a [DVec3])>,
    ) -> Vec<Self> {
        let mut poses: Vec<&[DVec3]> = Vec::new();
        let mut pairs = Vec::new();
        for (found, base) in images {
            let same = |pose: &&[DVec3]| is_same_pose(pose, base);
            let group = poses.iter().position(same).unwrap_or(poses.len());
            if group == poses.len() {
                poses.push(base);
            }
            pairs.extend(found.iter().zip(base).map(|(&from, &to)| Self {
                from,
                from_covariance: Spread::at(from).covariance(from),
                to,
                to_covariance: DMat3::ZERO,
                weight: 1.0,
                group,
            }));
        }
        pairs
    }
}

/// A transform between two frames, and how sure it is.
#[derive(Debug, Clone, PartialEq)]
pub struct Registration {
    /// From the one frame to the other: a rotation, then a shift in metres.
    pub transform: DAffine3,
    /// Of the rotation (a rotation vector in the frame to go to, radians: the true rotation is `exp(r)` times the
    /// transform's) and of the shift (metres), in this order.
    pub covariance: [[f64; 6]; 6],
    /// How many times larger the residuals of the inliers are than their pairs' covariances say: far above 1 where
    /// the points of most pairs are not the same.
    pub scale: f64,
    /// Which pairs agree with the transform.
    pub inliers: Vec<bool>,
}

impl Registration {
    /// Standard deviation of the rotation's angle, radians.
    pub fn rotation_sigma_rad(&self) -> f64 {
        trace(&self.covariance, 0).sqrt()
    }

    /// Standard deviation of the shift in space, metres.
    pub fn translation_sigma_m(&self) -> f64 {
        trace(&self.covariance, 3).sqrt()
    }

    /// The way back.
    pub fn inverse(&self) -> Self {
        let transform = self.transform.inverse();
        let back = -transform.matrix3;
        // An error of the rotation moves the other frame's origin, too.
        let lever = jacobian(self.transform.translation).map(|column| -(back * column));
        let moves: [[f64; 6]; 6] = std::array::from_fn(|i| {
            std::array::from_fn(|j| match (i < 3, j < 3) {
                (true, true) => back.col(j)[i],
                (true, false) => 0.0,
                (false, true) => lever[j][i - 3],
                (false, false) => back.col(j - 3)[i - 3],
            })
        });
        Self {
            transform,
            covariance: carried(moves, self.covariance),
            scale: self.scale,
            inliers: self.inliers.clone(),
        }
    }

    /// Share of the pairs that agree with the transform, in [0, 1].
    pub fn inlier_share(&self) -> f64 {
        let inliers = self.inliers.iter().filter(|&&inlier| inlier).count();
        inliers as f64 / self.inliers.len() as f64
    }
}

/// Of three diagonal elements, from `first`.
pub(super) fn trace(matrix: &[[f64; 6]; 6], first: usize) -> f64 {
    (first..first + 3).map(|i| matrix[i][i]).sum()
}

/// The rotation and shift that bring points `(from, to, weight)` closest together in the sense of weighted least
/// squares, by unit quaternions (Horn 1987): what Kabsch (1976) and Umeyama (1991) find by singular values. It is a
/// proper rotation for mirrored points too.
///
/// # Errors
/// Fewer than three points; points on a line.
pub fn kabsch(
    points: impl Iterator<Item = (DVec3, DVec3, f64)> + Clone,
) -> Result<DAffine3, RegistrationError> {
    let found = points.clone().count();
    if found < 3 {
        return Err(RegistrationError::TooFew { found });
    }
    let (mut from_mean, mut to_mean, mut total) = (DVec3::ZERO, DVec3::ZERO, 0.0);
    for (from, to, weight) in points.clone() {
        from_mean += weight * from;
        to_mean += weight * to;
        total += weight;
    }
    from_mean /= total;
    to_mean /= total;
    let outer = |a: DVec3, b: DVec3| DMat3::from_cols(a * b.x, a * b.y, a * b.z);
    let (mut both, mut of_from, mut of_to) = (DMat3::ZERO, DMat3::ZERO, DMat3::ZERO);
    for (from, to, weight) in points {
        let (from, to) = (from - from_mean, to - to_mean);
        both += outer(weight * from, to);
        of_from += outer(weight * from, from);
        of_to += outer(weight * to, to);
    }
    for scatter in [of_from, of_to] {
        let [_, (across, _), (along, _)] = symmetric_eigen(scatter.to_cols_array_2d());
        let [across_m, along_m] = [across, along].map(|s| (s.max(0.0) / total).sqrt());
        // Written so that NaN is refused.
        let apart = across_m > 1e-6 * along_m;
        if !apart {
            return Err(RegistrationError::Collinear { along_m, across_m });
        }
    }
    // Columns of `both` belong to `to`: s[i][j] is the sum of from_i to_j.
    let [[xx, yx, zx], [xy, yy, zy], [xz, yz, zz]] = both.to_cols_array_2d();
    let [.., (_, [w, x, y, z])] = symmetric_eigen([
        [xx + yy + zz, yz - zy, zx - xz, xy - yx],
        [yz - zy, xx - yy - zz, xy + yx, zx + xz],
        [zx - xz, xy + yx, yy - xx - zz, yz + zy],
        [xy - yx, zx + xz, yz + zy, zz - xx - yy],
    ]);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    Ok(DAffine3::from_mat3_translation(
        rotation,
        to_mean - rotation * from_mean,
    ))
}

/// Triples that the search starts from: if half of the pairs are wrong, one in eight triples is right, and none of
/// these is once in a thousand searches.
const STARTS: usize = 52;
/// Median of the length of a vector of three normal deviates.
const MEDIAN_CHI_3: f64 = 1.538_17;
/// 99 % of these are shorter.
pub(super) const P99_CHI_3: f64 = 3.368_21;
/// Up to so many groups their errors in common cannot be told from the residuals.
const FEW_GROUPS: usize = 10;

/// The rotation and shift from one frame to the other that agrees with most of the pairs; up to half of them may be
/// wrong by any amount.
///
/// Least trimmed squares (Rousseeuw and Van Driessen's FAST-LTS) find the half of the pairs that agree best. The
/// median residual then says how large errors are, and what is within the 99 % of such errors counts: Gauss-Newton on
/// these, each weighted by its covariance, until nothing changes.
///
/// The covariance comes from the residuals. From ten groups of inliers on it is that of errors which are alike within a
/// group (the sandwich estimator, clustered by group); with fewer, all pairs of a group count as one. An error that
/// is the same in all groups, such as that of a wrong focal length, leaves no residual and is not in it.
///
/// The same pairs give the same answer.
///
/// # Errors
/// Fewer than three pairs, pairs on a line, values that are not finite, and pairs that leave the rotation open.
pub fn register(pairs: &[Pair]) -> Result<Registration, RegistrationError> {
    if pairs.len() < 3 {
        return Err(RegistrationError::TooFew { found: pairs.len() });
    }
    let usable = |pair: &Pair| {
        let positive = |value: f64| value.is_finite() && value > 0.0;
        pair.from.is_finite()
            && pair.to.is_finite()
            && positive(pair.variance())
            && positive(pair.weight)
    };
    if let Some(index) = pairs.iter().position(|pair| !usable(pair)) {
        return Err(RegistrationError::NotFinite { index });
    }
    let mut transform = trimmed(pairs)?;
    let mut inliers = vec![false; pairs.len()];
    for _ in 0..50 {
        let distances = distances(pairs, transform)?;
        let sigma = median(&distances) / MEDIAN_CHI_3;
        // Where half of the pairs agree to the last digit, rounding is no outlier.
        let most = (P99_CHI_3 * sigma).max(1e-9);
        let agree: Vec<bool> = distances.iter().map(|&d| d <= most).collect();
        let before = std::mem::replace(&mut inliers, agree);
        let normal = Normal::new(pairs, &inliers, transform);
        let step = normal.step().ok_or_else(|| open(DVec3::INFINITY))?;
        transform = moved(transform, step);
        let small = step.iter().all(|s| s.abs() < 1e-12);
        if small || (inliers == before && step.iter().all(|s| s.abs() < 1e-10)) {
            break;
        }
    }
    finish(pairs, inliers, transform)
}

fn open(sigma: DVec3) -> RegistrationError {
    RegistrationError::Undetermined {
        degrees: sigma.length().to_degrees(),
    }
}

fn finish(
    pairs: &[Pair],
    inliers: Vec<bool>,
    transform: DAffine3,
) -> Result<Registration, RegistrationError> {
    let normal = Normal::new(pairs, &inliers, transform);
    let bread = inverse(normal.matrix).ok_or_else(|| open(DVec3::INFINITY))?;
    let count = inliers.iter().filter(|&&inlier| inlier).count();
    // Six numbers were fitted.
    let freedom = (3 * count).saturating_sub(6);
    let scale = (normal.square / freedom.max(1) as f64).sqrt();
    let mut groups: Vec<(usize, [f64; 6])> = normal.gradients;
    groups.sort_by_key(|(group, _)| *group);
    let groups = groups.chunk_by(|a, b| a.0 == b.0);
    let count_of_groups = groups.clone().count();
    let covariance = if count_of_groups >= FEW_GROUPS {
        let mut meat = [[0.0; 6]; 6];
        for group in groups {
            let sum: [f64; 6] =
                std::array::from_fn(|i| group.iter().map(|(_, gradient)| gradient[i]).sum());
            for (i, row) in meat.iter_mut().enumerate() {
                for (j, value) in row.iter_mut().enumerate() {
                    *value += sum[i] * sum[j];
                }
            }
        }
        let few = count_of_groups as f64 / (count_of_groups as f64 - 1.0);
        scaled(product(product(bread, meat), bread), few)
    } else {
        scaled(bread, scale * scale * count as f64 / count_of_groups as f64)
    };
    let sigma = DVec3::from_array(std::array::from_fn(|i| covariance[i][i].max(0.0).sqrt()));
    // Written so that NaN is refused.
    let told = sigma.length() <= 30_f64.to_radians();
    if !told {
        return Err(open(sigma));
    }
    Ok(Registration {
        transform,
        covariance,
        scale,
        inliers,
    })
}

/// Gauss-Newton's normal equations at a transform, from the inliers.
struct Normal {
    matrix: [[f64; 6]; 6],
    /// Each inlier's group and its part of the right side.
    gradients: Vec<(usize, [f64; 6])>,
    /// The sum of squared residuals, in units of their covariances.
    square: f64,
}

impl Normal {
    fn new(pairs: &[Pair], inliers: &[bool], transform: DAffine3) -> Self {
        let mut normal = Self {
            matrix: [[0.0; 6]; 6],
            gradients: Vec::with_capacity(pairs.len()),
            square: 0.0,
        };
        for (pair, _) in pairs.iter().zip(inliers).filter(|&(_, &inlier)| inlier) {
            let turned = transform.matrix3 * pair.from;
            let residual = pair.to - turned - transform.translation;
            let information = pair.covariance(transform.matrix3).inverse();
            let weight = pair.weight * information;
            // A rotation r and a shift s move the point by r x turned + s.
            let jacobian = jacobian(turned);
            let weighted = jacobian.map(|column| weight * column);
            for (row, a) in normal.matrix.iter_mut().zip(weighted) {
                for (value, b) in row.iter_mut().zip(jacobian) {
                    *value += a.dot(b);
                }
            }
            let gradient = weighted.map(|column| column.dot(residual));
            normal.gradients.push((pair.group, gradient));
            normal.square += residual.dot(information * residual);
        }
        normal
    }

    fn step(&self) -> Option<[f64; 6]> {
        let inverse = inverse(self.matrix)?;
        let right: [f64; 6] =
            std::array::from_fn(|i| self.gradients.iter().map(|(_, gradient)| gradient[i]).sum());
        Some(std::array::from_fn(|i| {
            inverse[i].iter().zip(right).map(|(a, b)| a * b).sum()
        }))
    }
}

/// How a point that was turned to `turned` moves with each of a rotation vector's and a shift's six numbers.
pub(super) fn jacobian(turned: DVec3) -> [DVec3; 6] {
    [
        DVec3::X.cross(turned),
        DVec3::Y.cross(turned),
        DVec3::Z.cross(turned),
        DVec3::X,
        DVec3::Y,
        DVec3::Z,
    ]
}

fn moved(transform: DAffine3, [a, b, c, x, y, z]: [f64; 6]) -> DAffine3 {
    let turn = DQuat::from_scaled_axis(DVec3::new(a, b, c));
    // By way of a quaternion, so that it stays a rotation.
    let rotation = (turn * DQuat::from_mat3(&transform.matrix3)).normalize();
    DAffine3::from_rotation_translation(rotation, transform.translation + DVec3::new(x, y, z))
}

fn product(a: [[f64; 6]; 6], b: [[f64; 6]; 6]) -> [[f64; 6]; 6] {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| a[i].iter().zip(&b).map(|(a, row)| a * row[j]).sum())
    })
}

/// `m c mᵀ`: the covariance of what `m` makes of something whose covariance is `c`.
pub(super) fn carried(m: [[f64; 6]; 6], c: [[f64; 6]; 6]) -> [[f64; 6]; 6] {
    let transposed = std::array::from_fn(|i| std::array::from_fn(|j| m[j][i]));
    product(product(m, c), transposed)
}

fn scaled(a: [[f64; 6]; 6], factor: f64) -> [[f64; 6]; 6] {
    a.map(|row| row.map(|value| factor * value))
}

/// Lengths of the residuals, in units of their covariances.
fn distances(pairs: &[Pair], transform: DAffine3) -> Result<Vec<f64>, RegistrationError> {
    let distance = |(index, pair): (usize, &Pair)| {
        let residual = pair.to - transform.transform_point3(pair.from);
        let square = residual.dot(pair.covariance(transform.matrix3).inverse() * residual);
        if square.is_finite() && square >= 0.0 {
            Ok(square.sqrt())
        } else {
            Err(RegistrationError::NotFinite { index })
        }
    };
    pairs.iter().enumerate().map(distance).collect()
}

fn median(values: &[f64]) -> f64 {
    let mut values = values.to_vec();
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The transform that fits the half of the pairs best which it fits best.
fn trimmed(pairs: &[Pair]) -> Result<DAffine3, RegistrationError> {
    let weight = |pair: &Pair| pair.weight / pair.variance();
    let points: Vec<(DVec3, DVec3, f64)> = pairs
        .iter()
        .map(|pair| (pair.from, pair.to, weight(pair)))
        .collect();
    let all = kabsch(points.iter().copied())?;
    // Of n pairs more than (n + 3) / 2 right ones are not outvoted by the rest.
    let half = points.len().midpoint(3);
    let mut order: Vec<(f64, usize)> = Vec::with_capacity(points.len());
    // A concentration step: the best fit of what the last one fits best, and how well that did.
    let mut concentrate = |transform: DAffine3| -> Option<(f64, DAffine3)> {
        order.clear();
        order.extend(pairs.iter().enumerate().map(|(index, pair)| {
            let residual = pair.to - transform.transform_point3(pair.from);
            (residual.length_squared() / pair.variance(), index)
        }));
        if half < order.len() {
            order.select_nth_unstable_by(half, |a, b| a.0.total_cmp(&b.0));
        }
        let best = order.iter().take(half);
        let square = best.clone().map(|(square, _)| square).sum();
        let best = best.filter_map(|&(_, index)| points.get(index).copied());
        Some((square, kabsch(best).ok()?))
    };
    let mut random = SplitMix(0);
    let triples = (0..STARTS).filter_map(|_| {
        let triple = [(); 3].map(|()| random.below(points.len()));
        let three = triple
            .iter()
            .filter_map(|&index| points.get(index).copied());
        kabsch(three).ok()
    });
    let starts: Vec<DAffine3> = std::iter::once(all).chain(triples).collect();
    let mut tried: Vec<(f64, DAffine3)> = starts
        .into_iter()
        .filter_map(|start| {
            let (_, once) = concentrate(start)?;
            concentrate(once)
        })
        .collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut best = (f64::INFINITY, all);
    for &(_, start) in tried.iter().take(5) {
        let mut transform = start;
        for _ in 0..20 {
            let Some((square, next)) = concentrate(transform) else {
                break;
            };
            if square < best.0 {
                best = (square, transform);
            }
            transform = next;
        }
    }
    Ok(best.1)
}

/// Steele, Lea and Flood's generator: all that picking triples asks for.
struct SplitMix(u64);

impl SplitMix {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        // Multiply and shift: without a division, and even enough.
        ((u128::from(z ^ (z >> 31)) * end as u128) >> 64) as usize
    }
}
