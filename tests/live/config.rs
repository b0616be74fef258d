//! `cameras.toml`: what it may say, and what it is told otherwise.

use std::path::Path;

use whereabot::camera::Orientation;
use whereabot::live::{Calibration, CameraConfig, Config, KnownModel, Location};

use super::simulated::known;

/// Robots are found by name; files too.
fn find(robot: Option<&str>, weights: Option<&Path>) -> Result<KnownModel, String> {
    match (robot, weights) {
        (_, Some(file)) if !file.exists() => Err(format!("no file {}", file.display())),
        (Some("ur9"), _) => Err("no weights for robot `ur9`".into()),
        (Some("ur10"), _) => Ok(known(1)),
        _ => Ok(known(0)),
    }
}

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    super::sources::folder(&folder.path().join("photos"), 1);
    std::fs::create_dir(folder.path().join("empty")).unwrap();
    std::fs::write(folder.path().join("clip.mp4"), b"").unwrap();
    let info =
        "image_width: 64\nimage_height: 48\ncamera_matrix: {data: [9, 0, 5, 0, 9, 5, 0, 0, 1]}\n";
    std::fs::write(folder.path().join("info.yaml"), info).unwrap();
    folder
}

fn parse(folder: &Path, text: &str) -> Result<Vec<CameraConfig>, String> {
    let config = Config::parse(text, &folder.join("cameras.toml"), &mut find);
    config.map(|c| c.cameras).map_err(|error| error.to_string())
}

#[test]
fn a_file_is_what_it_says() {
    let folder = folder();
    let text = r#"
        [[camera]]
        name = "a"
        source = "photos"
        fps = 2
        repeat = true
        camera_info = "info.yaml"
        orientation = "rotate_90"

        [[camera]]
        name = "b"
        source = "rtsp://10.0.0.1/x"
        robot = "ur10"
        hfov = 90.0

        [[camera]]
        name = "c"
        source = "clip.mp4"
    "#;
    let cameras = parse(folder.path(), text).unwrap();
    let [a, b, c] = cameras.as_slice() else {
        panic!("{cameras:?}");
    };
    assert_eq!(a.location, Location::Folder(folder.path().join("photos")));
    assert_eq!((a.fps, a.repeat, a.robot), (Some(2.0), true, known(0)));
    assert_eq!(a.orientation, Orientation::Rotate90);
    assert!(matches!(a.calibration, Calibration::CameraInfo(camera) if camera.width == 64));
    assert_eq!(b.location, Location::Stream("rtsp://10.0.0.1/x".into()));
    assert_eq!((b.fps, b.repeat, b.robot), (None, false, known(1)));
    assert_eq!(b.calibration, Calibration::Hfov(90_f64.to_radians()));
    assert_eq!(c.location, Location::Video(folder.path().join("clip.mp4")));
    assert_eq!(c.calibration, Calibration::Assumed);
}

#[test]
fn the_example_is_one() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/cameras.toml");
    let config = Config::load(&file, &mut find).unwrap();
    assert_eq!(config.cameras.len(), 1);
    // What is commented out is valid too, but for sources that are not here.
    let text = std::fs::read_to_string(&file).unwrap();
    let uncommented: Vec<&str> = text
        .lines()
        .map(|line| {
            let bare = line.strip_prefix("# ").unwrap_or(line);
            let is_code = bare.starts_with("[[") || bare.contains(" = ");
            if is_code { bare } else { line }
        })
        .filter(|line| !line.contains("door.yaml"))
        .collect();
    let text = uncommented
        .join("\n")
        .replace("\"../recordings/ur5_1\"", "\"images\"")
        .replace("\"clip.mp4\"", "\"http://x/clip\"")
        .replace("source = 0\nfps = 30", "source = \"http://x/0\"");
    let config = Config::parse(&text, &file, &mut find).unwrap();
    assert_eq!(config.cameras.len(), 5);
}

#[test]
fn a_rig_is_cameras_that_see_the_same_robot() {
    let folder = folder();
    let camera = |name: &str| format!("[[camera]]\nname = \"{name}\"\nsource = \"photos\"\n");
    let rig = "[[rig]]\nname = \"cell\"\ncameras = [\"c\", \"a\"]\nmemory_s = 2\n";
    let text = ["a", "b", "c"].map(camera).concat() + rig;
    let config = Config::parse(&text, &folder.path().join("cameras.toml"), &mut find).unwrap();
    let [rig] = config.rigs.as_slice() else {
        panic!("{:?}", config.rigs);
    };
    assert_eq!((rig.name.as_str(), rig.smoothing_s), ("cell", None));
    assert_eq!(rig.cameras, [2, 0]);
    assert_eq!(
        (rig.options.memory_s, rig.options.simultaneous_s),
        (2.0, 0.05)
    );
}

#[test]
fn the_readme_s_file_is_right() {
    let folder = folder();
    let info = std::fs::read(folder.path().join("info.yaml")).unwrap();
    std::fs::write(folder.path().join("door.yaml"), info).unwrap();
    let readme = include_str!("../../README.md");
    let text = readme.split("```toml").nth(1).unwrap();
    let text = text.split("```").next().unwrap();
    // There is no webcam here.
    let text = text.replace("source = 0 ", "source = \"http://x/0\" ");
    let mut find = |_: Option<&str>, _: Option<&Path>| {
        Ok(KnownModel {
            place: 0,
            uncertainty_m: Some(0.1),
        })
    };
    let config = Config::parse(&text, &folder.path().join("cameras.toml"), &mut find).unwrap();
    let counts = [
        config.cameras.len(),
        config.rigs.len(),
        config.warnings.rules.len(),
        config.warnings.actions.len(),
    ];
    assert_eq!(counts, [2, 1, 1, 1]);
}

