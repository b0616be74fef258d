use serde::{Deserialize, Serialize};

use super::{Arm, Layer, NetworkError};
use crate::camera::Intrinsics;

/// Everything about a model that is not a tensor: the JSON under the key `whereabot` of a model
/// file's metadata.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// Version of this description; [`Description::VERSION`] is the one understood here.
    pub version: u32,
    /// Family of the networks: `paper` for the shape published in the paper.
    pub family: String,
    /// The robot that the model was trained to find, such as `ur5`.
    pub robot: String,
    /// Names of the joints in the order of the joint network's output.
    pub joints: Vec<String>,
    /// Size of the image that both networks take.
    pub input: InputSize,
    /// The pinhole camera that the networks were trained on, in pixels of `input`.
    pub camera: Intrinsics,
    /// What turns the mask network's camera to the robot; without it, it is the canonical camera.
    #[serde(default)]
    pub coarse: Option<Coarse>,
    /// From colour `[3, height, width]` to the robot's mask `[1, height, width]` (paper, section III).
    pub mask_network: NetworkDescription,
    /// How mask and colour make the joint network's input.
    pub overlay: Overlay,
    /// Where the joint network's camera looks; without it, it is the canonical camera.
    #[serde(default)]
    pub zoom: Option<Zoom>,
    /// From the overlay `[3, height, width]` to `x, y, z` of each joint, in metres, in the camera
    /// optical frame.
    pub joint_network: NetworkDescription,
    /// What moves the joint network's joints to where an arm can have them; without it, they stay where they are.
    #[serde(default)]
    pub arm: Option<Arm>,
    /// When a mask means that there is a robot.
    pub presence: Presence,
    /// The model card: data, protocol, figures. Free in form.
    #[serde(default)]
    pub card: serde_json::Value,
}

/// Size of an image, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputSize {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// The layers of one network.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkDescription {
    /// In the order in which they run; the last one is the output.
    pub layers: Vec<Layer>,
}

/// A mask from little arithmetic, and the camera that is turned by it.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Coarse {
    /// From colour `[3, height, width]` to a coarse mask `[1, height, width]`.
    pub network: NetworkDescription,
    /// Where the mask network's camera looks, each pixel of the coarse mask as heavy as it is probable.
    pub zoom: Zoom,
}

/// How mask and colour make the joint network's input.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "rule", rename_all = "snake_case", deny_unknown_fields)]
pub enum Overlay {
    /// Colour times the mask's probability.
    Multiply {},
    /// Colour where the mask's probability is at least `threshold`, black elsewhere.
    Threshold {
        /// In (0, 1).
        threshold: f32,
    },
    /// Colour where the mask's probability is at least `high`, black where it is at most `low`, in proportion between: no
    /// pixel then depends on a rounding.
    Ramp {
        /// In [0, 1).
        low: f32,
        /// In (`low`, 1].
        high: f32,
    },
}

impl Overlay {
    /// The probabilities up to which nothing shows through and from which all does; the same for a threshold.
    pub(crate) fn bounds(self) -> (f32, f32) {
        match self {
            Self::Multiply {} => (0.0, 1.0),
            Self::Threshold { threshold } => (threshold, threshold),
            Self::Ramp { low, high } => (low, high),
        }
    }

    /// How much of the colour shows through where the mask has this `probability`: 0 to 1.
    pub fn share(self, probability: f32) -> f32 {
        let (low, high) = self.bounds();
        if high > low {
            ((probability - low) / (high - low)).clamp(0.0, 1.0)
        } else {
            f32::from(probability >= low)
        }
    }
}

/// How a network's camera turns to the robot: to the mean of the mask's pixels, zoomed so that so many of their
/// standard deviations are as wide or as high as the image, whichever is the less zoom; in steps of an eighth of an
/// octave, and of a 64th of the width that it sees.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Zoom {
    /// Standard deviations across the image.
    pub spread: f32,
    /// Least zoom, as a multiple of the canonical camera's focal length.
    pub least: f32,
    /// Greatest zoom, likewise.
    pub most: f32,
}

