use std::path::Path;

use serde::Deserialize;

use super::{Camera, CameraError, Distortion, Intrinsics};

/// What ROS's calibrator writes (`camera_matrix`, ...), and what `ros2 topic echo` (`k`, ...) and
/// `rostopic echo` (`K`, ...) print of a `sensor_msgs/CameraInfo`. Other keys mean nothing here.
#[derive(Deserialize)]
struct CameraInfo {
    #[serde(alias = "width")]
    image_width: u32,
    #[serde(alias = "height")]
    image_height: u32,
    #[serde(alias = "k", alias = "K")]
    camera_matrix: Numbers,
    #[serde(default)]
    distortion_model: String,
    #[serde(default, alias = "d", alias = "D")]
    distortion_coefficients: Numbers,
}

#[derive(Deserialize)]
#[serde(
    untagged,
    expecting = "expected a list of numbers, or a matrix of rows, cols and data"
)]
enum Numbers {
    List(Vec<f64>),
    Matrix { data: Vec<f64> },
}

impl Default for Numbers {
    fn default() -> Self {
        Self::List(Vec::new())
    }
}

impl Numbers {
    fn data(&self) -> &[f64] {
        match self {
            Self::List(data) | Self::Matrix { data } => data,
        }
    }
}

impl Camera {
    /// Reads a ROS `camera_info` file; see [`Camera::from_camera_info`].
    ///
    /// # Errors
    /// As [`Camera::from_camera_info`], and what keeps the file from being read; both name the file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, CameraError> {
        let file = path.as_ref();
        let text = std::fs::read_to_string(file).map_err(|cause| CameraError::Read {
            file: file.into(),
            cause,
        })?;
        Self::from_camera_info(&text).map_err(|cause| CameraError::File {
            file: file.into(),
            cause: Box::new(cause),
        })
    }

    /// Reads a ROS `camera_info` in YAML: a file of ROS's calibrator, or a `sensor_msgs/CameraInfo`
    /// as `ros2 topic echo` prints it. It describes the camera's raw image; its rectification and
    /// projection matrices (`R`, `P`) are not used.
    ///
    /// # Errors
    /// Text that is no such YAML, an unknown distortion model, a wrong number of values, and what
    /// [`Camera::check`] refuses.
    pub fn from_camera_info(yaml: &str) -> Result<Self, CameraError> {
        // `topic echo` ends each message with a document separator; the first message is as good as
        // the next.
        let options = serde_saphyr::options! { with_snippet: false };
        let messages: Vec<CameraInfo> = serde_saphyr::from_multiple_with_options(yaml, options)
            .map_err(|e| CameraError::Format(e.to_string()))?;
        let info = messages
            .first()
            .ok_or_else(|| CameraError::Format("no document".into()))?;
        let camera = Self {
            width: info.image_width,
            height: info.image_height,
            intrinsics: intrinsics(info.camera_matrix.data())?,
            distortion: distortion(&info.distortion_model, info.distortion_coefficients.data())?,
        };
        camera.check()?;
        Ok(camera)
    }
}

fn intrinsics(k: &[f64]) -> Result<Intrinsics, CameraError> {
    if k.len() == 9 && k.iter().all(|&v| v == 0.0) {
        return Err(CameraError::Uncalibrated);
    }
    match *k {
        [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0] => Ok(Intrinsics { fx, fy, cx, cy }),
        _ => Err(CameraError::Value {
            field: "camera_matrix (K)",
            expected: "[fx, 0, cx, 0, fy, cy, 0, 0, 1]",
            found: format!("{k:?}"),
        }),
    }
}

fn distortion(model: &str, coefficients: &[f64]) -> Result<Distortion, CameraError> {
    // A fisheye lens without coefficients is still no pinhole.
    if matches!(model, "" | "none" | "plumb_bob" | "rational_polynomial")
        && coefficients.iter().all(|&v| v == 0.0)
    {
        return Ok(Distortion::None);
    }
    let count = |expected| CameraError::Value {
        field: "distortion_coefficients (D)",
        expected,
        found: format!("{coefficients:?}"),
    };
    match model {
        "plumb_bob" => match *coefficients {
            [k1, k2, p1, p2] => Ok(rational([k1, k2, 0.0, 0.0, 0.0, 0.0], [p1, p2])),
            [k1, k2, p1, p2, k3] => Ok(rational([k1, k2, k3, 0.0, 0.0, 0.0], [p1, p2])),
            _ => Err(count("k1, k2, p1, p2 and k3 of plumb_bob")),
        },
        "rational_polynomial" => match *coefficients {
            // Beyond the eighth are thin prism and tilted sensor, which the model does not have.
            [k1, k2, p1, p2, k3, k4, k5, k6, ref rest @ ..] if rest.iter().all(|&v| v == 0.0) => {
                Ok(rational([k1, k2, k3, k4, k5, k6], [p1, p2]))
            }
            _ => Err(count(
                "k1, k2, p1, p2, k3, k4, k5 and k6 of rational_polynomial",
            )),
        },
        "equidistant" | "fisheye" => match *coefficients {
            [k1, k2, k3, k4] => Ok(Distortion::Equidistant {
                k: [k1, k2, k3, k4],
            }),
            _ => Err(count("k1, k2, k3 and k4 of equidistant")),
        },
        other => Err(CameraError::Value {
            field: "distortion_model",
            expected: "plumb_bob, rational_polynomial or equidistant",
            found: format!("`{other}`"),
        }),
    }
}

fn rational(k: [f64; 6], p: [f64; 2]) -> Distortion {
    Distortion::Rational { k, p }
}
