//! Where model files are.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::network::Model;

/// The robot that is looked for where none is named.
const DEFAULT_ROBOT: &str = "ur5";

/// Loads `file`, or else the model of `robot` from the first place that has one. With both, the file
/// must be a model of that robot.
pub fn load(robot: Option<&str>, file: Option<&Path>) -> anyhow::Result<Model> {
    let file = path(robot, file)?;
    let model = Model::load(&file)?;
    let trained_for = &model.description.robot;
    if let Some(robot) = robot
        && robot != trained_for
    {
        bail!(
            "{}: robot: expected {robot}, found {trained_for}",
            file.display()
        );
    }
    Ok(model)
}

/// `file`, or else where the model of `robot` is.
pub fn path(robot: Option<&str>, file: Option<&Path>) -> anyhow::Result<PathBuf> {
    match file {
        Some(file) => Ok(file.to_owned()),
        None => find(robot.unwrap_or(DEFAULT_ROBOT)),
    }
}

/// A robot's name, which becomes a file's name.
pub fn robot_name(text: &str) -> Result<String, String> {
    let valid = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if !text.is_empty() && text.chars().all(valid) {
        Ok(text.to_owned())
    } else {
        Err("a robot's name has letters, digits, _ and -".to_owned())
    }
}

fn find(robot: &str) -> anyhow::Result<PathBuf> {
    let places: Vec<_> = folders()
        .into_iter()
        .map(|folder| folder.join(format!("{robot}.safetensors")))
        .collect();
    let list = || {
        let lines = places
            .iter()
            .map(|place| format!("\n  {}", place.display()));
        lines.collect::<String>()
    };
    places
        .iter()
        .find(|place| place.is_file())
        .cloned()
        .with_context(|| {
            let there = match robots().as_slice() {
                [] => String::new(),
                robots => format!("; there are weights for {}", robots.join(", ")),
            };
            format!(
                "no weights for robot `{robot}`{there}: give --weights FILE, or name their folder in \
                 WHEREABOT_WEIGHTS; looked for:{}",
                list()
            )
        })
}

/// Those whose model is in one of the folders, in a file of the robot's name.
fn robots() -> Vec<String> {
    let files = folders()
        .into_iter()
        .filter_map(|folder| folder.read_dir().ok());
    let robots: BTreeSet<String> = files
        .flatten()
        .flatten()
        .filter_map(|file| {
            let robot = file
                .file_name()
                .to_str()?
                .strip_suffix(".safetensors")?
                .to_owned();
            let model = Model::load(file.path()).ok()?;
            (model.description.robot == robot).then_some(robot)
        })
        .collect();
    robots.into_iter().collect()
}

fn folders() -> Vec<PathBuf> {
    let mut folders: Vec<PathBuf> = std::env::var_os("WHEREABOT_WEIGHTS")
        .filter(|folder| !folder.is_empty())
        .map(PathBuf::from)
        .into_iter()
        .collect();
    folders.push("weights".into());
    if let Some(beside) = std::env::current_exe()
        .ok()
        .as_deref()
        .and_then(Path::parent)
    {
        // Unpacked, installed beside a `weights` folder, built by cargo, installed under a prefix.
        let relative = [
            "weights",
            "../weights",
            "../../weights",
            "../share/whereabot/weights",
        ];
        folders.extend(relative.map(|place| beside.join(place)));
    }
    folders
}
