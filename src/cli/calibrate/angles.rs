//! The robot's joint angles over time: CSV with a header, or JSON Lines.

use std::collections::{HashMap, HashSet};
use std::f64::consts::{PI, TAU};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use clap::ValueEnum;
use serde::Serialize;
use serde_json::Value;

use super::frames::Frame;
use crate::robot::Robot;

/// A row: a pose of the robot.
struct Row {
    time_s: Option<f64>,
    file: Option<String>,
    /// Radians, in the robot's order.
    angles: Vec<f64>,
}

/// What tells which pose of the robot a frame shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Match {
    /// The time of the frame's acquisition.
    Time,
    /// The image file's name.
    File,
    /// The order of lines.
    Order,
}

impl Match {
    /// As it stands in a sentence.
    pub fn name(self) -> &'static str {
        match self {
            Self::Time => "time",
            Self::File => "file name",
            Self::Order => "order",
        }
    }
}

/// The robot's pose in a frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Pose {
    /// Its joint angles, radians.
    At(Vec<f64>),
    /// It moved, shortly before or then: which of its poses the frame shows depends on how late the camera is.
    Moving,
    /// Nothing says.
    Unknown,
}

/// Poses of the robot.
pub struct Angles {
    rows: Vec<Row>,
}

const TIMES: [&str; 5] = ["time_s", "acquired_s", "timestamp", "time", "t"];
const FILES: [&str; 2] = ["file", "image"];
/// A frame may show what was so long before its time: a camera exposes, encodes, sends and is decoded first.
const LATENCY_S: f64 = 1.0;
/// A joint that turns no more in that time, radians, stands still.
const STILL_RAD: f64 = 0.01;

impl Angles {
    /// Reads the angles of `robot`'s joints. A file whose first character is `{` is JSON Lines.
    pub fn read(path: &Path, robot: &Robot) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        let rows = if text.trim_start().starts_with('{') {
            lines(path, &text, robot)
        } else {
            table(path, &text, robot)
        }?;
        ensure!(
            !rows.is_empty(),
            "{}: expected joint angles, found none",
            path.display()
        );
        Ok(Self { rows })
    }

    /// What frames and rows have in common, the surest first.
    pub fn matches(&self, frames: &[Frame]) -> anyhow::Result<Match> {
        let rows = |has: fn(&Row) -> bool| self.rows.iter().all(has);
        if rows(|row| row.time_s.is_some()) && frames.iter().all(|frame| frame.time_s.is_some()) {
            return Ok(Match::Time);
        }
        if rows(|row| row.file.is_some()) && frames.iter().all(|frame| frame.file.is_some()) {
            let mut seen = HashSet::new();
            let names = self
                .rows
                .iter()
                .filter_map(|row| name(row.file.as_deref()?));
            if let Some(twice) = names.into_iter().find(|name| !seen.insert(name.clone())) {
                bail!("expected joint angles of each file once, found {twice} twice");
            }
            return Ok(Match::File);
        }
        ensure!(
            frames.len() == self.rows.len(),
            "without times or file names in both, expected a line of joint angles a frame, found {} for {} frames",
            self.rows.len(),
            frames.len()
        );
        Ok(Match::Order)
    }

    /// Each frame's pose. `moving`: by time also where the robot moved.
    pub fn of(&self, frames: &[Frame], by: Match, tolerance_s: f64, moving: bool) -> Vec<Pose> {
        let pose = |angles: Option<Vec<f64>>| angles.map_or(Pose::Unknown, Pose::At);
        match by {
            Match::Order => {
                let rows = self.rows.iter();
                rows.map(|row| Pose::At(row.angles.clone())).collect()
            }
            Match::File => {
                let rows = self.rows.iter();
                let rows: HashMap<_, _> = rows
                    .filter_map(|row| Some((name(row.file.as_deref()?)?, &row.angles)))
                    .collect();
                let of = |frame: &Frame| rows.get(&name(frame.file.as_deref()?)?).copied().cloned();
                frames.iter().map(|frame| pose(of(frame))).collect()
            }
            Match::Time => {
                let mut rows: Vec<(f64, &[f64])> = self
                    .rows
                    .iter()
                    .filter_map(|row| Some((row.time_s?, row.angles.as_slice())))
                    .collect();
                rows.sort_by(|a, b| a.0.total_cmp(&b.0));
                let of = |frame: &Frame| {
                    let time = frame.time_s?;
                    let angles = at(&rows, time, tolerance_s)?;
                    Some(if moving || is_still(&rows, time, &angles) {
                        Pose::At(angles)
                    } else {
                        Pose::Moving
                    })
                };
                let frames = frames.iter();
                frames.map(|f| of(f).unwrap_or(Pose::Unknown)).collect()
            }
        }
    }

    /// The first and the last time of the frames and of the rows, where no frame is between rows.
    pub fn apart(&self, frames: &[Frame], by: Match) -> Option<[[f64; 2]; 2]> {
        if by != Match::Time {
            return None;
        }
        let span = |times: &mut dyn Iterator<Item = f64>| {
            times.fold([f64::INFINITY, f64::NEG_INFINITY], |[first, last], time| {
                [first.min(time), last.max(time)]
            })
        };
        let lines = span(&mut frames.iter().filter_map(|frame| frame.time_s));
        let rows = span(&mut self.rows.iter().filter_map(|row| row.time_s));
        (lines[1] < rows[0] || rows[1] < lines[0]).then_some([lines, rows])
    }
}

