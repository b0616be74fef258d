//! A recording on disk: `recording.json`, `samples.jsonl`, `image/` and `mask/`.

use std::fs::{File, TryLockError};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::RecordingError;
use super::reader::parse;
use crate::camera::Intrinsics;

/// The header's `format`.
pub const FORMAT: &str = "whereabot-recording";
/// The header's `version`.
pub const VERSION: u32 = 1;
/// The header's `frame`.
pub const FRAME: &str = "camera_optical";

/// `recording.json`: what all samples of a recording have in common.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Always `whereabot-recording`.
    pub format: String,
    /// Version of this format: 1.
    pub version: u32,
    /// The robot's name, for example `ur5`.
    pub robot: String,
    /// Joint names, base first.
    pub joints: Vec<String>,
    /// Width of all images, pixels.
    pub width: u32,
    /// Height of all images, pixels.
    pub height: u32,
    /// The frame of all positions: `camera_optical` (x right, y down, z forward).
    pub frame: String,
    /// Where the samples come from.
    pub source: Source,
}

/// Where a recording comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// Rendered, or taken with a camera.
    pub kind: SourceKind,
    /// The program that wrote it, and its version.
    pub generator: String,
    /// The seed that the samples were drawn from. Each synthetic recording has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// The robot description's file name. Each synthetic recording has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub urdf: Option<String>,
    /// The file names of the descriptions of the robot's other bodies.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub bodies: Vec<String>,
    /// How camera and robot move. Each synthetic recording has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub protocol: Option<Protocol>,
    /// How many samples the recording shall have, where their poses depend on it
    /// ([`Protocol::FixedCamera`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub planned: Option<u64>,
    /// Which camera this was, from 1, where several cameras saw the same robot at the same time, a recording
    /// each: samples of one number are of one instant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<u64>,
    /// How many these were.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cameras: Option<u64>,
}

/// Whether a recording was rendered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SourceKind {
    /// Rendered.
    Synthetic,
    /// Taken with a camera, of a real robot.
    Real,
}

/// How camera and robot move over a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Protocol {
    /// Each sample has a camera, a background, a light and a look of its own; some have no robot.
    FreeCamera,
    /// One camera and one look; all joints are swept through their ranges, the photo behind the robot and
    /// the light vary (the paper, section 2).
    FixedCamera,
}

/// A line of `samples.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sample {
    /// Number of the sample, from 0.
    pub id: u64,
    /// The colour image, relative to the recording's folder.
    pub image: String,
    /// The mask, relative to the recording's folder: 255 where the robot is visible, else 0.
    pub mask: String,
    /// The camera.
    pub intrinsics: Intrinsics,
    /// From the robot's base frame to the camera optical frame: 4x4, row by row.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_from_base: Option<[f64; 16]>,
    /// Joint angles, radians.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint_angles_rad: Option<Vec<f64>>,
    /// Joint origins in the camera optical frame, metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joints_m: Option<Vec<[f64; 3]>>,
    /// Joint origins in the image, pixels, also where they lie outside it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joints_px: Option<Vec<[f64; 2]>>,
    /// The share of pixels whose mask is 255.
    pub coverage: f64,
}

impl Sample {
    /// Whether the sample is one of those to test with: one in five, told by its id alone, so that
    /// a recording that grows keeps its split. The rest is to train with (the paper, section 2, splits
    /// at random into 80 and 20 %).
    ///
    /// All of the format's readers split alike: the id's hash (SplitMix64) is a multiple of 5.
    pub fn is_test(&self) -> bool {
        let mut z = self.id.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)).is_multiple_of(5)
    }
}

/// Writes a recording.
pub struct Writer {
    folder: PathBuf,
    lines: File,
    next: u64,
}

