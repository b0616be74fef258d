//! Makes recordings: scenes round a robot, drawn on the GPU.
//!
//! Points are in metres, in the camera optical frame (x right, y down, z forward) or in the robot's
//! base frame (the frame of the first joint's parent link, z up), as each name says.

mod background;
mod chance;
mod collision;
mod effects;
mod error;
mod picture;
mod props;
mod render;
mod scene;
mod stage;
mod sweep;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, mpsc};

pub use background::{Backgrounds, PhotoView};
pub use collision::CollisionModel;
pub use effects::{Effects, Window};
pub use error::RecorderError;
pub use picture::Picture;
pub use render::Renderer;
pub use scene::{Item, Kind, Lamp, Lighting, Material, Scene};
pub use stage::{Posed, Shot, Stage, Station};

use crate::camera::Intrinsics;
use crate::gpu::Device;
use crate::recording::{self, Header, Protocol, Sample, Source, SourceKind, Writer};
use crate::robot::Robot;

/// Width of recorded images, pixels.
pub const WIDTH: u32 = 512;
/// Height of recorded images, pixels.
pub const HEIGHT: u32 = 424;
/// The recorder's camera: that of the Kinect V2's depth image.
pub const INTRINSICS: Intrinsics = Intrinsics {
    fx: 365.0,
    fy: 365.0,
    cx: 255.5,
    cy: 211.5,
};

/// What to record.
#[derive(Debug, Clone)]
pub struct Request {
    /// The robot description.
    pub urdf: PathBuf,
    /// Where `package://NAME/` is, for packages that are not found upwards from the URDF.
    pub packages: Vec<(String, PathBuf)>,
    /// Other bodies of the robot, which free cameras see as often: their [`Frames`](crate::robot::Frames) files and URDFs.
    pub bodies: Vec<(PathBuf, PathBuf)>,
    /// The robot's name, for the header.
    pub robot: String,
    /// A folder of background photos.
    pub backgrounds: PathBuf,
    /// How many samples.
    pub samples: u64,
    /// Samples are drawn from this seed and their number alone; with a fixed camera, also from
    /// `samples`.
    pub seed: u64,
    /// How camera and robot move.
    pub protocol: Protocol,
    /// How many cameras see each pose of the robot, 1 or more. Several make a recording each, with the same
    /// robot at the same samples: `camera_1`, `camera_2` and so on in `out`.
    pub cameras: u64,
    /// The recording's folder.
    pub out: PathBuf,
}

/// The paper's nine recordings: each robot's numbers of samples (the paper, table 1).
pub const PAPER: [(&str, [u64; 3]); 3] = [
    ("ur3", [211, 252, 463]),
    ("ur5", [252, 756, 1512]),
    ("ur10", [112, 278, 514]),
];

/// Requests for the paper's nine recordings, in the folders `ur3_1` to `ur10_3` of `out`, each with its
/// own camera and look. `urdfs`: the descriptions of UR3, UR5 and UR10.
pub fn paper_requests(
    urdfs: [PathBuf; 3],
    packages: &[(String, PathBuf)],
    backgrounds: &Path,
    seed: u64,
    out: &Path,
) -> Vec<Request> {
    let recordings = PAPER.iter().zip(urdfs).flat_map(|((robot, counts), urdf)| {
        let numbered = counts.iter().zip(1..);
        numbered.map(move |(&samples, number)| (*robot, number, samples, urdf.clone()))
    });
    // No two of these are alike for any two seeds.
    let seeds = (0..).map(|n| seed.wrapping_mul(9).wrapping_add(n));
    recordings
        .zip(seeds)
        .map(|((robot, number, samples, urdf), seed)| Request {
            urdf,
            packages: packages.to_vec(),
            bodies: Vec::new(),
            robot: robot.to_owned(),
            backgrounds: backgrounds.to_owned(),
            samples,
            seed,
            protocol: Protocol::FixedCamera,
            cameras: 1,
            out: out.join(format!("{robot}_{number}")),
        })
        .collect()
}

