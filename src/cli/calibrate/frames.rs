//! Lines of `whereabot locate --json` and `whereabot watch`: where a camera saw the joints.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use glam::DVec3;
use serde::Deserialize;

/// An image of a camera that was searched.
pub struct Frame {
    /// File and line, for messages.
    pub place: String,
    /// When it was taken, seconds; `watch` says so.
    pub time_s: Option<f64>,
    /// The image's file; `locate` says so.
    pub file: Option<String>,
    /// Joints by name, camera optical frame, metres; empty where no robot was found.
    pub joints: Vec<(String, DVec3)>,
}

/// What is needed of a line; it may say more.
#[derive(Deserialize)]
struct Line {
    #[serde(rename = "type")]
    kind: Option<String>,
    camera: Option<String>,
    file: Option<String>,
    acquired_s: Option<f64>,
    status: Option<String>,
    frame: Option<String>,
    joints: Option<Vec<Joint>>,
}

#[derive(Deserialize)]
struct Joint {
    name: String,
    xyz_m: [f64; 3],
}

/// The frames of each camera, in the lines' order. Lines that name no camera are of one that has the file's name: two
/// such files of one name are refused. `-` is stdin.
pub fn read(files: &[impl AsRef<Path>]) -> anyhow::Result<BTreeMap<String, Vec<Frame>>> {
    let mut cameras: BTreeMap<String, Vec<Frame>> = BTreeMap::new();
    let mut unnamed: BTreeMap<String, &Path> = BTreeMap::new();
    for file in files.iter().map(AsRef::as_ref) {
        let (name, reader): (&str, Box<dyn BufRead>) = if file.as_os_str() == "-" {
            ("camera", Box::new(io::stdin().lock()))
        } else {
            let opened = File::open(file).with_context(|| file.display().to_string())?;
            let stem = file.file_stem().and_then(|stem| stem.to_str());
            (stem.unwrap_or("camera"), Box::new(BufReader::new(opened)))
        };
        for (number, line) in (1..).zip(reader.lines()) {
            let place = format!("{}:{number}", file.display());
            let line = line.with_context(|| place.clone())?;
            if line.trim().is_empty() {
                continue;
            }
            let parsed: Line = serde_json::from_str(&line).with_context(|| place.clone())?;
            if let Some((camera, frame)) = frame(parsed, &place).with_context(|| place.clone())? {
                let camera = match camera {
                    Some(camera) => camera,
                    None => {
                        let first = *unnamed.entry(name.to_owned()).or_insert(file);
                        ensure!(
                            first == file,
                            "{place}: expected the frames of camera {name} in one file, found some in {}: rename one",
                            first.display()
                        );
                        name.to_owned()
                    }
                };
                cameras.entry(camera).or_default().push(frame);
            }
        }
    }
    Ok(cameras)
}

/// A line's camera and frame; `None` for lines of other kinds, such as events.
fn frame(line: Line, place: &str) -> anyhow::Result<Option<(Option<String>, Frame)>> {
    if line.kind.is_some_and(|kind| kind != "result") {
        return Ok(None);
    }
    let status = line.status.as_deref();
    let joints = match (status, line.joints) {
        (Some("found"), Some(joints)) => joints,
        (Some("found"), None) => {
            bail!("joints: expected those of a robot that was found, found none")
        }
        (Some("not_found" | "invalid" | "error"), _) => Vec::new(),
        (found, _) => bail!(
            "status: expected found, not_found, invalid or error, found {}",
            found.unwrap_or("none")
        ),
    };
    if !joints.is_empty() {
        ensure!(
            line.frame.as_deref() == Some("camera_optical"),
            "frame: expected camera_optical, found {}",
            line.frame.as_deref().unwrap_or("none")
        );
    }
    let frame = Frame {
        place: place.to_owned(),
        time_s: line.acquired_s,
        file: line.file,
        joints: joints
            .into_iter()
            .map(|joint| (joint.name, DVec3::from(joint.xyz_m)))
            .collect(),
    };
    Ok(Some((line.camera, frame)))
}
