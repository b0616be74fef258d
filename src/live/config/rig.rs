use serde::Deserialize;
use toml::Spanned;

use super::{CameraConfig, ConfigError, Document};
use crate::calibration::RigOptions;

/// Cameras that see the same robot, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct RigConfig {
    /// Its name, which no other has.
    pub name: String,
    /// The places of its cameras in the configuration; all is in the first one's frame.
    pub cameras: Vec<usize>,
    /// How the cameras are put together.
    pub options: RigOptions,
    /// The time constant, and so the lag, that joints are smoothed with, in seconds.
    pub smoothing_s: Option<f64>,
}

/// A `[[rig]]` as it is written.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RigTable {
    name: Spanned<String>,
    cameras: Spanned<Vec<Spanned<String>>>,
    memory_s: Option<Spanned<f64>>,
    simultaneous_s: Option<Spanned<f64>>,
    smoothing_s: Option<Spanned<f64>>,
}

impl RigTable {
    /// Checks everything, beside the rigs `before`.
    pub fn check(
        self,
        document: &Document<'_>,
        before: &[RigConfig],
        cameras: &[CameraConfig],
    ) -> Result<RigConfig, ConfigError> {
        let name = self.name.get_ref();
        if name.trim().is_empty() || before.iter().any(|other| other.name == *name) {
            let message = format!("expected a name of its own, found `{name}`");
            return Err(document.fault("rig.name", &self.name, message));
        }
        let mut places: Vec<usize> = Vec::new();
        for name in self.cameras.get_ref() {
            let wrong = |message: String| Err(document.fault("rig.cameras", name, message));
            let found = name.get_ref();
            let Some(place) = cameras.iter().position(|camera| camera.name == *found) else {
                return wrong(format!(
                    "expected the name of a [[camera]], found `{found}`"
                ));
            };
            if places.contains(&place) {
                return wrong(format!("expected each camera once, found `{found}` again"));
            }
            let robot = |place: usize| cameras.get(place).map(|camera| camera.robot.place);
            if places
                .first()
                .is_some_and(|&first| robot(first) != robot(place))
            {
                return wrong(format!(
                    "expected cameras of one robot, found `{found}` of another"
                ));
            }
            places.push(place);
        }
        if places.len() < 2 {
            let message = format!("expected two cameras or more, found {}", places.len());
            return Err(document.fault("rig.cameras", &self.cameras, message));
        }
        let seconds = |key: &str, value: &Option<Spanned<f64>>| match value {
            Some(value) if !(*value.get_ref() > 0.0 && *value.get_ref() <= 3600.0) => {
                let message = format!("expected 0 to 3600 seconds, found {}", value.get_ref());
                Err(document.fault(key, value, message))
            }
            value => Ok(value.as_ref().map(|value| *value.get_ref())),
        };
        let default = RigOptions::default();
        let options = RigOptions {
            memory_s: seconds("rig.memory_s", &self.memory_s)?.unwrap_or(default.memory_s),
            simultaneous_s: seconds("rig.simultaneous_s", &self.simultaneous_s)?
                .unwrap_or(default.simultaneous_s),
        };
        Ok(RigConfig {
            smoothing_s: seconds("rig.smoothing_s", &self.smoothing_s)?,
            name: self.name.into_inner(),
            cameras: places,
            options,
        })
    }
}