/// Shoulder to elbow to wrist, in metres, by the names that users know: a UR3's, UR5's and UR10's, and an e-series' as long, within
/// [`ARM_TOLERANCE`].
const ARMS: [(&str, f64); 3] = [("ur3", 0.47), ("ur5", 0.83), ("ur10", 1.2)];
/// How much of it an arm may be longer or shorter. URDFs place the elbow's frame on one side of it or the other.
const ARM_TOLERANCE: f64 = 0.1;

/// Whether `robot` can be the one that the request names. Of a name that is not one of [`PAPER`]'s, nothing is known.
///
/// # Errors
/// [`RecorderError::OtherRobot`].
pub fn check_robot(request: &Request, robot: &Robot) -> Result<(), RecorderError> {
    let Some((_, expected)) = ARMS.iter().find(|(name, _)| *name == request.robot) else {
        return Ok(());
    };
    let origins = robot.joint_origins(&robot.link_poses(&vec![0.0; robot.joints.len()]));
    let found = match origins.as_slice() {
        [_, shoulder, elbow, wrist, _, _] => {
            Some(shoulder.distance(*elbow) + elbow.distance(*wrist))
        }
        _ => None,
    };
    if found.is_some_and(|found| (found / expected - 1.0).abs() <= ARM_TOLERANCE) {
        return Ok(());
    }
    Err(RecorderError::OtherRobot {
        urdf: request.urdf.clone(),
        robot: request.robot.clone(),
        expected: *expected,
        found,
    })
}

/// Renders a recording; goes on with one that was cut off. `progress` hears how many samples are done.
///
/// # Errors
/// The request cannot be carried out, the device fails or a file cannot be written. Samples written so
/// far stay.
pub fn record(
    device: &Device,
    request: &Request,
    progress: impl Fn(u64),
) -> Result<(), RecorderError> {
    let backgrounds = Backgrounds::open(&request.backgrounds)?;
    let stage = Stage::load(&request.urdf, &request.packages, &request.bodies)?;
    check_robot(request, stage.robot())?;
    let recordings: Vec<(PathBuf, Header)> = if request.cameras > 1 {
        let folder = |camera| request.out.join(format!("camera_{camera}"));
        (1..=request.cameras)
            .map(|camera| (folder(camera), header(request, &stage, Some(camera))))
            .collect()
    } else {
        vec![(request.out.clone(), header(request, &stage, None))]
    };
    if recordings
        .iter()
        .all(|(out, _)| out.join("recording.json").exists())
    {
        let done = next(&open(&recordings)?);
        if done >= request.samples {
            progress(done);
            return Ok(());
        }
    }
    let station = match request.protocol {
        Protocol::FixedCamera => {
            let samples = usize::try_from(request.samples).unwrap_or(usize::MAX);
            Some(stage.station(request.seed, recordings.len(), samples)?)
        }
        Protocol::FreeCamera => None,
    };
    let renderer = Mutex::new(Renderer::new(device, stage.meshes())?);
    let mut writers = open(&recordings)?;
    progress(next(&writers));

    let make = |id: u64| -> Result<Vec<Sample>, RecorderError> {
        let photos = backgrounds.count();
        let shots = match &station {
            Some(station) => stage.fixed_shots(station, id, photos)?,
            None => stage.free_shots(request.seed, id, recordings.len(), photos)?,
        };
        let draw = |(shot, (folder, _)): (&Shot, &(PathBuf, Header))| {
            let background = backgrounds.view(&shot.background)?;
            let texture = shot
                .texture
                .as_ref()
                .map(|view| backgrounds.view(view))
                .transpose()?;
            let mut picture = renderer
                .lock()
                .unwrap_or_else(std::sync::PoisonError::into_inner)
                .draw(&shot.scene, &background, texture.as_deref())?;
            shot.effects.apply(&mut picture);
            let sample = describe(id, shot, &picture);
            picture.write(folder, &sample)?;
            Ok(sample)
        };
        shots.iter().zip(&recordings).map(draw).collect()
    };

    // Each worker makes whole samples; only drawing is one at a time.
    let workers = std::thread::available_parallelism().map_or(1, |n| n.get());
    let upcoming = AtomicU64::new(next(&writers));
    let stop = AtomicBool::new(false);
    let (send, receive) = mpsc::sync_channel(workers);
    std::thread::scope(|scope| {
        for _ in 0..workers {
            let (send, upcoming, stop, make) = (send.clone(), &upcoming, &stop, &make);
            scope.spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    let id = upcoming.fetch_add(1, Ordering::Relaxed);
                    if id >= request.samples || send.send((id, make(id))).is_err() {
                        return;
                    }
                }
            });
        }
        drop(send);
        let mut waiting = BTreeMap::new();
        let mut append = || {
            for (id, samples) in &receive {
                waiting.insert(id, samples?);
                while let Some(samples) = waiting.remove(&next(&writers)) {
                    for (writer, sample) in writers.iter_mut().zip(&samples) {
                        // A recording that was cut off may be ahead of the others.
                        if writer.next() == sample.id {
                            writer.append(sample)?;
                        }
                    }
                    progress(next(&writers));
                }
            }
            Ok(())
        };
        let result = append();
        stop.store(true, Ordering::Relaxed);
        drop(receive);
        result
    })
}

