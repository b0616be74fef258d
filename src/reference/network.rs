use super::{
    Tensor, back_project, concat, conv2d, dense, max_pool2d, sigmoid, soft_argmax2d, upsample2d,
};
use crate::network::{Network, Node, Operation, Source};

/// The output of `network` for `input`, whose shape must be the network's; `None` where it is not.
pub fn run(network: &Network, input: &Tensor) -> Option<Tensor> {
    run_all(network, input)?.pop()
}

/// The output of every layer of `network`, in order; `None` where `input` has not the network's shape.
pub fn run_all(network: &Network, input: &Tensor) -> Option<Vec<Tensor>> {
    run_each(network, input, |_| ())
}

/// As [`run_all`], and says which layer is done, right after it.
pub fn run_each(
    network: &Network,
    input: &Tensor,
    mut done: impl FnMut(&Node),
) -> Option<Vec<Tensor>> {
    if input.shape() != network.input() {
        return None;
    }
    let mut outputs: Vec<Tensor> = Vec::with_capacity(network.nodes().len());
    for node in network.nodes() {
        let sources = node
            .sources
            .iter()
            .map(|source| match source {
                Source::Input => Some(input),
                Source::Layer(index) => outputs.get(*index),
            })
            .collect::<Option<Vec<_>>>()?;
        let source = *sources.first()?;
        let output = match node.layer.operation {
            Operation::Conv2d {
                kernel,
                dilation,
                activation,
                ..
            } => conv2d(
                source,
                node.parameters.as_ref()?,
                kernel,
                dilation,
                activation,
            ),
            Operation::MaxPool2d { size } => max_pool2d(source, size),
            Operation::Dense { activation, .. } => {
                dense(source, node.parameters.as_ref()?, activation)
            }
            Operation::Sigmoid => sigmoid(source),
            Operation::Upsample2d { scale } => upsample2d(source, scale),
            Operation::Concat => concat(&sources),
            Operation::SoftArgmax2d { origin, step } => {
                soft_argmax2d(source, sources.get(1)?, origin, step)
            }
            Operation::BackProject => back_project(source),
        };
        outputs.push(output);
        done(node);
    }
    Some(outputs)
}
