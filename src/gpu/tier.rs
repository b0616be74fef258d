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
    /// The tier that an adapter reaches.
    pub fn of(adapter: &wgpu::Adapter) -> Self {
        let features = adapter.features();
        let matrix = wgpu::Features::EXPERIMENTAL_COOPERATIVE_MATRIX;
        match Self::with(features) {
            Self::Subgroups if features.contains(matrix) && matrices(adapter) => {
                Self::CooperativeMatrix
            }
            tier => tier,
        }
    }

    /// The tier of a device of which only `features` are known. An adapter alone tells which matrices it
    /// multiplies.
    pub fn with(features: wgpu::Features) -> Self {
        if !features.contains(wgpu::Features::SHADER_F16) {
            Self::Baseline
        } else if !features.contains(wgpu::Features::SUBGROUP) {
            Self::F16
        } else {
            Self::Subgroups
        }
    }
}

/// Whether it multiplies 16 x 16 halves and sums them in 32 bits, in subgroups of 32, with the workgroup
/// memory that `conv2d_matrix` takes.
fn matrices(adapter: &wgpu::Adapter) -> bool {
    use wgpu::CooperativeScalarType::{F16, F32};
    let info = adapter.get_info();
    let sizes = [info.subgroup_min_size, info.subgroup_max_size];
    let fits = adapter.limits().max_compute_workgroup_storage_size >= 32 << 10;
    let mut configurations = adapter.cooperative_matrix_properties().into_iter();
    fits && sizes == [32, 32]
        && configurations.any(|c| {
            [c.m_size, c.n_size, c.k_size] == [16; 3] && (c.ab_type, c.cr_type) == (F16, F32)
        })
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
