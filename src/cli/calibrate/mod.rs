//! `whereabot calibrate`: where cameras are in the robot's base frame.

mod angles;
mod frames;
mod report;

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail, ensure};
use glam::DVec3;

use crate::calibration::{Pair, Registration, register};
use crate::live::ros;
use crate::robot::{Frames, Robot};
use angles::{Angles, Pose};
use frames::Frame;
use report::{Doubt, Report, Residual};

/// Find where cameras are in the robot's base frame, by the joints that they see and the robot's joint angles
///
/// The robot is the target: no markers, no rig. Takes the lines of `whereabot locate --json` or `whereabot watch`, of a
/// camera that stands still and a robot that stands in one pose after another. Prints each camera's pose with its
/// uncertainty, and the arguments of ROS's static_transform_publisher. A frame gets its joint angles by its time
/// (`acquired_s`, between the rows before and after; the robot stood still for the second before), else by its image's
/// file name, else, where there are as many rows as frames, by order. Exits with 0 if
/// all cameras were found; with 1 if one was not, or something could not be read; with 2 on wrong usage.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Files of JSON lines, - for stdin
    #[arg(required = true, value_name = "LINES")]
    lines: Vec<PathBuf>,
    /// The robot's joint angles, radians: CSV with a header (columns shoulder_pan, ..., and time_s or file), or
    /// JSON Lines (a recording's samples.jsonl, ROS's JointState, or a key a joint)
    #[arg(long, value_name = "FILE")]
    angles: PathBuf,
    /// The robot description (URDF); its meshes are not needed
    #[arg(long, value_name = "FILE")]
    urdf: PathBuf,
    /// Where this URDF has its joints (JSON), if it is not a classic ur_description: robots/ur5e.json
    #[arg(long, value_name = "FILE")]
    frames: Option<PathBuf>,
    /// How far the rows of joint angles before and after a frame may be away, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 0.05, value_parser = seconds)]
    tolerance: f64,
    /// By time, use frames of a moving robot too: for cameras whose `acquired_s` is the exposure's time to the millisecond
    #[arg(long)]
    moving: bool,
    /// A line of JSON a camera
    #[arg(long)]
    json: bool,
    /// ROS's tf2_msgs/TFMessage in YAML
    #[arg(long, conflicts_with = "json")]
    yaml: bool,
    /// A ROS 2 launch file in YAML
    #[arg(long, conflicts_with_all = ["json", "yaml"])]
    launch: bool,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds >= 0.0 && seconds.is_finite() => Ok(seconds),
        _ => Err("expected seconds, 0 or more".to_owned()),
    }
}

