//! What a network is: layers, shapes, the model file. No GPU here.

mod arm;
mod coverage;
mod description;
mod graph;
mod layer;
mod model;
mod shape;

pub use arm::{Arm, Links};
pub use coverage::Coverage;
pub use description::{
    Coarse, Description, InputSize, NetworkDescription, Overlay, Presence, Zoom,
};
pub use graph::{Network, Node, Parameters, Source};
pub use layer::{Activation, Layer, Operation};
pub use model::{Model, ModelError};
pub use shape::Shape;

/// What is wrong with a network.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NetworkError {
    /// A layer cannot be what it is described to be.
    #[error("layer `{layer}`: {problem}")]
    Layer {
        /// The layer's name.
        layer: String,
        /// The field, what was expected and what was found.
        problem: String,
    },
    /// A tensor is missing or not as the layers need it.
    #[error("tensor `{tensor}`: expected {expected}, found {found}")]
    Tensor {
        /// The tensor's name in the file.
        tensor: String,
        /// What the layers need.
        expected: String,
        /// What there is.
        found: String,
    },
    /// A network without layers.
    #[error("layers: expected at least one, found none")]
    Empty,
}