/// A file's name without its folders.
fn name(file: &str) -> Option<String> {
    let name = Path::new(file).file_name();
    name.map(|name| name.to_string_lossy().into_owned())
}

/// Angles at a time, between the rows before and after, both of which are near it. A joint turns the short way.
fn at(rows: &[(f64, &[f64])], time: f64, tolerance: f64) -> Option<Vec<f64>> {
    let after = rows.partition_point(|(then, _)| *then < time);
    let (next, to) = *rows.get(after)?;
    if next == time {
        return Some(to.to_vec());
    }
    let (last, from) = *rows.get(after.checked_sub(1)?)?;
    if next - time > tolerance || time - last > tolerance {
        return None;
    }
    let part = (time - last) / (next - last);
    let between = |(&from, &to): (&f64, &f64)| from + part * turn(from, to);
    Some(from.iter().zip(to).map(between).collect())
}

/// From one angle to another the short way, radians.
fn turn(from: f64, to: f64) -> f64 {
    (to - from + PI).rem_euclid(TAU) - PI
}

/// Whether the robot was at `angles` all the time before `time` in which the frame may have been taken.
fn is_still(rows: &[(f64, &[f64])], time: f64, angles: &[f64]) -> bool {
    let first = rows.partition_point(|(then, _)| *then < time - LATENCY_S);
    let before = rows.iter().skip(first);
    let mut before = before.take_while(|(then, _)| *then <= time);
    before.all(|(_, then)| {
        let mut joints = then.iter().zip(angles);
        joints.all(|(&then, &now)| turn(then, now).abs() <= STILL_RAD)
    })
}