/// Runs the command.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let mut robot = Robot::kinematics(&args.urdf)?;
    if let Some(file) = &args.frames {
        let frames = Frames::read(file)?;
        let set = robot.set_frames(&frames).map_err(anyhow::Error::msg);
        set.with_context(|| format!("{} in {}", file.display(), args.urdf.display()))?;
    }
    let angles = Angles::read(&args.angles, &robot)?;
    let cameras = frames::read(&args.lines)?;
    ensure!(
        !cameras.is_empty(),
        "expected lines of frames, found none in {}",
        args.lines
            .iter()
            .map(|l| l.display().to_string())
            .collect::<Vec<_>>()
            .join(", ")
    );
    if let Some([first, second]) = ros::alike(cameras.keys().map(String::as_str)) {
        let frame = ros::optical_frame(second);
        bail!("expected cameras of different frames, found {first} and {second}, both {frame}");
    }
    let mut failed = false;
    let mut reports = Vec::new();
    for (camera, frames) in cameras {
        match calibrate(&camera, &frames, &angles, &robot, args) {
            Ok(report) => reports.push(report),
            Err(error) => {
                failed = true;
                // Nobody is left to tell where stderr is gone too.
                let _ = writeln!(io::stderr(), "{camera}: error: {error:#}");
            }
        }
    }
    for report in &reports {
        for doubt in &report.doubts {
            log::warn!("{}: {doubt}", report.camera);
        }
    }
    let text = if reports.is_empty() {
        String::new()
    } else if args.yaml {
        report::yaml(&reports)
    } else if args.launch {
        report::launch(&reports)
    } else {
        let line = |report: &Report| -> anyhow::Result<String> {
            let line = if args.json {
                serde_json::to_string(report)?
            } else {
                report.text()
            };
            Ok(line + "\n")
        };
        reports
            .iter()
            .map(line)
            .collect::<anyhow::Result<String>>()?
    };
    super::print(&text)?;
    Ok(if failed {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

fn calibrate(
    camera: &str,
    frames: &[Frame],
    angles: &Angles,
    robot: &Robot,
    args: &Args,
) -> anyhow::Result<Report> {
    let matched_by = angles.matches(frames)?;
    let index: HashMap<&str, usize> = robot
        .joints
        .iter()
        .map(|j| j.name.as_str())
        .zip(0..)
        .collect();
    // Of each image the joints as they were found, and in the base frame.
    let mut images: Vec<(Vec<DVec3>, Vec<DVec3>)> = Vec::new();
    // Which joint each of them is.
    let mut joints: Vec<usize> = Vec::new();
    let (mut not_found, mut unmatched, mut moving) = (0, 0, 0);
    let poses = angles.of(frames, matched_by, args.tolerance, args.moving);
    for (frame, pose) in frames.iter().zip(poses) {
        if frame.joints.is_empty() {
            not_found += 1;
            continue;
        }
        let angles = match pose {
            Pose::At(angles) => angles,
            Pose::Moving => {
                moving += 1;
                continue;
            }
            Pose::Unknown => {
                unmatched += 1;
                continue;
            }
        };
        let base = robot.joint_origins(&robot.link_poses(&angles));
        let (mut found, mut known) = (Vec::new(), Vec::new());
        for (name, point) in &frame.joints {
            let joint = index.get(name.strip_suffix("_joint").unwrap_or(name));
            let joint = *joint.with_context(|| {
                let names: Vec<&str> = robot.joints.iter().map(|j| j.name.as_str()).collect();
                let names = names.join(", ");
                format!(
                    "{}: joints: expected those of the URDF ({names}), found {name}",
                    frame.place
                )
            })?;
            if let Some(&place) = base.get(joint) {
                joints.push(joint);
                found.push(*point);
                known.push(place);
            }
        }
        images.push((found, known));
    }
    let used = images.len();
    let mut doubts = Vec::new();
    doubts.extend(links(robot, &images, &joints));
    let pairs = Pair::of_images(images.iter().map(|(found, known)| (&found[..], &known[..])));
    let found = register(&pairs).with_context(|| {
        let by = matched_by.name();
        let mut text = format!(
            "from {used} of {} frames ({not_found} without the robot, {unmatched} without joint angles by {by}, \
             {moving} of a moving robot)",
            frames.len()
        );
        if moving > 0 {
            text += ": let it stand still in each pose for more than a second, or see --moving";
        }
        if let Some([lines, angles]) = angles.apart(frames, matched_by) {
            let span = |[first, last]: [f64; 2]| format!("{first:.1} to {last:.1} s");
            text += &format!(
                ": lines are of {}, angles of {}: not one clock",
                span(lines),
                span(angles)
            );
        }
        text
    })?;
    let poses = pairs.iter().map(|pair| pair.group + 1).max().unwrap_or(0);
    doubts.extend(Doubt::of(&found, poses));
    Ok(Report {
        schema: 1,
        camera: camera.to_owned(),
        frame_id: robot.base_frame().to_owned(),
        child_frame_id: ros::optical_frame(camera),
        translation_m: found.transform.translation.to_array(),
        rotation_xyzw: report::quaternion(&found),
        translation_sigma_m: found.translation_sigma_m(),
        rotation_sigma_deg: found.rotation_sigma_rad().to_degrees(),
        covariance: report::ros_order(found.covariance),
        camera_from_base: report::rows(found.transform.inverse()),
        matched_by,
        frames: frames.len(),
        frames_used: used,
        frames_not_found: not_found,
        frames_unmatched: unmatched,
        frames_moving: moving,
        poses,
        inlier_share: found.inlier_share(),
        residual_scale: found.scale,
        doubts,
        residuals: residuals(robot, &pairs, &joints, &found),
    })
}

/// Whether a link is longer or shorter in the lines than in the URDF: theirs is another arm then.
fn links(robot: &Robot, images: &[(Vec<DVec3>, Vec<DVec3>)], joints: &[usize]) -> Option<Doubt> {
    /// Of shorter ones, errors are as long.
    const LONG_M: f64 = 0.2;
    /// Bodies of one arm differ by a hundredth.
    const SHARE: f64 = 0.15;
    let per_image = images.first()?.0.len();
    let joint = |place: usize| robot.joints.get(*joints.get(place)?);
    (1..per_image).find_map(|place| {
        let lengths = images.iter().filter_map(|(found, known)| {
            let length =
                |points: &[DVec3]| Some(points.get(place)?.distance(*points.get(place - 1)?));
            Some((length(found)?, length(known)?))
        });
        let mut lengths: Vec<(f64, f64)> = lengths.collect();
        lengths.sort_by(|a, b| a.0.total_cmp(&b.0));
        let &(found_m, known_m) = lengths.get(lengths.len() / 2)?;
        let differs = known_m >= LONG_M && (found_m / known_m - 1.0).abs() > SHARE;
        differs.then_some(Doubt::Link {
            from: joint(place - 1)?.name.clone(),
            to: joint(place)?.name.clone(),
            found_m,
            known_m,
        })
    })
}

fn residuals(
    robot: &Robot,
    pairs: &[Pair],
    joints: &[usize],
    found: &Registration,
) -> Vec<Residual> {
    let back = found.transform.inverse();
    let named = robot.joints.iter().enumerate();
    named
        .map(|(index, joint)| {
            let (mut count, mut inliers, mut square, mut along) = (0, 0, 0.0, 0.0);
            let seen = pairs.iter().zip(joints).zip(&found.inliers);
            for ((pair, _), &inlier) in seen.filter(|((_, joint), _)| **joint == index) {
                count += 1;
                if inlier {
                    let residual = pair.from - back.transform_point3(pair.to);
                    inliers += 1;
                    square += residual.length_squared();
                    along += residual.dot(pair.from.normalize_or_zero()).powi(2);
                }
            }
            let rms = |sum: f64| (inliers > 0).then(|| (sum / f64::from(inliers)).sqrt());
            Residual {
                name: joint.name.clone(),
                joints: count,
                inliers: inliers as usize,
                rms_m: rms(square),
                rms_along_m: rms(along),
            }
        })
        .collect()
}
