use std::path::{Component, Path, PathBuf};

use image::{DynamicImage, GrayImage, RgbImage};

use super::RecordingError;
use super::format::{FORMAT, FRAME, Header, Sample, SourceKind, VERSION};
use crate::image_file;

/// Reads a recording. What it hands out has been checked.
#[derive(Debug)]
pub struct Reader {
    folder: PathBuf,
    header: Header,
    samples: Vec<Sample>,
}

impl Reader {
    /// Reads the header and all lines of the recording in `folder`. Pictures are read later.
    ///
    /// # Errors
    /// A file is missing or unreadable; the header or a line is not what the format asks for (the error
    /// names the file, the line, what was expected and what was found); the last line has no end; there
    /// is no sample.
    pub fn open(folder: &Path) -> Result<Reader, RecordingError> {
        let (reader, faults) = Self::open_with_faults(folder)?;
        match faults.into_iter().next() {
            Some(fault) => Err(fault),
            None => Ok(reader),
        }
    }

    /// As [`Reader::open`], but leaves out the samples whose lines are wrong, and says why.
    ///
    /// # Errors
    /// The header is wrong, or a file cannot be read.
    pub fn open_with_faults(
        folder: &Path,
    ) -> Result<(Reader, Vec<RecordingError>), RecordingError> {
        let header = Header::read(&folder.join("recording.json"))?;
        let path = folder.join("samples.jsonl");
        let bytes = std::fs::read(&path).map_err(RecordingError::io(&path))?;
        let mut samples = Vec::new();
        let mut faults = Vec::new();
        for (line, text) in (1..).zip(bytes.split_inclusive(|&byte| byte == b'\n')) {
            match parse(&header, line, text) {
                Ok(sample) => samples.push(sample),
                Err(message) => faults.push(RecordingError::Line {
                    path: path.clone(),
                    line,
                    message,
                }),
            }
        }
        if samples.is_empty() && faults.is_empty() {
            faults.push(RecordingError::NoSamples { path });
        }
        let folder = folder.to_owned();
        let reader = Reader {
            folder,
            header,
            samples,
        };
        Ok((reader, faults))
    }

    /// What all samples have in common.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The samples, in order.
    pub fn samples(&self) -> &[Sample] {
        &self.samples
    }

    /// A sample's colour image, of the header's size.
    ///
    /// # Errors
    /// The file is missing, cannot be decoded, or has another size.
    pub fn image(&self, sample: &Sample) -> Result<RgbImage, RecordingError> {
        Ok(self.picture(sample, &sample.image)?.into_rgb8())
    }

    /// A sample's mask, of the header's size: 255 where the robot is visible, else 0.
    ///
    /// # Errors
    /// The file is missing, cannot be decoded, has another size or other values, or not the share of
    /// robot pixels that the sample's `coverage` says (to 0.001).
    pub fn mask(&self, sample: &Sample) -> Result<GrayImage, RecordingError> {
        let mask = self.picture(sample, &sample.mask)?.into_luma8();
        if let Some(other) = mask.iter().find(|&&value| value != 0 && value != 255) {
            let message = format!("expected the values 0 and 255, found {other}");
            return Err(self.fault(sample, &sample.mask, &message));
        }
        let covered = mask.iter().filter(|&&value| value == 255).count();
        let share = covered as f64 / mask.len() as f64;
        if (share - sample.coverage).abs() > 1e-3 {
            let (coverage, name) = (sample.coverage, &sample.mask);
            let message =
                format!("expected {coverage:.4} robot pixels (coverage), found {share:.4}");
            return Err(self.fault(sample, name, &message));
        }
        Ok(mask)
    }

    fn picture(&self, sample: &Sample, name: &str) -> Result<DynamicImage, RecordingError> {
        let picture = image_file::read(&self.folder.join(name))
            .map_err(|cause| self.fault(sample, name, &cause.to_string()))?;
        let (width, height) = (self.header.width, self.header.height);
        if (picture.width(), picture.height()) != (width, height) {
            let found = format!("{} x {}", picture.width(), picture.height());
            let message = format!("expected {width} x {height} pixels, found {found}");
            return Err(self.fault(sample, name, &message));
        }
        Ok(picture)
    }

    fn fault(&self, sample: &Sample, name: &str, message: &str) -> RecordingError {
        RecordingError::Line {
            path: self.folder.join("samples.jsonl"),
            // Ids count from 0 without gaps.
            line: sample.id + 1,
            message: format!("{name}: {message}"),
        }
    }
}

impl Header {
    /// Reads and checks a `recording.json`.
    pub(super) fn read(path: &Path) -> Result<Header, RecordingError> {
        let text = std::fs::read(path).map_err(RecordingError::io(path))?;
        let fault = |message: String| RecordingError::Header {
            path: path.to_owned(),
            message,
        };
        let value: serde_json::Value =
            serde_json::from_slice(&text).map_err(|e| fault(e.to_string()))?;
        // Another version may have other fields: these two come first.
        for (key, expected) in [("format", FORMAT.into()), ("version", VERSION.into())] {
            let expected: serde_json::Value = expected;
            let found = value.get(key).unwrap_or(&serde_json::Value::Null);
            if *found != expected {
                return Err(fault(format!("{key}: expected {expected}, found {found}")));
            }
        }
        let header: Header = serde_json::from_slice(&text).map_err(|e| fault(e.to_string()))?;
        header.check().map_err(fault)?;
        Ok(header)
    }

