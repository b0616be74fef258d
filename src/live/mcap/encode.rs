use std::collections::BTreeMap;
use std::io::{Cursor, Seek, Write};
use std::time::{Duration, SystemTime};

use image::codecs::jpeg::JpegEncoder;
use image::{DynamicImage, ImageFormat, RgbImage, RgbaImage};
use serde::Serialize;

use super::McapError;
use super::definitions::{
    CAMERA_INFO, COMPRESSED_IMAGE, DIAGNOSTIC_ARRAY, Definition, MARKER_ARRAY, POSE_ARRAY,
    TF_MESSAGE,
};
use super::messages::{
    CameraInfo, Colour, CompressedImage, DiagnosticArray, DiagnosticStatus, Header, KeyValue,
    Level, Marker, MarkerArray, Pose, PoseArray, Quaternion, TfMessage, Transform,
    TransformStamped, Xyz, cdr, nanoseconds,
};
use crate::camera::Intrinsics;
use crate::cascade::{Joint, Status};
use crate::draw::{JOINT_COLOURS, mask_image};
use crate::live::warning::{ActionReport, State, Warning};
use crate::live::{Event, EventKind, Observation, Rates, Statistics, ros};

/// A camera that is recorded.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedCamera {
    /// Its name.
    pub name: String,
    /// The robot it looks for, such as `ur5`.
    pub robot: String,
    /// The model's joints, in its order.
    pub joints: Vec<String>,
    /// The canonical camera of the model, which masks are in.
    pub canonical: Intrinsics,
}

/// A message for a channel.
pub struct Encoded {
    channel: u16,
    sequence: u32,
    at: u64,
    data: Vec<u8>,
}

impl Encoded {
    /// Says how many bytes it has.
    pub fn write<W: Write + Seek>(&self, file: &mut mcap::Writer<W>) -> mcap::McapResult<usize> {
        let header = mcap::records::MessageHeader {
            channel_id: self.channel,
            sequence: self.sequence,
            log_time: self.at,
            publish_time: self.at,
        };
        file.write_to_known_channel(&header, &self.data)?;
        Ok(self.data.len())
    }
}

/// Makes messages of what is recorded.
pub struct Encoder {
    cameras: Vec<Channels>,
    transforms: u16,
    status: u16,
    statistics: u16,
}

/// A camera's channels and frames.
struct Channels {
    camera: RecordedCamera,
    /// The frame of the camera's body: x forward, y left, z up.
    link: String,
    /// Its optical frame: x right, y down, z forward.
    optical: String,
    image: u16,
    mask: u16,
    camera_info: u16,
    joints: u16,
    poses: u16,
    status: u16,
}

/// What JPEG calls quality; at 90 an edge is hardly blurred.
const JPEG_QUALITY: u8 = 90;
/// Of the arm's line, in metres.
const LINE: f64 = 0.02;
/// Of the joints' spheres, in metres.
const SPHERE: f64 = 0.05;
/// Of the joints' names, in metres.
const TEXT: f64 = 0.05;
const ARM: [u8; 3] = [245, 245, 245];
/// From the optical frame to the body's: a third of a turn that takes z to x, x to -y and y to -z.
const OPTICAL: Quaternion = Quaternion {
    x: -0.5,
    y: 0.5,
    z: -0.5,
    w: 0.5,
};

impl Encoder {
    /// Adds the channels of `cameras` to a file.
    pub fn new<W: Write + Seek>(
        file: &mut mcap::Writer<W>,
        cameras: &[RecordedCamera],
    ) -> mcap::McapResult<Self> {
        let mut add = |topic: &str, definition: &Definition, about: &[(&str, &str)]| {
            let schema =
                file.add_schema(definition.name, "ros2msg", definition.schema().as_bytes())?;
            // `ros2 bag` wants the key; with nothing in it, it plays with its own profile.
            let about: BTreeMap<_, _> = std::iter::once(("offered_qos_profiles", ""))
                .chain(about.iter().copied())
                .map(|(key, value)| (key.to_owned(), value.to_owned()))
                .collect();
            file.add_channel(schema, topic, "cdr", &about)
        };
        let cameras = cameras
            .iter()
            .map(|camera| {
                let name = ros::name(&camera.name);
                let joints = camera.joints.join(" ");
                let about = [
                    ("camera", camera.name.as_str()),
                    ("robot", &camera.robot),
                    ("joints", &joints),
                ];
                let mut add = |topic: &str, definition: &Definition| {
                    add(&format!("/{name}/{topic}"), definition, &about)
                };
                Ok(Channels {
                    image: add("image/compressed", &COMPRESSED_IMAGE)?,
                    mask: add("mask/compressed", &COMPRESSED_IMAGE)?,
                    camera_info: add("camera_info", &CAMERA_INFO)?,
                    joints: add("joints", &MARKER_ARRAY)?,
                    poses: add("joint_poses", &POSE_ARRAY)?,
                    status: add("status", &DIAGNOSTIC_ARRAY)?,
                    link: format!("{name}_link"),
                    optical: ros::optical_frame(&camera.name),
                    camera: camera.clone(),
                })
            })
            .collect::<mcap::McapResult<_>>()?;
        Ok(Self {
            cameras,
            transforms: add("/tf", &TF_MESSAGE, &[])?,
            status: add("/status", &DIAGNOSTIC_ARRAY, &[])?,
            statistics: add("/statistics", &DIAGNOSTIC_ARRAY, &[])?,
        })
    }

