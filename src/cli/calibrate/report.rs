//! What is said of a camera.

use std::fmt::{self, Write};

use glam::{DAffine3, DQuat, EulerRot};
use serde::{Serialize, Serializer};

use super::angles::Match;
use crate::calibration::Registration;
use crate::live::ros;

/// From fewer poses of the robot, what a pose's joints have in common is not told from where the camera is.
const ENOUGH_POSES: usize = 5;
/// Where frames and joint angles belong together, residuals are half of what the networks are taken to err, and nine in ten
/// joints agree.
const MOST_SCALE: f64 = 1.0;
const LEAST_SHARE: f64 = 0.7;

/// A camera's pose in the robot's base frame, and how sure it is.
#[derive(Serialize)]
pub struct Report {
    pub schema: u32,
    pub camera: String,
    pub frame_id: String,
    pub child_frame_id: String,
    pub translation_m: [f64; 3],
    pub rotation_xyzw: [f64; 4],
    pub translation_sigma_m: f64,
    pub rotation_sigma_deg: f64,
    /// x, y, z and rotations about them, metres and radians: `geometry_msgs/PoseWithCovariance`.
    pub covariance: [[f64; 6]; 6],
    /// 4 x 4, row by row: what recordings call so.
    pub camera_from_base: [f64; 16],
    pub matched_by: Match,
    pub frames: usize,
    pub frames_used: usize,
    pub frames_not_found: usize,
    pub frames_unmatched: usize,
    pub frames_moving: usize,
    pub poses: usize,
    pub inlier_share: f64,
    /// How many times larger residuals are than the networks' errors are taken to be.
    pub residual_scale: f64,
    pub doubts: Vec<Doubt>,
    pub residuals: Vec<Residual>,
}

/// Why a pose may not be what its deviation says.
#[derive(Debug, Clone, PartialEq)]
pub enum Doubt {
    /// Too few poses of the robot.
    Poses,
    /// Residuals are so many times larger than the networks' errors.
    Scale(f64),
    /// Only so many of the joints agree.
    Share(f64),
    /// A link has another length in the lines than in the URDF.
    Link {
        from: String,
        to: String,
        found_m: f64,
        known_m: f64,
    },
}

impl Doubt {
    /// What is to be doubted about a camera that was found by so many poses of the robot.
    pub fn of(found: &Registration, poses: usize) -> Vec<Self> {
        let share = found.inlier_share();
        let doubts = [
            (poses < ENOUGH_POSES, Self::Poses),
            (found.scale > MOST_SCALE, Self::Scale(found.scale)),
            (share < LEAST_SHARE, Self::Share(share)),
        ];
        let doubts = doubts.into_iter().filter(|(applies, _)| *applies);
        doubts.map(|(_, doubt)| doubt).collect()
    }
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let theirs = "do the joint angles and the URDF belong to these frames?";
        match self {
            Self::Poses => write!(
                f,
                "fewer than {ENOUGH_POSES} poses: joints of a pose agree with each other however far they are off \
                 together, and the deviations know nothing of that"
            ),
            Self::Scale(scale) => write!(
                f,
                "what is left of the joints is {scale:.1} times what the networks err: {theirs}"
            ),
            Self::Share(share) => write!(f, "{:.0} % of the joints agree: {theirs}", 100.0 * share),
            Self::Link {
                from,
                to,
                found_m,
                known_m,
            } => write!(
                f,
                "from {from} to {to} it is {found_m:.2} m in these lines, {known_m:.2} m in the URDF: is it that of this arm?"
            ),
        }
    }
}

impl Serialize for Doubt {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// What is left of a joint.
#[derive(Serialize)]
pub struct Residual {
    pub name: String,
    pub joints: usize,
    pub inliers: usize,
    /// Root mean square over the inliers, metres.
    pub rms_m: Option<f64>,
    /// The part of it along the camera's ray, metres.
    pub rms_along_m: Option<f64>,
}

/// From a covariance of rotation and shift to one of shift and rotation.
pub fn ros_order(covariance: [[f64; 6]; 6]) -> [[f64; 6]; 6] {
    std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i + 3) % 6][(j + 3) % 6]))
}

/// Row by row.
pub fn rows(map: DAffine3) -> [f64; 16] {
    glam::DMat4::from(map).transpose().to_cols_array()
}