fn table(path: &Path, text: &str, robot: &Robot) -> anyhow::Result<Vec<Row>> {
    let first = text.lines().next().unwrap_or_default();
    // What controllers write: Universal Robots' RTDE example has blanks.
    let delimiter = [b',', b';', b'\t'];
    let delimiter = delimiter.into_iter().find(|d| first.as_bytes().contains(d));
    let mut reader = csv::ReaderBuilder::new()
        .delimiter(delimiter.unwrap_or(b' '))
        .trim(csv::Trim::All)
        .from_reader(text.as_bytes());
    let named = |line: u64| format!("{}:{line}", path.display());
    let header: Vec<String> = reader
        .headers()
        .with_context(|| named(1))?
        .iter()
        .map(str::to_owned)
        .collect();
    let column = |names: &[&str]| {
        let mut names = names.iter();
        names.find_map(|name| header.iter().position(|found| found == name))
    };
    let (time, file) = (column(&TIMES), column(&FILES));
    let mut joints = Vec::new();
    for (index, joint) in robot.joints.iter().enumerate() {
        let names = [
            joint.name.clone(),
            format!("{}_joint", joint.name),
            format!("actual_q_{index}"),
        ];
        let found = column(&names.each_ref().map(String::as_str));
        joints.push(found.with_context(|| {
            let (at, found) = (named(1), header.join(", "));
            format!(
                "{at}: expected a column {} (or {}, {}), found {found}",
                names[0], names[1], names[2]
            )
        })?);
    }
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|error| {
            let line = error.position().map_or(1, csv::Position::line);
            anyhow::Error::new(error).context(named(line))
        })?;
        let place = || named(record.position().map_or(1, csv::Position::line));
        let cell = |column: usize| record.get(column).unwrap_or_default();
        let number = |column: usize| -> anyhow::Result<f64> {
            let text = cell(column);
            text.parse()
                .ok()
                .filter(|v: &f64| v.is_finite())
                .with_context(|| {
                    let name = header.get(column).map_or("", String::as_str);
                    format!("{}: {name}: expected a number, found {text:?}", place())
                })
        };
        let angles = joints.iter().map(|&column| number(column));
        let angles = angles.collect::<anyhow::Result<Vec<f64>>>()?;
        check(&angles, robot).with_context(place)?;
        rows.push(Row {
            time_s: time.map(number).transpose()?,
            file: file.map(|column| cell(column).to_owned()),
            angles,
        });
    }
    Ok(rows)
}

fn lines(path: &Path, text: &str, robot: &Robot) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        if line.trim().is_empty() {
            continue;
        }
        let place = || format!("{}:{number}", path.display());
        let value: Value = serde_json::from_str(line).with_context(place)?;
        // A sample of a recording that shows no robot.
        if value.get("coverage").is_some() && value.get("joint_angles_rad").is_none() {
            continue;
        }
        let row = row(&value, robot).with_context(place)?;
        check(&row.angles, robot).with_context(place)?;
        rows.push(row);
    }
    Ok(rows)
}

/// A line of JSON: `joint_angles_rad` as recordings have it, ROS's `JointState`, or a key a joint.
fn row(value: &Value, robot: &Robot) -> anyhow::Result<Row> {
    let key = |keys: &[&str]| keys.iter().find_map(|key| value.get(*key));
    let list = |key: &str| value.get(key).and_then(Value::as_array);
    let stamp = value.pointer("/header/stamp").and_then(|stamp| {
        let part = |key: &str| stamp.get(key).and_then(Value::as_f64);
        Some(part("sec")? + 1e-9 * part("nanosec")?)
    });
    let names = list("name");
    let angle = |(index, joint): (usize, &crate::robot::Joint)| {
        let full = format!("{}_joint", joint.name);
        let found = if let Some(angles) = list("joint_angles_rad") {
            angles.get(index)
        } else if let (Some(names), Some(angles)) = (names, list("position")) {
            let own = |name: &Value| name == joint.name.as_str() || name == full.as_str();
            names.iter().position(own).and_then(|at| angles.get(at))
        } else {
            key(&[&joint.name, &full])
        };
        found.and_then(Value::as_f64).with_context(|| {
            let known = "joint_angles_rad, name and position, or a key a joint";
            format!("{}: expected its angle ({known}), found none", joint.name)
        })
    };
    let angles = robot.joints.iter().enumerate().map(angle);
    Ok(Row {
        time_s: key(&TIMES).and_then(Value::as_f64).or(stamp),
        file: key(&FILES).and_then(Value::as_str).map(str::to_owned),
        angles: angles.collect::<anyhow::Result<_>>()?,
    })
}

/// Degrees are the usual mistake.
fn check(angles: &[f64], robot: &Robot) -> anyhow::Result<()> {
    for (angle, joint) in angles.iter().zip(&robot.joints) {
        let [lower, upper] = joint.range;
        let (lower, upper) = (lower.min(-TAU) - 0.1, upper.max(TAU) + 0.1);
        if !(lower..=upper).contains(angle) {
            bail!(
                "{}: expected radians, {lower:.2} to {upper:.2}, found {angle}",
                joint.name
            );
        }
    }
    Ok(())
}