    /// What was found in a frame; nothing for a camera that is not recorded.
    ///
    /// # Errors
    /// Which message could not be made, and why.
    pub fn observation(&self, observation: &Observation) -> Result<Vec<Encoded>, String> {
        let Some(channels) = self.cameras.get(observation.camera) else {
            return Ok(Vec::new());
        };
        let header = Header {
            stamp: observation.acquired.into(),
            frame_id: &channels.optical,
        };
        let mut out = Messages {
            sequence: observation.frame as u32,
            at: nanoseconds(observation.acquired),
            messages: Vec::new(),
        };
        let estimate = &observation.estimate;

        let jpeg = jpeg(&observation.image).map_err(failed("the image"))?;
        out.add(channels.image, &picture(header, "jpeg", &jpeg))?;
        if let Some(mask) = &estimate.mask {
            let canonical = &channels.camera.canonical;
            let mask = mask_image(mask, canonical, &observation.view, None);
            let mut png = Cursor::new(Vec::new());
            DynamicImage::ImageLuma8(mask)
                .write_to(&mut png, ImageFormat::Png)
                .map_err(failed("the mask"))?;
            out.add(channels.mask, &picture(header, "png", png.get_ref()))?;
        }
        let camera_info = CameraInfo::new(header, &observation.view);
        out.add(channels.camera_info, &camera_info)?;

        let markers = markers(header, &channels.camera.name, &estimate.joints);
        out.add(channels.joints, &MarkerArray { markers })?;
        let poses = estimate.joints.iter().map(|joint| Pose {
            position: joint.xyz_m.into(),
            ..Pose::default()
        });
        let poses = poses.collect();
        out.add(channels.poses, &PoseArray { header, poses })?;

        let optical = TransformStamped {
            header: Header {
                frame_id: &channels.link,
                ..header
            },
            child_frame_id: &channels.optical,
            transform: Transform {
                translation: Xyz::default(),
                rotation: OPTICAL,
            },
        };
        let transforms = vec![optical];
        out.add(self.transforms, &TfMessage { transforms })?;

        let status = vec![channels.found(observation)];
        out.add(channels.status, &DiagnosticArray { header, status })?;
        Ok(out.messages)
    }

    /// Something that happened. A camera that gives no answers any more has no joints to show.
    ///
    /// # Errors
    /// Which message could not be made, and why.
    pub fn event(&self, event: &Event) -> Result<Vec<Encoded>, String> {
        let mut out = Messages::at(event.at);
        let channels = event.camera.and_then(|camera| self.cameras.get(camera));
        let header = Header {
            stamp: event.at.into(),
            frame_id: channels.map_or("", |channels| &channels.optical),
        };
        let name = channels.map_or("all cameras", |channels| &channels.camera.name);
        let status = vec![happened(name, &event.kind)];
        let channel = channels.map_or(self.status, |channels| channels.status);
        out.add(channel, &DiagnosticArray { header, status })?;

        let blinds = matches!(
            event.kind,
            EventKind::Stale
                | EventKind::Failed { .. }
                | EventKind::Ended
                | EventKind::DeviceLost { .. }
        );
        if blinds {
            let blind = match event.camera {
                Some(_) => channels.map(std::slice::from_ref).unwrap_or_default(),
                None => &self.cameras,
            };
            for channels in blind {
                let header = Header {
                    frame_id: &channels.optical,
                    ..header
                };
                let markers = markers(header, &channels.camera.name, &[]);
                out.add(channels.joints, &MarkerArray { markers })?;
            }
        }
        Ok(out.messages)
    }

