/// Why two sets of points do not give a transform.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RegistrationError {
    /// Three points that are not on a line are the least.
    #[error("expected at least 3 points, found {found}")]
    TooFew {
        /// How many there are.
        found: usize,
    },
    /// A point that is no point, or of which nothing is known.
    #[error("point {index}: expected finite coordinates, a positive covariance and weight")]
    NotFinite {
        /// Which, from 0.
        index: usize,
    },
    /// All points are on a line, or in one place: nothing says how they are turned about it.
    #[error(
        "expected points that are not on one line, found {across_m:.2e} m across a line of {along_m:.2e} m"
    )]
    Collinear {
        /// How far they scatter along the line, metres.
        along_m: f64,
        /// How far they scatter across it, metres.
        across_m: f64,
    },
    /// The points leave the rotation open.
    #[error("the points tell the rotation to {degrees:.0} degrees only: expected 30 or better")]
    Undetermined {
        /// The rotation's standard deviation.
        degrees: f64,
    },
}
