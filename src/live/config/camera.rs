use std::path::PathBuf;

use serde::Deserialize;
use toml::Spanned;

use super::{ConfigError, Document, FindModel, KnownModel};
use crate::camera::{Camera, Orientation};
use crate::live::warning::{Observer, Pose};
use crate::live::{Calibration, Input, Location};

/// A camera, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraConfig {
    /// Its name, which no other has.
    pub name: String,
    /// Where its frames come from.
    pub location: Location,
    /// Its robot's model.
    pub robot: KnownModel,
    /// What its images were taken with.
    pub calibration: Calibration,
    /// What makes its images upright.
    pub orientation: Orientation,
    /// Frames a second: the pace of folders and recordings, what webcams are asked for.
    pub fps: Option<f64>,
    /// Whether it begins again at its end.
    pub repeat: bool,
    /// Where it is in the common frame, where that is known.
    pub world_from_camera: Option<Pose>,
    /// The place of the rig that it belongs to, of several the first.
    pub rig: Option<usize>,
}

impl CameraConfig {
    /// Of a camera that nothing is known of but its source.
    pub fn new(name: String, location: Location, robot: KnownModel) -> Self {
        Self {
            name,
            location,
            robot,
            calibration: Calibration::Assumed,
            orientation: Orientation::NoTransforms,
            fps: None,
            repeat: false,
            world_from_camera: None,
            rig: None,
        }
    }

    /// The camera, as warnings see it.
    pub fn observer(&self) -> Observer {
        Observer {
            name: self.name.clone(),
            world_from_camera: self.world_from_camera,
            uncertainty_m: self.robot.uncertainty_m,
        }
    }

    /// The camera, to be watched.
    pub fn input(&self) -> Input {
        Input {
            source: self.location.source(self.fps, self.repeat),
            calibration: self.calibration,
            orientation: self.orientation,
            robot: self.robot.place,
            rig: self.rig,
        }
    }
}

/// A `[[camera]]` as it is written.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CameraTable {
    name: Spanned<String>,
    source: Spanned<SourceName>,
    robot: Option<Spanned<String>>,
    weights: Option<Spanned<PathBuf>>,
    camera_info: Option<Spanned<PathBuf>>,
    /// Degrees.
    hfov: Option<Spanned<f64>>,
    #[serde(default)]
    orientation: OrientationName,
    fps: Option<Spanned<f64>>,
    repeat: Option<Spanned<bool>>,
    world_from_camera: Option<Pose>,
}

/// A webcam's number, or anything else.
#[derive(Debug, Deserialize)]
#[serde(
    untagged,
    expecting = "expected a webcam's number, a path or a stream's address"
)]
enum SourceName {
    Number(u32),
    Text(String),
}

/// What makes a camera's images upright: turned clockwise, or mirrored.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
enum OrientationName {
    #[default]
    Upright,
    #[serde(rename = "rotate_90")]
    Rotate90,
    #[serde(rename = "rotate_180")]
    Rotate180,
    #[serde(rename = "rotate_270")]
    Rotate270,
    FlipHorizontal,
    FlipVertical,
}