    /// A second's figures, and how many observations are not in the recording so far.
    ///
    /// # Errors
    /// Which message could not be made, and why.
    pub fn statistics(
        &self,
        statistics: &Statistics,
        unrecorded: u64,
    ) -> Result<Vec<Encoded>, String> {
        let mut out = Messages::at(statistics.at);
        let recorder = DiagnosticStatus {
            level: if unrecorded == 0 {
                Level::Ok
            } else {
                Level::Warn
            },
            name: "recorder".into(),
            message: String::new(),
            hardware_id: String::new(),
            values: vec![value("unrecorded", unrecorded)],
        };
        let cameras = self.cameras.iter().zip(&statistics.cameras);
        let status = cameras
            .map(|(channels, rates)| figures(&channels.camera.name, rates))
            .chain([recorder])
            .collect();
        let header = Header {
            stamp: statistics.at.into(),
            frame_id: "",
        };
        out.add(self.statistics, &DiagnosticArray { header, status })?;
        Ok(out.messages)
    }
}

/// Messages of one moment.
struct Messages {
    sequence: u32,
    at: u64,
    messages: Vec<Encoded>,
}

impl Messages {
    fn at(at: SystemTime) -> Self {
        Self {
            sequence: 0,
            at: nanoseconds(at),
            messages: Vec::new(),
        }
    }

    fn add(&mut self, channel: u16, message: &impl Serialize) -> Result<(), String> {
        let data = cdr(message).map_err(failed("a message"))?;
        self.messages.push(Encoded {
            channel,
            sequence: self.sequence,
            at: self.at,
            data,
        });
        Ok(())
    }
}

impl Channels {
    /// The answer in words and values.
    fn found(&self, observation: &Observation) -> DiagnosticStatus {
        let estimate = &observation.estimate;
        let (level, message) = match estimate.status {
            Status::Found => (Level::Ok, "found"),
            Status::NotFound => (Level::Warn, "not found"),
            Status::Invalid => (Level::Error, "invalid"),
        };
        let mut values = vec![
            value("robot", &self.camera.robot),
            value("frame", observation.frame),
            value("age_ms", milliseconds(observation.age())),
            value("coverage", estimate.coverage),
            value("field", estimate.field),
        ];
        if let Some([x0, y0, x1, y1]) = estimate.bbox_px {
            values.push(value("bbox_px", format!("{x0} {y0} {x1} {y1}")));
        }
        DiagnosticStatus {
            level,
            name: format!("{}: robot", self.camera.name),
            message: message.into(),
            hardware_id: self.camera.name.clone(),
            values,
        }
    }
}

fn happened(name: &str, kind: &EventKind) -> DiagnosticStatus {
    let (level, message) = match kind {
        EventKind::Warning(warning) => return warned(warning),
        EventKind::Action(report) => return acted(report),
        EventKind::Live => (Level::Ok, "live"),
        EventKind::Stale => (Level::Stale, "stale"),
        EventKind::Failed { .. } => (Level::Error, "failed"),
        EventKind::Ended => (Level::Stale, "ended"),
        EventKind::DeviceLost { .. } => (Level::Error, "device lost"),
        EventKind::DeviceBack => (Level::Ok, "device back"),
    };
    let mut values = Vec::new();
    if let EventKind::Failed { reason, .. } | EventKind::DeviceLost { reason } = kind {
        values.push(value("reason", reason));
    }
    if let EventKind::Failed {
        retry_in: Some(retry_in),
        ..
    } = kind
    {
        values.push(value("retry_in_ms", milliseconds(*retry_in)));
    }
    DiagnosticStatus {
        level,
        name: format!("{name}: source"),
        message: message.into(),
        hardware_id: name.into(),
        values,
    }
}

fn warned(warning: &Warning) -> DiagnosticStatus {
    let (level, message) = match warning.state {
        State::Clear => (Level::Ok, "clear"),
        State::Warn => (Level::Warn, "warn"),
        State::Stop => (Level::Error, "stop"),
        State::Unknown => (Level::Stale, "unknown"),
    };
    let metres = [
        ("distance_m", warning.distance_m),
        ("uncertainty_m", warning.uncertainty_m),
        ("latency_ms", warning.latency_ms),
    ];
    let values = metres
        .into_iter()
        .filter_map(|(key, number)| Some(value(key, number?)));
    DiagnosticStatus {
        level,
        name: format!("{}: warning", warning.rule),
        message: message.into(),
        hardware_id: warning.rule.clone(),
        values: values.collect(),
    }
}

