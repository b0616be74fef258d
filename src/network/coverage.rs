/// How much of a mask is robot, and where.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Coverage {
    /// Pixels with at least the threshold's probability.
    pub pixels: u32,
    /// Pixels with at least the sure threshold's probability.
    pub sure: u32,
    /// Smallest box round `pixels` `[x0, y0, x1, y1]`, both ends inside; `None` where there are none.
    pub bbox: Option<[u32; 4]>,
    /// Pixels whose value is not finite: with any of these, the mask is no result.
    pub not_finite: u32,
}