impl CameraTable {
    /// Checks everything, beside the cameras `before`.
    pub fn check(
        self,
        document: &Document<'_>,
        before: &[CameraConfig],
        find_model: &mut FindModel<'_>,
    ) -> Result<CameraConfig, ConfigError> {
        let fault = |key: &str, span, message: String| {
            Err(document.fault(&format!("camera.{key}"), &Spanned::new(span, ()), message))
        };
        let name = self.name.get_ref();
        if name.trim().is_empty() {
            return fault(
                "name",
                self.name.span(),
                "expected a name, found none".into(),
            );
        }
        if before.iter().any(|other| other.name == *name) {
            let message = format!("expected a name of its own, found `{name}` again");
            return fault("name", self.name.span(), message);
        }
        let location = match self.source.get_ref() {
            SourceName::Number(number) => Location::new(&number.to_string(), document.folder()),
            SourceName::Text(text) => Location::new(text, document.folder()),
        };
        let location = match location {
            Ok(location) => location,
            Err(message) => return fault("source", self.source.span(), message),
        };
        let weights = self.weights.as_ref().map(|w| document.path(w.get_ref()));
        let robot = self.robot.as_ref().map(|robot| robot.get_ref().as_str());
        let robot = match find_model(robot, weights.as_deref()) {
            Ok(robot) => robot,
            Err(message) => {
                let (key, span) = match (&self.weights, &self.robot) {
                    (Some(weights), _) => ("weights", weights.span()),
                    (None, Some(robot)) => ("robot", robot.span()),
                    (None, None) => ("robot", self.name.span()),
                };
                return fault(key, span, message);
            }
        };
        let calibration = self.calibration(document, &location)?;
        if let Some(fps) = &self.fps
            && !(0.001..=1000.0).contains(fps.get_ref())
        {
            let message = format!(
                "expected 0.001 to 1000 frames a second, found {}",
                fps.get_ref()
            );
            return fault("fps", fps.span(), message);
        }
        if let Some(fps) = &self.fps
            && !location.is_paced()
            && !matches!(location, Location::Device(_))
        {
            let message = "expected none: videos and streams have a pace of their own".into();
            return fault("fps", fps.span(), message);
        }
        let repeat = self.repeat.as_ref().is_some_and(|repeat| *repeat.get_ref());
        if let Some(span) = self.repeat.as_ref().filter(|_| repeat && !location.ends()) {
            let message = "expected none: this source has no end".into();
            return fault("repeat", span.span(), message);
        }
        Ok(CameraConfig {
            name: self.name.into_inner(),
            location,
            robot,
            calibration,
            orientation: self.orientation.into(),
            fps: self.fps.map(Spanned::into_inner),
            repeat,
            world_from_camera: self.world_from_camera,
            rig: None,
        })
    }

    fn calibration(
        &self,
        document: &Document<'_>,
        location: &Location,
    ) -> Result<Calibration, ConfigError> {
        let keys = [
            self.camera_info.as_ref().map(|v| ("camera_info", v.span())),
            self.hfov.as_ref().map(|v| ("hfov", v.span())),
        ];
        let mut given = keys.into_iter().flatten();
        let (first, second) = (given.next(), given.next());
        let is_recording = matches!(location, Location::Recording(_));
        if let Some((key, span)) = second.or(first.filter(|_| is_recording)) {
            let message = if is_recording {
                "expected none: a recording has its own"
            } else {
                "expected camera_info or hfov, found both"
            };
            let key = format!("camera.{key}");
            return Err(document.fault(&key, &Spanned::new(span, ()), message));
        }
        if let Some(info) = &self.camera_info {
            let camera = Camera::load(document.path(info.get_ref()))
                .map_err(|error| document.fault("camera.camera_info", info, error.to_string()))?;
            return Ok(Calibration::CameraInfo(camera));
        }
        let Some(hfov) = &self.hfov else {
            return Ok(Calibration::Assumed);
        };
        let degrees = *hfov.get_ref();
        if !(degrees > 0.0 && degrees < 180.0) {
            let message = format!("expected degrees between 0 and 180, found {degrees}");
            return Err(document.fault("camera.hfov", hfov, message));
        }
        Ok(Calibration::Hfov(degrees.to_radians()))
    }
}

impl From<OrientationName> for Orientation {
    fn from(name: OrientationName) -> Self {
        match name {
            OrientationName::Upright => Self::NoTransforms,
            OrientationName::Rotate90 => Self::Rotate90,
            OrientationName::Rotate180 => Self::Rotate180,
            OrientationName::Rotate270 => Self::Rotate270,
            OrientationName::FlipHorizontal => Self::FlipHorizontal,
            OrientationName::FlipVertical => Self::FlipVertical,
        }
    }
}
