//! The ROS 2 messages that are written: a field for each of the interface's, in its order.

use std::time::{SystemTime, UNIX_EPOCH};

use byteorder::LittleEndian;
use serde::{Serialize, Serializer};

use crate::camera::{Camera, Distortion, Intrinsics};

/// A message as ROS 2 sends it: little-endian CDR, behind the header that says so.
pub fn cdr(message: &impl Serialize) -> Result<Vec<u8>, cdr_encoding::Error> {
    let mut bytes = vec![0, 1, 0, 0];
    cdr_encoding::to_writer::<_, LittleEndian, _>(&mut bytes, message)?;
    Ok(bytes)
}

/// Nanoseconds since 1970; 0 before that.
pub fn nanoseconds(at: SystemTime) -> u64 {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

#[derive(Serialize, Clone, Copy, Default)]
pub struct Time {
    sec: i32,
    nanosec: u32,
}

impl From<SystemTime> for Time {
    fn from(at: SystemTime) -> Self {
        let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
        Self {
            sec: i32::try_from(since.as_secs()).unwrap_or(i32::MAX),
            nanosec: since.subsec_nanos(),
        }
    }
}

#[derive(Serialize, Clone, Copy, Default)]
pub struct Header<'a> {
    pub stamp: Time,
    pub frame_id: &'a str,
}

#[derive(Serialize, Default)]
pub struct CompressedImage<'a> {
    pub header: Header<'a>,
    pub format: &'a str,
    #[serde(serialize_with = "bytes")]
    pub data: &'a [u8],
}

/// A sequence of octets: as serde sees a slice, it would be written one by one.
fn bytes<S: Serializer>(data: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(data)
}

#[derive(Serialize)]
pub struct CameraInfo<'a> {
    header: Header<'a>,
    height: u32,
    width: u32,
    distortion_model: &'a str,
    d: Vec<f64>,
    k: [f64; 9],
    r: [f64; 9],
    p: [f64; 12],
    binning_x: u32,
    binning_y: u32,
    roi: RegionOfInterest,
}

#[derive(Serialize, Default)]
struct RegionOfInterest {
    x_offset: u32,
    y_offset: u32,
    height: u32,
    width: u32,
    do_rectify: bool,
}

impl<'a> CameraInfo<'a> {
    /// A camera whose images are raw; rectified, they would keep its intrinsics.
    pub fn new(header: Header<'a>, camera: &Camera) -> Self {
        let (distortion_model, d) = match camera.distortion {
            Distortion::None => ("plumb_bob", vec![0.0; 5]),
            Distortion::Rational { k, p } => {
                let [k1, k2, k3, rest @ ..] = k;
                let [p1, p2] = p;
                let mut d = vec![k1, k2, p1, p2, k3];
                if rest == [0.0; 3] {
                    ("plumb_bob", d)
                } else {
                    d.extend(rest);
                    ("rational_polynomial", d)
                }
            }
            Distortion::Equidistant { k } => ("equidistant", k.to_vec()),
        };
        let Intrinsics { fx, fy, cx, cy } = camera.intrinsics;
        Self {
            header,
            height: camera.height,
            width: camera.width,
            distortion_model,
            d,
            k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            binning_x: 0,
            binning_y: 0,
            roi: RegionOfInterest::default(),
        }
    }
}

/// A point or a vector, in metres.
#[derive(Serialize, Clone, Copy, Default)]
pub struct Xyz {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

impl From<[f64; 3]> for Xyz {
    fn from([x, y, z]: [f64; 3]) -> Self {
        Self { x, y, z }
    }
}

#[derive(Serialize, Clone, Copy)]
pub struct Quaternion {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub w: f64,
}

impl Default for Quaternion {
    /// No rotation.
    fn default() -> Self {
        let (x, y, z, w) = (0.0, 0.0, 0.0, 1.0);
        Self { x, y, z, w }
    }
}

#[derive(Serialize, Clone, Copy, Default)]
pub struct Pose {
    pub position: Xyz,
    pub orientation: Quaternion,
}

#[derive(Serialize)]
pub struct PoseArray<'a> {
    pub header: Header<'a>,
    pub poses: Vec<Pose>,
}

#[derive(Serialize)]
pub struct TfMessage<'a> {
    pub transforms: Vec<TransformStamped<'a>>,
}

#[derive(Serialize)]
pub struct TransformStamped<'a> {
    pub header: Header<'a>,
    pub child_frame_id: &'a str,
    pub transform: Transform,
}

#[derive(Serialize)]
pub struct Transform {
    pub translation: Xyz,
    pub rotation: Quaternion,
}

#[derive(Serialize)]
pub struct MarkerArray<'a> {
    pub markers: Vec<Marker<'a>>,
}

#[derive(Serialize, Default)]
pub struct Marker<'a> {
    pub header: Header<'a>,
    pub ns: &'a str,
    pub id: i32,
    pub kind: i32,
    pub action: i32,
    pub pose: Pose,
    pub scale: Xyz,
    pub color: Colour,
    /// Zero: until it is replaced or deleted.
    pub lifetime: Time,
    pub frame_locked: bool,
    pub points: Vec<Xyz>,
    pub colors: Vec<Colour>,
    pub texture_resource: &'a str,
    pub texture: CompressedImage<'a>,
    /// None: they are for textures.
    pub uv_coordinates: &'a [()],
    pub text: &'a str,
    pub mesh_resource: &'a str,
    pub mesh_file: MeshFile<'a>,
    pub mesh_use_embedded_materials: bool,
}

impl Marker<'_> {
    pub const LINE_STRIP: i32 = 4;
    pub const SPHERE_LIST: i32 = 7;
    pub const TEXT_VIEW_FACING: i32 = 9;
    /// The action that adds or replaces.
    pub const ADD: i32 = 0;
    /// The action that removes all markers of the topic.
    pub const DELETE_ALL: i32 = 3;
}

#[derive(Serialize, Clone, Copy, Default)]
pub struct Colour {
    pub r: f32,
    pub g: f32,
    pub b: f32,
    pub a: f32,
}

impl From<[u8; 3]> for Colour {
    fn from(rgb: [u8; 3]) -> Self {
        let [r, g, b] = rgb.map(|v| f32::from(v) / 255.0);
        Self { r, g, b, a: 1.0 }
    }
}

#[derive(Serialize, Default)]
pub struct MeshFile<'a> {
    filename: &'a str,
    #[serde(serialize_with = "bytes")]
    data: &'a [u8],
}

#[derive(Serialize)]
pub struct DiagnosticArray<'a> {
    pub header: Header<'a>,
    pub status: Vec<DiagnosticStatus>,
}

#[derive(Serialize)]
pub struct DiagnosticStatus {
    pub level: Level,
    pub name: String,
    pub message: String,
    pub hardware_id: String,
    pub values: Vec<KeyValue>,
}

/// What is in a `DiagnosticStatus`'s `level`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    Ok = 0,
    Warn = 1,
    Error = 2,
    Stale = 3,
}

impl Serialize for Level {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_u8(*self as u8)
    }
}

#[derive(Serialize)]
pub struct KeyValue {
    pub key: &'static str,
    pub value: String,
}