/// The header of camera `camera`'s recording; `None` where there is one camera.
fn header(request: &Request, stage: &Stage, camera: Option<u64>) -> Header {
    let joints = stage.robot().joints.iter();
    Header {
        format: recording::FORMAT.into(),
        version: recording::VERSION,
        robot: request.robot.clone(),
        joints: joints.map(|j| j.name.clone()).collect(),
        width: WIDTH,
        height: HEIGHT,
        frame: recording::FRAME.into(),
        source: Source {
            kind: SourceKind::Synthetic,
            generator: concat!("whereabot ", env!("CARGO_PKG_VERSION")).into(),
            seed: Some(request.seed),
            urdf: Some(file_name(&request.urdf)),
            bodies: request.bodies.iter().map(|(_, b)| file_name(b)).collect(),
            protocol: Some(request.protocol),
            planned: (request.protocol == Protocol::FixedCamera).then_some(request.samples),
            camera,
            cameras: camera.map(|_| request.cameras),
        },
    }
}

fn open(recordings: &[(PathBuf, Header)]) -> Result<Vec<Writer>, RecorderError> {
    let writers = recordings.iter();
    writers
        .map(|(out, header)| Ok(Writer::open(out, header)?))
        .collect()
}

/// The sample to write next: all recordings have those before it.
fn next(writers: &[Writer]) -> u64 {
    writers.iter().map(Writer::next).min().unwrap_or_default()
}

fn file_name(path: &Path) -> String {
    let name = path.file_name();
    name.map(|n| n.to_string_lossy().into_owned())
        .unwrap_or_default()
}

fn describe(id: u64, shot: &Shot, picture: &Picture) -> Sample {
    let covered = picture.mask.iter().filter(|&&m| m > 0).count();
    let matrix = glam::DMat4::from(shot.scene.camera_from_base)
        .transpose()
        .to_cols_array();
    let robot = shot.robot.as_ref();
    Sample {
        id,
        image: format!("image/{id:06}.jpg"),
        mask: format!("mask/{id:06}.png"),
        intrinsics: INTRINSICS,
        camera_from_base: robot.map(|_| matrix),
        joint_angles_rad: robot.map(|r| r.angles.clone()),
        joints_m: robot.map(|r| r.joints.iter().map(|j| j.to_array()).collect()),
        joints_px: robot.map(|r| {
            r.joints
                .iter()
                .filter_map(|j| INTRINSICS.project(j.to_array()))
                .collect()
        }),
        coverage: covered as f64 / picture.mask.len() as f64,
    }
}