fn acted(report: &ActionReport) -> DiagnosticStatus {
    DiagnosticStatus {
        level: if report.done { Level::Ok } else { Level::Error },
        name: format!("{}: action", report.action),
        message: report.message.clone(),
        hardware_id: report.action.clone(),
        values: vec![
            value("rule", &report.rule),
            value("attempt", report.attempt),
            value("elapsed_ms", report.elapsed_ms),
        ],
    }
}

fn figures(name: &str, rates: &Rates) -> DiagnosticStatus {
    let mut values = vec![
        value("frames_per_s", rates.frames_per_s),
        value("answers_per_s", rates.answers_per_s),
        value("dropped", rates.dropped),
    ];
    let ages = [("age_p50_ms", rates.age_p50), ("age_p99_ms", rates.age_p99)];
    let ages = ages
        .into_iter()
        .filter_map(|(key, age)| Some(value(key, milliseconds(age?))));
    values.extend(ages);
    DiagnosticStatus {
        level: Level::Ok,
        name: format!("{name}: rates"),
        message: String::new(),
        hardware_id: name.into(),
        values,
    }
}

/// The arm as a line, its joints as spheres and their names; without joints, that nothing is shown any more.
fn markers<'a>(header: Header<'a>, ns: &'a str, joints: &'a [Joint]) -> Vec<Marker<'a>> {
    let marker = |id: usize, kind, size: f64| Marker {
        header,
        ns,
        id: id as i32,
        kind,
        action: Marker::ADD,
        scale: [size; 3].into(),
        color: ARM.into(),
        ..Marker::default()
    };
    if joints.is_empty() {
        return vec![Marker {
            action: Marker::DELETE_ALL,
            ..marker(0, 0, 0.0)
        }];
    }
    let points: Vec<Xyz> = joints.iter().map(|joint| joint.xyz_m.into()).collect();
    let colours = JOINT_COLOURS.iter().cycle().map(|&rgb| Colour::from(rgb));
    let line = Marker {
        points: points.clone(),
        ..marker(0, Marker::LINE_STRIP, LINE)
    };
    let spheres = Marker {
        points: points.clone(),
        colors: colours.take(joints.len()).collect(),
        ..marker(1, Marker::SPHERE_LIST, SPHERE)
    };
    let names = joints.iter().zip(points).enumerate();
    let names = names.map(|(index, (joint, position))| Marker {
        pose: Pose {
            position,
            ..Pose::default()
        },
        text: &joint.name,
        ..marker(2 + index, Marker::TEXT_VIEW_FACING, TEXT)
    });
    [line, spheres].into_iter().chain(names).collect()
}

fn picture<'a>(header: Header<'a>, format: &'a str, data: &'a [u8]) -> CompressedImage<'a> {
    CompressedImage {
        header,
        format,
        data,
    }
}

fn jpeg(image: &RgbaImage) -> Result<Vec<u8>, image::ImageError> {
    let (width, height) = image.dimensions();
    let rgb = image.pixels().flat_map(|pixel| {
        let [r, g, b, _] = pixel.0;
        [r, g, b]
    });
    // The buffer has the image's size.
    let rgb = RgbImage::from_raw(width, height, rgb.collect()).unwrap_or_default();
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).encode_image(&rgb)?;
    Ok(bytes)
}

fn value(key: &'static str, value: impl ToString) -> KeyValue {
    let value = value.to_string();
    KeyValue { key, value }
}

fn milliseconds(duration: Duration) -> f64 {
    1e3 * duration.as_secs_f64()
}

fn failed<E: std::fmt::Display>(what: &str) -> impl Fn(E) -> String {
    move |cause| format!("{what} could not be encoded: {cause}")
}

/// Refuses cameras of the same topics.
pub fn check_names(cameras: &[RecordedCamera]) -> Result<(), McapError> {
    if let Some([first, second]) = ros::alike(cameras.iter().map(|camera| camera.name.as_str())) {
        return Err(McapError::SameTopic {
            first: first.to_owned(),
            second: second.to_owned(),
            topic: ros::name(second),
        });
    }
    Ok(())
}