impl Writer {
    /// Starts a recording in `folder`, or goes on with one whose header is the same after its last
    /// complete line.
    ///
    /// # Errors
    /// The folder holds another recording (the error says what differs), wrong lines or other pictures,
    /// another process is writing to it, or it cannot be written.
    pub fn open(folder: &Path, header: &Header) -> Result<Writer, RecordingError> {
        let header_path = folder.join("recording.json");
        let lines_path = folder.join("samples.jsonl");
        let taken = |path: &Path, message: &str| RecordingError::OutputTaken {
            path: path.to_owned(),
            message: format!("{message}: choose another folder"),
        };
        if header_path.exists() {
            let found = Header::read(&header_path)?;
            if let Some(difference) = difference(header, &found) {
                let message = format!("holds another recording ({difference})");
                return Err(taken(&header_path, &message));
            }
        } else {
            for name in ["samples.jsonl", "image", "mask"] {
                let path = folder.join(name);
                if path.exists() {
                    return Err(taken(&path, "part of something without a recording.json"));
                }
            }
            std::fs::create_dir_all(folder).map_err(RecordingError::io(folder))?;
            let text = serde_json::to_string_pretty(header).map_err(|e| RecordingError::Io {
                path: header_path.clone(),
                cause: e.into(),
            })?;
            std::fs::write(&header_path, text + "\n").map_err(RecordingError::io(&header_path))?;
        }
        for inside in ["image", "mask"] {
            let inside = folder.join(inside);
            std::fs::create_dir_all(&inside).map_err(RecordingError::io(&inside))?;
        }

        let mut lines = File::options()
            .read(true)
            .append(true)
            .create(true)
            .open(&lines_path)
            .map_err(RecordingError::io(&lines_path))?;
        lines.try_lock().map_err(|error| match error {
            TryLockError::WouldBlock => taken(&lines_path, "is being written by another process"),
            TryLockError::Error(cause) => RecordingError::io(&lines_path)(cause),
        })?;
        let mut bytes = Vec::new();
        lines
            .read_to_end(&mut bytes)
            .map_err(RecordingError::io(&lines_path))?;
        let (mut next, mut complete) = (0, 0);
        for line in bytes.split_inclusive(|&byte| byte == b'\n') {
            if line.ends_with(b"\n") {
                next += 1;
                complete += line.len() as u64;
                parse(header, next, line).map_err(|message| RecordingError::Line {
                    path: lines_path.clone(),
                    line: next,
                    message,
                })?;
            }
        }
        lines
            .set_len(complete)
            .map_err(RecordingError::io(&lines_path))?;
        Ok(Writer {
            folder: folder.to_owned(),
            lines,
            next,
        })
    }

    /// The number of the sample to write next.
    pub fn next(&self) -> u64 {
        self.next
    }

    /// Adds a sample, whose pictures are already written. Samples come in order.
    ///
    /// # Errors
    /// The line cannot be written.
    pub fn append(&mut self, sample: &Sample) -> Result<(), RecordingError> {
        let path = || self.folder.join("samples.jsonl");
        let mut line = serde_json::to_string(sample).map_err(|e| RecordingError::Io {
            path: path(),
            cause: e.into(),
        })?;
        line.push('\n');
        self.lines
            .write_all(line.as_bytes())
            .map_err(RecordingError::io(path()))?;
        self.next += 1;
        Ok(())
    }
}

/// The first thing in which two headers differ.
fn difference(expected: &Header, found: &Header) -> Option<String> {
    let expected = serde_json::to_value(expected).ok()?;
    let found = serde_json::to_value(found).ok()?;
    let flat = |header: &Value| -> Vec<(String, Value)> {
        let fields = header.as_object().into_iter().flatten();
        let (source, other): (Vec<_>, Vec<_>) = fields.partition(|(key, _)| *key == "source");
        let inside = source.iter().filter_map(|(_, value)| value.as_object());
        let inside = inside.flatten().map(|(k, v)| (format!("source.{k}"), v));
        let other = other.into_iter().map(|(k, v)| (k.clone(), v));
        other.chain(inside).map(|(k, v)| (k, v.clone())).collect()
    };
    let (expected, found) = (flat(&expected), flat(&found));
    let of = |fields: &[(String, Value)], name: &str| {
        let field = fields.iter().find(|(key, _)| key == name);
        field.map_or(Value::Null, |(_, value)| value.clone())
    };
    expected.iter().chain(&found).find_map(|(key, _)| {
        let (expected, found) = (of(&expected, key), of(&found, key));
        (expected != found).then(|| format!("{key}: expected {expected}, found {found}"))
    })
}
