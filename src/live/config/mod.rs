//! `cameras.toml`: which cameras there are, and what is to be done with them.

mod camera;
mod error;
mod rig;

use std::path::Path;

use serde::Deserialize;
use toml::Spanned;

pub use camera::CameraConfig;
pub use error::ConfigError;
pub(in crate::live) use error::Document;
pub use rig::RigConfig;

use super::warning;
use camera::CameraTable;
use rig::RigTable;

/// A configuration file, checked whole.
#[derive(Debug, Clone)]
pub struct Config {
    /// The cameras, in the file's order.
    pub cameras: Vec<CameraConfig>,
    /// Which of them see the same robot.
    pub rigs: Vec<RigConfig>,
    /// When the robot is too close, and what is done then.
    pub warnings: warning::Config,
}

/// The file as it is written. Other parts' tables stand beside the cameras, each a type of its module that knows how
/// to check itself ([`Document`] says where something is wrong).
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default, rename = "camera")]
    cameras: Vec<Spanned<CameraTable>>,
    #[serde(default, rename = "rig")]
    rigs: Vec<RigTable>,
    #[serde(default, rename = "warning")]
    rules: Vec<warning::Rule>,
    #[serde(default, rename = "action")]
    actions: Vec<warning::Action>,
}

/// Finds a model, and loads it if it is new: of a robot's name or a model file or both; what is wrong with them otherwise.
pub type FindModel<'a> = dyn FnMut(Option<&str>, Option<&Path>) -> Result<KnownModel, String> + 'a;

/// A model that is loaded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownModel {
    /// Its place among all models.
    pub place: usize,
    /// How far off its joints are, in metres ([`warning::uncertainty_m`]).
    pub uncertainty_m: Option<f64>,
}

impl Config {
    /// Reads `file`. Paths in it start at its own folder.
    ///
    /// # Errors
    /// A file that cannot be read; unknown keys, wrong values, names that are not unique, files that are not there or
    /// hold something else: with file, line and key.
    pub fn load(file: &Path, find_model: &mut FindModel<'_>) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(file).map_err(|cause| ConfigError::Read {
            file: file.to_owned(),
            cause,
        })?;
        Self::parse(&text, file, find_model)
    }

    /// Of `text`, which stands in `file`.
    ///
    /// # Errors
    /// As [`Config::load`].
    pub fn parse(
        text: &str,
        file: &Path,
        find_model: &mut FindModel<'_>,
    ) -> Result<Self, ConfigError> {
        let document = Document { file, text };
        let file: File = toml::from_str(text).map_err(|error| document.refused(&error))?;
        let File {
            cameras,
            rigs,
            rules,
            actions,
        } = file;
        if cameras.is_empty() {
            let expected = "expected at least one [[camera]], found none";
            return Err(document.fault("camera", &Spanned::new(0..0, ()), expected));
        }
        let mut checked: Vec<CameraConfig> = Vec::with_capacity(cameras.len());
        for table in cameras {
            let camera = table.into_inner().check(&document, &checked, find_model)?;
            checked.push(camera);
        }
        let mut checked_rigs = Vec::with_capacity(rigs.len());
        for table in rigs {
            let rig = table.check(&document, &checked_rigs, &checked)?;
            for &camera in &rig.cameras {
                if let Some(camera) = checked.get_mut(camera) {
                    camera.rig.get_or_insert(checked_rigs.len());
                }
            }
            checked_rigs.push(rig);
        }
        let warnings = warning::Config { rules, actions };
        let observers: Vec<_> = checked.iter().map(CameraConfig::observer).collect();
        warnings.check(&observers).map_err(|error| {
            let message = format!("expected {}, found {}", error.expected, error.found);
            document.fault(error.key, &Spanned::new(error.span, ()), message)
        })?;
        Ok(Self {
            cameras: checked,
            rigs: checked_rigs,
            warnings,
        })
    }
}