#[test]
fn what_is_wrong_is_told_with_file_line_and_key() {
    let folder = folder();
    let head = "[[camera]]\nname = \"a\"\nsource = \"photos\"\n";
    let other = "[[camera]]\nname = \"b\"\nsource = \"photos\"\n";
    let rig = "[[rig]]\ncameras = [\"a\", \"b\"]\n";
    // The fault's line, what is said, and the text.
    let cases = [
        (1, "camera: expected at least one", String::new()),
        (4, "unknown field `colour`", format!("{head}colour = 1\n")),
        (
            4,
            "[[cameras]]: unknown field `cameras`",
            format!("{head}[[cameras]]\n"),
        ),
        (
            1,
            "missing field `source`",
            "[[camera]]\nname = \"a\"\n".into(),
        ),
        (
            5,
            "camera.name: expected a name of its own",
            format!("{head}[[camera]]\nname = \"a\"\nsource = \"photos\"\n"),
        ),
        (
            2,
            "camera.name: expected a name",
            "[[camera]]\nname = \" \"\nsource = \"photos\"\n".into(),
        ),
        (
            3,
            "camera.source: expected",
            "[[camera]]\nname = \"a\"\nsource = \"nothing\"\n".into(),
        ),
        (
            3,
            "no images",
            "[[camera]]\nname = \"a\"\nsource = \"empty\"\n".into(),
        ),
        (
            3,
            "/dev/video77",
            "[[camera]]\nname = \"a\"\nsource = 77\n".into(),
        ),
        (
            3,
            "a webcam's number, a path",
            "[[camera]]\nname = \"a\"\nsource = 1.5\n".into(),
        ),
        (
            4,
            "camera.robot: no weights for robot `ur9`",
            format!("{head}robot = \"ur9\"\n"),
        ),
        (
            4,
            "camera.weights: no file",
            format!("{head}weights = \"x.safetensors\"\n"),
        ),
        (
            4,
            "camera.camera_info: ",
            format!("{head}camera_info = \"x.yaml\"\n"),
        ),
        (
            5,
            "camera.hfov: expected camera_info or hfov",
            format!("{head}camera_info = \"info.yaml\"\nhfov = 70\n"),
        ),
        (
            4,
            "camera.hfov: expected degrees",
            format!("{head}hfov = 180\n"),
        ),
        (
            4,
            "camera.fps: expected 0.001 to",
            format!("{head}fps = 0\n"),
        ),
        (
            4,
            "camera.fps: expected 0.001 to",
            format!("{head}fps = nan\n"),
        ),
        (
            4,
            "camera.fps: expected 0.001 to",
            format!("{head}fps = 1e-30\n"),
        ),
        (4, "fps: invalid type", format!("{head}fps = \"x\"\n")),
        (
            4,
            "camera.fps: expected none",
            "[[camera]]\nname = \"a\"\nsource = \"clip.mp4\"\nfps = 3\n".into(),
        ),
        (
            4,
            "camera.repeat: expected none",
            "[[camera]]\nname = \"a\"\nsource = \"http://x\"\nrepeat = true\n".into(),
        ),
        (
            4,
            "unknown variant `left`",
            format!("{head}orientation = \"left\"\n"),
        ),
        (
            6,
            "rig.cameras: expected two cameras",
            format!("{head}[[rig]]\nname = \"r\"\ncameras = [\"a\"]\n"),
        ),
        (
            6,
            "rig.cameras: expected the name of a [[camera]]",
            format!("{head}[[rig]]\nname = \"r\"\ncameras = [\"a\", \"z\"]\n"),
        ),
        (
            6,
            "rig.cameras: expected each camera once",
            format!("{head}[[rig]]\nname = \"r\"\ncameras = [\"a\", \"a\"]\n"),
        ),
        (
            10,
            "rig.cameras: expected cameras of one robot",
            format!(
                "{head}{other}robot = \"ur10\"\n[[rig]]\nname = \"r\"\ncameras = [\"a\", \"b\"]\n"
            ),
        ),
        (
            9,
            "rig.smoothing_s: expected 0 to 3600 seconds",
            format!("{head}{other}{rig}smoothing_s = 0\nname = \"r\"\n"),
        ),
        (
            6,
            "warning.cameras: expected the name of a [[camera]]",
            format!(
                "{head}[[warning]]\nname = \"w\"\ncameras = [\"z\"]\nprotect = \"camera\"\nwarn_m = 1\nstop_m = 0.5\n"
            ),
        ),
        (
            3,
            "",
            "[[camera]]\nname = \"a\"\nsource = \"photos\n".into(),
        ),
    ];
    for (line, said, text) in cases {
        let error = parse(folder.path(), &text).unwrap_err();
        let place = format!("cameras.toml:{line}: ");
        assert!(
            error.contains(&place) && error.contains(said),
            "{text}\n{error}"
        );
    }
    // Negative control.
    parse(folder.path(), head).unwrap();
}
