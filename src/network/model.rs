use std::collections::HashSet;
use std::path::{Path, PathBuf};

use half::f16;
use safetensors::{Dtype, SafeTensors};

use super::description::{Description, NetworkDescription};
use super::{Layer, Network, NetworkError, Parameters, Shape, Zoom};

/// A trained model: the networks of the cascade and their description.
#[derive(Debug, Clone)]
pub struct Model {
    /// Everything that is not a tensor.
    pub description: Description,
    /// Colour `[3, height, width]` in [0, 1] to a coarse mask `[1, height, width]` in [0, 1], by which the mask network's camera
    /// is turned; `None` where that is the canonical camera.
    pub coarse_network: Option<Network>,
    /// Colour `[3, height, width]` in [0, 1] to mask `[1, height, width]` in [0, 1].
    pub mask_network: Network,
    /// Overlay `[3, height, width]` to `[3 * joints, 1, 1]`, metres.
    pub joint_network: Network,
}

/// Why a model file was refused. Every message begins with the file's name.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// The file cannot be read.
    #[error("{}: {cause}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// The file is not a well-formed safetensors file.
    #[error("{}: expected a safetensors file, found {problem}", file.display())]
    Format {
        /// The file.
        file: PathBuf,
        /// What the reader stumbled over.
        problem: String,
    },
    /// The description in the file's metadata is missing or not understood.
    #[error("{}: description: {problem}", file.display())]
    Description {
        /// The file.
        file: PathBuf,
        /// The field, what was expected and what was found.
        problem: String,
    },
    /// Layers and tensors do not fit.
    #[error("{}: {cause}", file.display())]
    Network {
        /// The file.
        file: PathBuf,
        /// What does not fit.
        cause: NetworkError,
    },
}

impl Model {
    /// The metadata key that holds the description.
    pub const METADATA_KEY: &'static str = "whereabot";

    /// Reads a model file and checks everything in it.
    ///
    /// # Errors
    /// See [`ModelError`].
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ModelError> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|cause| ModelError::Read {
            file: path.into(),
            cause,
        })?;
        Self::from_bytes(&bytes, path)
    }

    /// Reads a model from memory; `name` stands for the file in errors.
    ///
    /// # Errors
    /// See [`ModelError`].
    pub fn from_bytes(bytes: &[u8], name: impl AsRef<Path>) -> Result<Self, ModelError> {
        let file = name.as_ref();
        let format = |problem: String| ModelError::Format {
            file: file.into(),
            problem,
        };
        let describe = |problem: String| ModelError::Description {
            file: file.into(),
            problem,
        };
        let network = |cause| ModelError::Network {
            file: file.into(),
            cause,
        };

        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| format(e.to_string()))?;
        let tensors = SafeTensors::deserialize(bytes).map_err(|e| format(e.to_string()))?;
        let json = header
            .metadata()
            .as_ref()
            .and_then(|m| m.get(Self::METADATA_KEY))
            .ok_or_else(|| {
                describe(format!(
                    "expected the metadata key `{}`, found none",
                    Self::METADATA_KEY
                ))
            })?;
        let description = Description::from_json(json).map_err(describe)?;

        let mut used = HashSet::new();
        let image = Shape::new(
            3,
            description.input.height as usize,
            description.input.width as usize,
        );
        let mut build = |name: &str, input: &str, layers: &[Layer]| {
            Network::new(input, image, layers.to_vec(), |layer, weight, bias| {
                let mut read = |kind: &str, dims: &[usize]| {
                    let tensor = format!("{name}.{layer}.{kind}");
                    let values = read_tensor(&tensors, &tensor, dims)?;
                    used.insert(tensor);
                    Ok(values)
                };
                Ok(Parameters {
                    weight: read("weight", weight)?,
                    bias: read("bias", bias)?,
                })
            })
            .map_err(|e| network(NetworkDescription::named(name, e)))
        };
        let coarse = description.coarse.as_ref();
        let coarse_network = coarse
            .map(|coarse| build("coarse", "image", &coarse.network.layers))
            .transpose()?;
        let mask_network = build("mask", "image", &description.mask_network.layers)?;
        let joint_network = build("joint", "overlay", &description.joint_network.layers)?;

        if let Some(extra) = tensors.names().into_iter().find(|&n| !used.contains(n)) {
            return Err(network(NetworkError::Tensor {
                tensor: extra.to_owned(),
                expected: "only tensors that a layer of the description uses".into(),
                found: "a tensor that none uses".into(),
            }));
        }
        let same_shape = |what: &str, expected: Shape, found: Shape| {
            if expected == found {
                Ok(())
            } else {
                Err(describe(format!(
                    "{what}: expected an output of shape {expected}, found {found}"
                )))
            }
        };
        let mask_shape = Shape::new(1, image.height, image.width);
        if let Some(network) = &coarse_network {
            same_shape("coarse.network", mask_shape, network.output())?;
        }
        same_shape("mask_network", mask_shape, mask_network.output())?;
        let joint_shape = Shape::new(3 * description.joints.len(), 1, 1);
        same_shape("joint_network", joint_shape, joint_network.output())?;

        Ok(Self {
            description,
            coarse_network,
            mask_network,
            joint_network,
        })
    }

    /// The networks by their names, in the order in which they run.
    pub fn networks(&self) -> impl Iterator<Item = (&'static str, &Network)> {
        let coarse = self
            .coarse_network
            .iter()
            .map(|network| ("coarse", network));
        coarse.chain([("mask", &self.mask_network), ("joint", &self.joint_network)])
    }

    /// The coarse network and what its mask turns, where there is one.
    pub(crate) fn coarse(&self) -> Option<(&Network, Zoom)> {
        let coarse = self.description.coarse.as_ref()?;
        Some((self.coarse_network.as_ref()?, coarse.zoom))
    }
}

/// The values of a tensor of the expected dimensions, f16 widened to f32, all finite.
fn read_tensor(
    tensors: &SafeTensors<'_>,
    name: &str,
    dims: &[usize],
) -> Result<Vec<f32>, NetworkError> {
    let wrong = |expected: String, found: String| NetworkError::Tensor {
        tensor: name.to_owned(),
        expected,
        found,
    };
    let view = tensors
        .tensor(name)
        .map_err(|_| wrong(format!("dimensions {dims:?}"), "no such tensor".into()))?;
    if view.shape() != dims {
        return Err(wrong(
            format!("dimensions {dims:?}"),
            format!("{:?}", view.shape()),
        ));
    }
    let values: Vec<f32> = match view.dtype() {
        Dtype::F32 => view
            .data()
            .chunks_exact(4)
            .map(bytemuck::pod_read_unaligned::<f32>)
            .collect(),
        Dtype::F16 => view
            .data()
            .chunks_exact(2)
            .map(|bytes| bytemuck::pod_read_unaligned::<f16>(bytes).to_f32())
            .collect(),
        other => return Err(wrong("dtype F32 or F16".into(), format!("{other:?}"))),
    };
    match values.iter().position(|v| !v.is_finite()) {
        Some(index) => Err(wrong(
            "finite values".into(),
            format!("{} at index {index}", values[index]),
        )),
        None => Ok(values),
    }
}