/// When a mask means that there is a robot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Presence {
    /// A pixel belongs to the robot from this probability on, in (0, 1).
    pub mask_threshold: f32,
    /// A pixel surely belongs to the robot from this probability on, in (0, 1).
    pub sure_threshold: f32,
    /// Smallest share of the image that must surely be robot, in [0, 1]: what is not robot seldom
    /// gets a high probability, however much of it gets a middling one.
    pub min_sure: f32,
}

impl Presence {
    /// The fewest sure pixels, of so many in the image, that mean a robot.
    pub fn min_sure_pixels(&self, pixels: u32) -> u32 {
        (f64::from(self.min_sure) * f64::from(pixels)).ceil() as u32
    }
}

impl Description {
    /// The version of the description that this library reads.
    pub const VERSION: u32 = 1;

    /// Reads it from JSON, and checks it.
    ///
    /// # Errors
    /// The field, what was expected and what was found.
    pub(super) fn from_json(json: &str) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Version {
            version: u32,
        }
        // First: what another version has besides is not what is wrong with it.
        let Version { version } = serde_json::from_str(json).map_err(|e| e.to_string())?;
        if version != Self::VERSION {
            let expected = Self::VERSION;
            return Err(format!("version: expected {expected}, found {version}"));
        }
        let description: Self = serde_json::from_str(json).map_err(|e| e.to_string())?;
        description.check()?;
        Ok(description)
    }

    /// Checks what the types do not say.
    fn check(&self) -> Result<(), String> {
        let Self {
            camera: Intrinsics { fx, fy, cx, cy },
            input: InputSize { width, height },
            ..
        } = *self;
        // Sides up to 8192 keep every index of an image 32-bit.
        if !(1..=8192).contains(&width) || !(1..=8192).contains(&height) {
            return Err(format!(
                "input: expected sides of 1 to 8192 pixels, found {width} x {height}"
            ));
        }
        if !(fx.is_finite() && fx > 0.0 && fy.is_finite() && fy > 0.0) {
            return Err(format!(
                "camera: expected positive focal lengths, found fx {fx}, fy {fy}"
            ));
        }
        if !(cx.is_finite() && cy.is_finite()) {
            return Err(format!(
                "camera: expected a finite principal point, found cx {cx}, cy {cy}"
            ));
        }
        if self.joints.is_empty() {
            return Err("joints: expected at least one name, found none".into());
        }
        let inside = |what: &str, value: f32| {
            if value > 0.0 && value < 1.0 {
                Ok(())
            } else {
                Err(format!(
                    "{what}: expected a number between 0 and 1, found {value}"
                ))
            }
        };
        inside("presence.mask_threshold", self.presence.mask_threshold)?;
        inside("presence.sure_threshold", self.presence.sure_threshold)?;
        match self.overlay {
            Overlay::Multiply {} => {}
            Overlay::Threshold { threshold } => inside("overlay.threshold", threshold)?,
            Overlay::Ramp { low, high } => {
                if !(low >= 0.0 && low < high && high <= 1.0) {
                    return Err(format!(
                        "overlay: expected low below high, both from 0 to 1, found low {low}, high {high}"
                    ));
                }
            }
        }
        let coarse = self.coarse.as_ref().map(|coarse| coarse.zoom);
        for (key, zoom) in [("coarse.zoom", coarse), ("zoom", self.zoom)] {
            let Some(Zoom {
                spread,
                least,
                most,
            }) = zoom
            else {
                continue;
            };
            if ![spread, least, most]
                .iter()
                .all(|v| (0.01..=100.0).contains(v))
                || least > most
            {
                return Err(format!(
                    "{key}: expected numbers between 0.01 and 100, least not above most, found spread {spread}, least \
                     {least}, most {most}"
                ));
            }
        }
        if let Some(arm) = &self.arm {
            arm.check(self.joints.len())?;
        }
        if !(0.0..=1.0).contains(&self.presence.min_sure) {
            return Err(format!(
                "presence.min_sure: expected 0 to 1, found {}",
                self.presence.min_sure
            ));
        }
        Ok(())
    }
}

impl NetworkDescription {
    /// Wraps an error with the network's name.
    pub(super) fn named(name: &str, error: NetworkError) -> NetworkError {
        match error {
            NetworkError::Layer { layer, problem } => NetworkError::Layer {
                layer: format!("{name}.{layer}"),
                problem,
            },
            other => other,
        }
    }
}
