//! The layers of a network in plain Rust: what the kernels are compared to, and what runs without a GPU.
