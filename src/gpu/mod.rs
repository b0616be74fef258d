//! The layers of a network as compute kernels on wgpu.