/// The rotation of a registration, w positive.
pub fn quaternion(registration: &Registration) -> [f64; 4] {
    let turn = DQuat::from_mat3(&registration.transform.matrix3);
    let turn = if turn.w < 0.0 { -turn } else { turn };
    turn.to_array()
}

impl Report {
    fn arguments(&self) -> String {
        let [x, y, z] = self.translation_m;
        let [qx, qy, qz, qw] = self.rotation_xyzw;
        format!(
            "--x {x:.6} --y {y:.6} --z {z:.6} --qx {qx:.8} --qy {qy:.8} --qz {qz:.8} --qw {qw:.8} \
             --frame-id {} --child-frame-id {}",
            self.frame_id, self.child_frame_id
        )
    }

    fn sure(&self) -> String {
        format!(
            "+- {:.0} mm, +- {:.2} degrees (one standard deviation)",
            1e3 * self.translation_sigma_m,
            self.rotation_sigma_deg
        )
    }

    /// For people.
    pub fn text(&self) -> String {
        let [x, y, z] = self.translation_m;
        let [qx, qy, qz, qw] = self.rotation_xyzw;
        let turn = DQuat::from_array(self.rotation_xyzw);
        let (yaw, pitch, roll) = turn.to_euler(EulerRot::ZYX);
        let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
        let mut text = format!(
            "{}: its optical frame in {}, {}\n",
            self.camera,
            self.frame_id,
            self.sure()
        );
        let _ = writeln!(text, "  translation  {x:9.4} {y:9.4} {z:9.4} m");
        let _ = writeln!(
            text,
            "  rotation     {qx:9.5} {qy:9.5} {qz:9.5} {qw:9.5} (x y z w)"
        );
        let _ = writeln!(
            text,
            "               {roll:9.2} {pitch:9.2} {yaw:9.2} degrees (roll pitch yaw)"
        );
        let _ = writeln!(
            text,
            "  from {} of {} frames in {} poses of the robot, matched by {}; {} without the robot, {} without \
             joint angles, {} of a moving robot; {:.1} % of the joints agree",
            self.frames_used,
            self.frames,
            self.poses,
            self.matched_by.name(),
            self.frames_not_found,
            self.frames_unmatched,
            self.frames_moving,
            100.0 * self.inlier_share
        );
        let _ = writeln!(
            text,
            "  {:14} {:>7} {:>6} {:>9} {:>10}",
            "joint", "inliers", "of", "rms", "along ray"
        );
        for residual in &self.residuals {
            let mm =
                |value: Option<f64>| value.map_or("-".into(), |m| format!("{:.0} mm", 1e3 * m));
            let _ = writeln!(
                text,
                "  {:14} {:>7} {:>6} {:>9} {:>10}",
                residual.name,
                residual.inliers,
                residual.joints,
                mm(residual.rms_m),
                mm(residual.rms_along_m)
            );
        }
        let _ = write!(
            text,
            "  ros2 run tf2_ros static_transform_publisher {}",
            self.arguments()
        );
        text
    }
}

/// `tf2_msgs/TFMessage` in YAML, as `ros2 topic echo /tf_static` prints it and `ros2 topic pub` takes it.
pub fn yaml(reports: &[Report]) -> String {
    let mut text = String::from("transforms:\n");
    for report in reports {
        let [x, y, z] = report.translation_m;
        let [qx, qy, qz, qw] = report.rotation_xyzw;
        let _ = write!(
            text,
            "# {}: {}\n- header:\n    frame_id: {}\n  child_frame_id: {}\n  transform:\n    \
             translation: {{x: {x:.6}, y: {y:.6}, z: {z:.6}}}\n    \
             rotation: {{x: {qx:.8}, y: {qy:.8}, z: {qz:.8}, w: {qw:.8}}}\n",
            report.camera,
            report.sure(),
            quoted(&report.frame_id),
            quoted(&report.child_frame_id),
        );
    }
    text
}

/// A ROS 2 launch file in YAML: a publisher a camera.
pub fn launch(reports: &[Report]) -> String {
    let mut text = String::from("launch:\n");
    for report in reports {
        let _ = write!(
            text,
            "# {}: {}\n- node:\n    pkg: tf2_ros\n    exec: static_transform_publisher\n    name: {}\n    args: {}\n",
            report.camera,
            report.sure(),
            quoted(&format!("{}_static_transform", ros::name(&report.camera))),
            quoted(&report.arguments()),
        );
    }
    text
}

/// A YAML string: JSON's are.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}
