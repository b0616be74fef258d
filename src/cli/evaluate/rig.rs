//! Recordings of several cameras at once.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use glam::{DAffine3, DMat4, DVec3};
use indicatif::ProgressBar;

use super::{Judged, RecordingScores, RigScores, Split};
use crate::cascade::Output;
use crate::evaluation::{RigFigures, RigFrame};

/// The cameras' recordings, checked.
pub struct OpenRig {
    folder: PathBuf,
    cameras: Vec<RecordingScores>,
}

impl OpenRig {
    /// Images of all cameras.
    pub fn images(&self) -> usize {
        let cameras = self.cameras.iter();
        cameras.map(|camera| camera.reader.samples().len()).sum()
    }
}

/// The recordings `camera_1`, `camera_2` and so on in `folder`.
pub fn open(folder: &Path, models: &[Judged]) -> anyhow::Result<OpenRig> {
    let mut cameras = Vec::new();
    for number in 1.. {
        let camera = folder.join(format!("camera_{number}"));
        if number > 2 && !camera.is_dir() {
            break;
        }
        cameras.push(super::open(&camera, models, Split::All)?);
    }
    for (number, camera) in (1..).zip(&cameras) {
        let samples = camera.reader.samples().iter();
        let mut placed = samples.filter(|sample| sample.camera_from_base.is_some());
        let first = placed.next().and_then(|sample| sample.camera_from_base);
        if let Some(moved) = placed.find(|sample| sample.camera_from_base != first) {
            let file = camera.folder.join("samples.jsonl");
            bail!(
                "{}:{}: camera_from_base: expected a camera that stands still (record --fixed-camera), \
                 found one that moved",
                file.display(),
                // Ids count from 0 without gaps.
                moved.id + 1
            );
        }
        let header = camera.reader.header();
        let named = || camera.folder.join("recording.json").display().to_string();
        ensure!(
            header.source.camera.is_none_or(|found| found == number),
            "{}: source.camera: expected {number}, found {}",
            named(),
            header.source.camera.unwrap_or_default()
        );
        let first = cameras.first().context("no cameras")?;
        let counts = [first, camera].map(|camera| camera.reader.samples().len());
        ensure!(
            counts[0] == counts[1] && first.by == camera.by,
            "{}: expected {} samples of {} as in {}, found {} of {}",
            named(),
            counts[0],
            first.reader.header().robot,
            first.folder.display(),
            counts[1],
            header.robot
        );
    }
    Ok(OpenRig {
        folder: folder.to_owned(),
        cameras,
    })
}

/// Searches all images, and judges what comes of them.
pub fn judge(rig: OpenRig, models: &mut [Judged], bar: &ProgressBar) -> anyhow::Result<RigScores> {
    let mut by = 0;
    let mut cameras = Vec::new();
    for camera in &rig.cameras {
        by = camera.by;
        let mut frames = Vec::new();
        for sample in camera.reader.samples() {
            let (image, view) = super::picture(&camera.reader, sample)?;
            let locator = &mut models[by].locator;
            let estimate = locator.locate(&image, &view, Output::default())?;
            bar.inc(1);
            let joints = estimate.joints.iter().map(|joint| DVec3::from(joint.xyz_m));
            let truth = sample.joints_m.iter().flatten().map(|&joint| joint.into());
            frames.push(RigFrame {
                found: joints.collect(),
                truth: truth.collect(),
                camera_from_base: sample
                    .camera_from_base
                    .map(|matrix| DAffine3::from_mat4(DMat4::from_cols_array(&matrix).transpose())),
            });
        }
        cameras.push(frames);
    }
    Ok(RigScores {
        folder: rig.folder,
        by,
        figures: RigFigures::new(&cameras),
    })
}