    fn check(&self) -> Result<(), String> {
        if self.frame != FRAME {
            let found = &self.frame;
            return Err(format!("frame: expected {FRAME:?}, found {found:?}"));
        }
        if self.width == 0 || self.height == 0 {
            let (width, height) = (self.width, self.height);
            return Err(format!("expected a size, found {width} x {height}"));
        }
        if self.joints.is_empty() {
            return Err("joints: expected at least one, found none".into());
        }
        let source = &self.source;
        if source.kind == SourceKind::Synthetic {
            let missing = [
                ("seed", source.seed.is_none()),
                ("urdf", source.urdf.is_none()),
                ("protocol", source.protocol.is_none()),
            ];
            if let Some((key, _)) = missing.iter().find(|(_, missing)| *missing) {
                return Err(format!("source: expected {key} in a synthetic recording"));
            }
        }
        Ok(())
    }
}

/// A line with its end, checked; what is wrong with it otherwise.
pub(super) fn parse(header: &Header, line: u64, text: &[u8]) -> Result<Sample, String> {
    let Some(text) = text.strip_suffix(b"\n") else {
        return Err("expected a whole line, found one without its end: \
             the recording is still being written, or was cut off"
            .into());
    };
    let sample: Sample = serde_json::from_slice(text).map_err(|e| {
        // The line that serde_json counts is always the first.
        let message = e.to_string();
        let what = message.split(" at line ").next().unwrap_or_default();
        format!("column {}: {what}", e.column())
    })?;
    if sample.id != line - 1 {
        let (expected, found) = (line - 1, sample.id);
        return Err(format!("id: expected {expected}, found {found}"));
    }
    check(header, &sample)?;
    Ok(sample)
}

fn check(header: &Header, sample: &Sample) -> Result<(), String> {
    for (key, path) in [("image", &sample.image), ("mask", &sample.mask)] {
        let mut parts = Path::new(path).components();
        if path.is_empty() || !parts.all(|part| matches!(part, Component::Normal(_))) {
            let expected = "a path inside the recording's folder";
            return Err(format!("{key}: expected {expected}, found {path:?}"));
        }
    }
    let k = sample.intrinsics;
    let finite = [k.fx, k.fy, k.cx, k.cy].iter().all(|v| v.is_finite());
    if !finite || k.fx <= 0.0 || k.fy <= 0.0 {
        let expected = "finite numbers, fx and fy positive";
        return Err(format!("intrinsics: expected {expected}, found {k:?}"));
    }
    if !(0.0..=1.0).contains(&sample.coverage) {
        let found = sample.coverage;
        return Err(format!("coverage: expected 0 to 1, found {found}"));
    }
    let keys = [
        ("camera_from_base", sample.camera_from_base.is_some()),
        ("joint_angles_rad", sample.joint_angles_rad.is_some()),
        ("joints_m", sample.joints_m.is_some()),
        ("joints_px", sample.joints_px.is_some()),
    ];
    let (Some(matrix), Some(angles), Some(joints_m), Some(joints_px)) = (
        &sample.camera_from_base,
        &sample.joint_angles_rad,
        &sample.joints_m,
        &sample.joints_px,
    ) else {
        let given = keys.iter().find(|(_, given)| *given);
        let missing = keys.iter().find(|(_, given)| !*given);
        return match (given, missing) {
            (Some((given, _)), Some((missing, _))) => Err(format!(
                "{missing}: expected with {given} (all of a robot's keys, or none), found none"
            )),
            _ if sample.coverage > 0.0 => {
                let found = sample.coverage;
                Err(format!(
                    "coverage: expected 0 without a robot, found {found}"
                ))
            }
            _ => Ok(()),
        };
    };
    check_rigid(matrix)?;
    let count = header.joints.len();
    for (key, found) in [
        ("joint_angles_rad", angles.len()),
        ("joints_m", joints_m.len()),
        ("joints_px", joints_px.len()),
    ] {
        if found != count {
            return Err(format!("{key}: expected {count} joints, found {found}"));
        }
    }
    if let Some(angle) = angles.iter().find(|angle| !angle.is_finite()) {
        return Err(format!(
            "joint_angles_rad: expected finite angles, found {angle}"
        ));
    }
    for ((name, &metres), &pixel) in header.joints.iter().zip(joints_m).zip(joints_px) {
        let projected = k
            .project(metres)
            .filter(|p| p.iter().all(|v| v.is_finite()));
        let Some(projected) = projected else {
            let expected = "a point before the camera (z > 0)";
            return Err(format!(
                "joints_m: {name}: expected {expected}, found {metres:?}"
            ));
        };
        let near = |(a, b): (f64, f64)| (a - b).abs() <= 1.0;
        if !projected.into_iter().zip(pixel).all(near) {
            return Err(format!(
                "joints_px: {name}: expected {projected:.1?} (joints_m through the intrinsics), \
                 found {pixel:.1?}"
            ));
        }
    }
    Ok(())
}

/// Whether a matrix is a rotation and a shift, row by row; a transposed one is not.
fn check_rigid(matrix: &[f64; 16]) -> Result<(), String> {
    let map = glam::DMat4::from_cols_array(matrix).transpose();
    let rotation = glam::DMat3::from_mat4(map);
    let rest = rotation * rotation.transpose() - glam::DMat3::IDENTITY;
    let off = rest.to_cols_array().iter().map(|v| v.abs()).sum::<f64>();
    let last = map.row(3) - glam::DVec4::W;
    // Written so that NaN is refused.
    let rigid = map.is_finite()
        && off < 1e-2
        && last.abs().max_element() < 1e-6
        && rotation.determinant() > 0.0;
    if rigid {
        Ok(())
    } else {
        Err(format!(
            "camera_from_base: expected a rotation and a shift, row by row, found {matrix:?}"
        ))
    }
}
