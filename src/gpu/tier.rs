use std::fmt;

/// What an adapter's kernels can use, from least to most. Decided here and nowhere else.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Tier {
    /// WebGPU without optional features.
    Baseline,
    /// 16-bit floats as well.
    F16,
    /// Subgroup operations as well.
    Subgroups,
    /// Cooperative matrices as well.
    CooperativeMatrix,
}

impl Tier {
    /// The tier that these features reach.
    pub fn of(features: wgpu::Features) -> Self {
        use wgpu::Features as F;
        if !features.contains(F::SHADER_F16) {
            Self::Baseline
        } else if !features.contains(F::SUBGROUP) {
            Self::F16
        } else if !features.contains(F::EXPERIMENTAL_COOPERATIVE_MATRIX) {
            Self::Subgroups
        } else {
            Self::CooperativeMatrix
        }
    }
}

impl fmt::Display for Tier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Baseline => "baseline",
            Self::F16 => "f16",
            Self::Subgroups => "f16 + subgroups",
            Self::CooperativeMatrix => "f16 + subgroups + cooperative matrices",
        })
    }
}
