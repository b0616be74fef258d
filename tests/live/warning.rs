//! Warnings: distances, the judging of them, the configuration, and what is done, against servers on loopback.
#![cfg(feature = "live")]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use image::RgbaImage;
use proptest::prelude::*;
use serde_json::{Value, json};
use whereabot::camera::Camera;
use whereabot::cascade::{Estimate, Joint, Status};
use whereabot::live::warning::{
    ActionReport, Config, Judge, Level, Limits, Monitor, Observer, Pose, State, Told, Warning,
    Warnings, Why, Zone, distance, uncertainty_m,
};
use whereabot::live::{Event, EventKind, Observation, Sink};
use whereabot::network::Description;

const SECOND: Duration = Duration::from_secs(1);

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

// Distances.

/// The shortest distance by looking at many points of each segment, and at how far each is out of the box.
fn sampled(joints: &[[f64; 3]], [min, max]: [[f64; 3]; 2]) -> f64 {
    const STEPS: u32 = 2000;
    let mut nearest = f64::INFINITY;
    for pair in joints.windows(2) {
        for step in 0..=STEPS {
            let along = f64::from(step) / f64::from(STEPS);
            let mut square = 0.0;
            for axis in 0..3 {
                let at = pair[0][axis] * (1.0 - along) + pair[1][axis] * along;
                square += (min[axis] - at).max(at - max[axis]).max(0.0).powi(2);
            }
            nearest = nearest.min(square.sqrt());
        }
    }
    nearest
}

fn point() -> impl Strategy<Value = [f64; 3]> {
    prop::array::uniform3(-3.0..3.0)
}

proptest! {
    #![proptest_config(cases(64))]

    #[test]
    fn distances_are_those_of_many_points(
        joints in prop::collection::vec(point(), 2..7),
        corner in point(),
        size in prop::array::uniform3(0.0..1.0),
    ) {
        let far = [0, 1, 2].map(|axis| corner[axis] + size[axis]);
        let zone = Zone::new(corner, far).unwrap();
        let found = distance(&joints, &[zone]).unwrap();
        let expected = sampled(&joints, [corner, far]);
        // Steps are up to 6 sqrt(3) / 2000 m long, and the nearest is at most half of one away.
        prop_assert!(found <= expected + 1e-12 && expected - found < 0.003, "{found} {expected}");
    }
}

#[test]
fn a_link_is_nearer_than_its_joints() {
    let joints = [[-1.0, 0.5, 0.0], [1.0, 0.5, 0.0]];
    assert!((distance(&joints, &[Zone::ORIGIN]).unwrap() - 0.5).abs() < 1e-12);
    // Each joint alone is farther.
    for joint in joints {
        assert!(distance(&[joint], &[Zone::ORIGIN]).unwrap() > 1.1);
    }
    let zone = Zone::new([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]).unwrap();
    assert!((distance(&joints, &[zone]).unwrap() - 0.4).abs() < 1e-12);
    // Through the box.
    assert_eq!(
        distance(&[[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]], &[zone]),
        Some(0.0)
    );
    assert_eq!(distance(&[], &[zone]), None);
    assert_eq!(distance(&joints, &[]), None);
    assert_eq!(distance(&[[0.0, f64::NAN, 0.0], [1.0; 3]], &[zone]), None);
}

#[test]
fn poses_go_from_the_optical_frame_to_the_common_one() {
    // A camera that looks along the common x axis: z forward is x, x right is -y, y down is -z.
    let pose = Pose::new([1.0, 2.0, 3.0], [-0.5, 0.5, -0.5, 0.5]).unwrap();
    let found = pose.world_from_camera([0.1, 0.2, 4.0]);
    for (found, expected) in found.into_iter().zip([5.0, 1.9, 2.8]) {
        assert!((found - expected).abs() < 1e-12, "{found} {expected}");
    }
    assert!(Pose::new([0.0; 3], [0.0, 0.0, 90.0, 0.0]).is_err());
    assert!(Pose::new([f64::NAN, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).is_err());
    assert!(Pose::new([0.0; 3], [f64::NAN, 0.0, 0.0, 1.0]).is_err());
}

// Judging.

const LIMITS: Limits = Limits {
    warn_m: 2.0,
    stop_m: 1.0,
    hysteresis_m: 0.25,
    agree: 2,
    max_age: SECOND,
};

/// What a judge says after each frame: one each 100 ms, answered 50 ms later.
fn judged(limits: Limits, frames: &[Result<f64, Why>]) -> Vec<Result<Level, Why>> {
    let start = Instant::now();
    let mut judge = Judge::new(limits);
    let mut at = start;
    let mut say = |frame: &Result<f64, Why>| {
        at += ms(100);
        judge.frame(at, *frame, at + ms(50));
        judge.judged()
    };
    frames.iter().map(&mut say).collect()
}

#[test]
fn frames_must_agree() {
    use Level::{Clear, Stop, Warn};
    const NONE: Result<f64, Why> = Err(Why::NotFound);
    let starting = Err(Why::Starting);
    let check = |frames: &[Result<f64, Why>], expected: &[Result<Level, Why>]| {
        assert_eq!(judged(LIMITS, frames), expected, "{frames:?}");
    };
    check(
        &[Ok(3.0), Ok(3.0), Ok(0.5), Ok(3.0), Ok(0.5), Ok(0.5)],
        &[
            starting,
            Ok(Clear),
            Ok(Clear),
            Ok(Clear),
            Ok(Clear),
            Ok(Stop),
        ],
    );
    // Two that disagree how dangerous it is agree on the lesser.
    check(
        &[Ok(3.0), Ok(3.0), Ok(1.5), Ok(0.5), Ok(0.5)],
        &[starting, Ok(Clear), Ok(Clear), Ok(Warn), Ok(Stop)],
    );
    // Less dangerous: both beyond the hysteresis, and no less dangerous than either.
    check(
        &[
            Ok(0.5),
            Ok(0.5),
            Ok(1.1),
            Ok(1.3),
            Ok(3.0),
            Ok(2.1),
            Ok(2.3),
            Ok(2.3),
        ],
        &[
            starting,
            Ok(Stop),
            Ok(Stop),
            Ok(Stop),
            Ok(Warn),
            Ok(Warn),
            Ok(Warn),
            Ok(Clear),
        ],
    );
    // Unusable frames in between take nothing back, and agree with nothing.
    check(
        &[
            Ok(3.0),
            Ok(3.0),
            Ok(0.5),
            NONE,
            Ok(0.5),
            NONE,
            NONE,
            Ok(3.0),
            NONE,
            Ok(3.0),
        ],
        &[
            starting,
            Ok(Clear),
            Ok(Clear),
            Ok(Clear),
            Ok(Stop),
            Ok(Stop),
            Err(Why::NotFound),
            Err(Why::NotFound),
            Err(Why::NotFound),
            Ok(Clear),
        ],
    );
    // One frame is enough where the user says so.
    assert_eq!(
        judged(
            Limits { agree: 1, ..LIMITS },
            &[Ok(3.0), NONE, Ok(0.5), Ok(f64::NAN)]
        ),
        [Ok(Clear), Err(Why::NotFound), Ok(Stop), Err(Why::Invalid)],
    );
}

#[test]
fn what_is_known_does_not_last() {
    let start = Instant::now();
    let clear = || {
        let mut judge = Judge::new(LIMITS);
        judge.frame(start, Ok(3.0), start);
        judge.frame(start + ms(100), Ok(3.0), start + ms(150));
        assert_eq!(judge.judged(), Ok(Level::Clear));
        judge
    };
    // By time alone, counted from the last frame's acquisition.
    let mut judge = clear();
    judge.tick(start + ms(1100));
    assert_eq!(judge.judged(), Ok(Level::Clear));
    judge.tick(start + ms(1101));
    assert_eq!(judge.judged(), Err(Why::NoAnswer));
    assert_eq!(judge.distance_m(), None);
    // By answers that come too late, at once.
    let mut judge = clear();
    judge.frame(start + ms(200), Ok(3.0), start + ms(1201));
    assert_eq!(judge.judged(), Err(Why::Late));
    // A lost camera: at once, and what was on its way does not count.
    let mut judge = clear();
    judge.lost(Why::Stale, start + ms(300));
    for taken in [200, 250, 299] {
        judge.frame(start + ms(taken), Ok(3.0), start + ms(310));
        assert_eq!(judge.judged(), Err(Why::Stale));
    }
    // What is taken later does.
    judge.frame(start + ms(300), Ok(3.0), start + ms(320));
    judge.frame(start + ms(310), Ok(3.0), start + ms(330));
    assert_eq!(judge.judged(), Ok(Level::Clear));
}

/// A frame: `None` is unusable. The milliseconds before it was taken, and until it was answered.
type Timed = (Option<f64>, u64, u64);

fn timed() -> impl Strategy<Value = Vec<Timed>> {
    let frame = (
        prop::option::weighted(0.8, 0.0..4.0),
        1..400_u64,
        0..700_u64,
    );
    prop::collection::vec(frame, 1..60)
}

fn limits() -> impl Strategy<Value = Limits> {
    (0.1..1.5, 0.1..1.5, 0.0..0.5, 1..5_usize).prop_map(|(stop_m, more, hysteresis_m, agree)| {
        Limits {
            warn_m: stop_m + more,
            stop_m,
            hysteresis_m,
            agree,
            max_age: ms(500),
        }
    })
}

/// How many frames broke the rule that clear is known: a young usable frame, not `agree` unusable ones since, and
/// `agree` usable ones, none of them within `warn_m`... by the judge that is given `limits` with `agree` replaced.
fn unknown_but_clear(limits: Limits, judge_agree: usize, frames: &[Timed]) -> usize {
    let start = Instant::now();
    let mut judge = Judge::new(Limits {
        agree: judge_agree,
        ..limits
    });
    let (mut taken, mut now) = (start, start);
    let (mut last, mut unusable) = (None, 0);
    let mut broken = 0;
    for &(distance_m, before, until) in frames {
        taken += ms(before);
        now = now.max(taken + ms(until));
        let late = now - taken > limits.max_age;
        judge.frame(taken, distance_m.ok_or(Why::NotFound), now);
        if distance_m.is_some() && !late {
            (last, unusable) = (Some(taken), 0);
        } else {
            unusable += 1;
        }
        let old = last.is_none_or(|last| now - last > limits.max_age);
        let unknown = old || late || unusable >= limits.agree;
        broken += usize::from(unknown && judge.judged() == Ok(Level::Clear));
        // Nor later, when nothing more comes.
        let mut later = judge.clone();
        later.tick(taken + limits.max_age + ms(1));
        broken += usize::from(later.judged().is_ok());
    }
    broken
}

proptest! {
    #![proptest_config(cases(256))]

    #[test]
    fn unknown_is_never_clear(limits in limits(), frames in timed()) {
        prop_assert_eq!(unknown_but_clear(limits, limits.agree, &frames), 0);
    }

    #[test]
    fn nearer_is_never_less_dangerous(
        limits in limits(),
        frames in prop::collection::vec((prop::option::weighted(0.9, 0.0..4.0), 0.0..2.0), 1..60),
    ) {
        let at = |nearer: f64| -> Vec<Result<f64, Why>> {
            let frame = |&(d, less): &(Option<f64>, f64)| d.map(|d| d - nearer * less).ok_or(Why::NotFound);
            frames.iter().map(frame).collect()
        };
        for (far, near) in judged(limits, &at(0.0)).into_iter().zip(judged(limits, &at(1.0))) {
            prop_assert_eq!(far.is_ok(), near.is_ok());
            prop_assert!(far.is_err() || far.ok() <= near.ok(), "{far:?} {near:?}");
        }
    }

    #[test]
    fn nothing_flaps_within_the_hysteresis(
        limits in limits(),
        stop in any::<bool>(),
        shares in prop::collection::vec(0.001..1.0, 1..60),
    ) {
        let limit = if stop { limits.stop_m } else { limits.warn_m };
        let frames: Vec<_> = shares.iter().map(|share| Ok(limit + share * limits.hysteresis_m)).collect();
        let said = judged(limits, &frames);
        let known: Vec<_> = said.into_iter().flatten().collect();
        // Never beyond the limit; the other limit's hysteresis may end, once.
        let least = if stop { Level::Stop } else { Level::Warn };
        prop_assert!(known.iter().all(|&level| level >= least), "{known:?}");
        prop_assert!(known.is_sorted_by(|before, after| before >= after), "{known:?}");
    }

    #[test]
    fn danger_needs_agreement(limits in limits(), frames in timed()) {
        let frames: Vec<_> = frames.iter().map(|frame| frame.0.ok_or(Why::NotFound)).collect();
        let said = judged(limits, &frames);
        for (index, pair) in said.windows(2).enumerate() {
            if let [Ok(before), Ok(after)] = pair && after > before {
                let limit = if *after == Level::Stop { limits.stop_m } else { limits.warn_m };
                let within = frames[..=index + 1].iter().rev().flatten().take_while(|&&d| d <= limit);
                prop_assert!(within.count() >= limits.agree);
            }
        }
    }
}

#[test]
fn the_properties_can_fail() {
    // A judge that waits for one frame more stays clear for one frame too long.
    let frames: Vec<Timed> = [Some(3.0), Some(3.0), Some(3.0), None, None]
        .map(|distance_m| (distance_m, 10, 0))
        .to_vec();
    let limits = Limits {
        max_age: ms(500),
        ..LIMITS
    };
    assert_eq!(unknown_but_clear(limits, 2, &frames), 0);
    assert_eq!(unknown_but_clear(limits, 3, &frames), 1);
    // Without hysteresis, what lies about a limit flaps; with it, not.
    let frames = [0.9, 0.9, 1.1, 1.1, 0.9, 0.9, 1.1, 1.1].map(Ok);
    let count = |hysteresis_m: f64| {
        let mut said = judged(
            Limits {
                hysteresis_m,
                ..LIMITS
            },
            &frames,
        );
        said.dedup();
        said.len() - 1
    };
    assert_eq!((count(0.0), count(0.25)), (4, 1));
}

// Rules.

fn observer(name: &str) -> Observer {
    Observer {
        name: name.into(),
        world_from_camera: None,
        uncertainty_m: Some(0.1),
    }
}

fn config(text: &str) -> Config {
    toml::from_str(text).unwrap()
}

const RULE: &str = r#"
[[warning]]
name = "near"
cameras = ["a"]
protect = "camera"
warn_m = 2.0
stop_m = 1
"#;

/// An arm along x at this distance in front of the camera.
fn found(distance_m: f64) -> Estimate {
    let joint = |index: u32| Joint {
        name: format!("joint_{index}"),
        xyz_m: [f64::from(index) * 0.2 - 0.5, 0.0, distance_m],
        px: [0.0, 0.0],
    };
    Estimate {
        status: Status::Found,
        coverage: 0.1,
        bbox_px: None,
        field: 1.0,
        joints: (0..6).map(joint).collect(),
        mask: None,
    }
}

fn nothing(status: Status) -> Estimate {
    Estimate {
        status,
        joints: Vec::new(),
        ..found(1.0)
    }
}

/// A monitor and its clock.
struct Clocked {
    monitor: Monitor,
    now: Instant,
    frame: u64,
}

impl Clocked {
    fn new(text: &str, cameras: &[Observer]) -> Self {
        let mut clocked = Self {
            monitor: Monitor::new(&config(text), cameras).unwrap(),
            now: Instant::now(),
            frame: 0,
        };
        let told = clocked.monitor.tick(clocked.now);
        for (_, warning) in &told {
            assert_eq!(warning.state, State::Unknown);
            assert_eq!((warning.why, warning.before), (Some(Why::Starting), None));
        }
        assert_eq!(told.len(), 1);
        clocked
    }

    /// Two frames of each of these cameras, 10 ms apart, answered 30 ms after they were taken. The last change.
    fn frames(&mut self, estimates: &[(usize, Estimate)]) -> Option<Told> {
        let mut last = None;
        for _ in 0..2 {
            self.now += ms(10);
            for (camera, estimate) in estimates {
                let told =
                    self.monitor
                        .frame(*camera, self.frame, self.now, estimate, self.now + ms(30));
                last = told.into_iter().last().or(last);
            }
            self.frame += 1;
        }
        self.now += ms(30);
        last
    }
}

#[test]
fn a_rule_tells_what_it_knows_and_how_late() {
    let mut clocked = Clocked::new(RULE, &[observer("a")]);
    let (camera, warning) = clocked.frames(&[(0, found(2.5))]).unwrap();
    assert_eq!(camera, Some(0));
    assert_eq!(
        warning,
        Warning {
            rule: "near".into(),
            state: State::Clear,
            before: Some(State::Unknown),
            acts_as: State::Clear,
            acted_as: Some(State::Warn),
            distance_m: Some(2.5),
            uncertainty_m: Some(0.1),
            why: None,
            frame_number: Some(1),
            latency_ms: Some(30.0),
        }
    );
    // No change, no word.
    assert_eq!(clocked.frames(&[(0, found(2.5))]), None);
    // 1.05 m are no stop, but 0.95 m may be: the card's uncertainty counts.
    let (_, warning) = clocked.frames(&[(0, found(1.05))]).unwrap();
    assert_eq!((warning.state, warning.acts_as), (State::Stop, State::Stop));
    let exact = Observer {
        uncertainty_m: Some(0.0),
        ..observer("a")
    };
    let mut control = Clocked::new(RULE, &[exact]);
    control.frames(&[(0, found(2.5))]).unwrap();
    let (_, warning) = control.frames(&[(0, found(1.05))]).unwrap();
    assert_eq!(warning.state, State::Warn);

    for (estimate, why) in [
        (nothing(Status::NotFound), Why::NotFound),
        (nothing(Status::Invalid), Why::Invalid),
        // A mask without joints.
        (nothing(Status::Found), Why::Invalid),
    ] {
        assert!(clocked.frames(&[(0, found(3.0))]).is_some());
        let (_, warning) = clocked.frames(&[(0, estimate)]).unwrap();
        assert_eq!((warning.state, warning.why), (State::Unknown, Some(why)));
        assert_eq!((warning.distance_m, warning.acts_as), (None, State::Warn));
    }
    clocked.frames(&[(0, found(3.0))]).unwrap();
    clocked.now += SECOND;
    let told = clocked.monitor.tick(clocked.now);
    assert_eq!(told.len(), 1);
    assert_eq!(told[0].1.why, Some(Why::NoAnswer));
    assert_eq!(told[0].1.latency_ms, None);
}

#[test]
fn what_happens_to_a_camera_makes_its_rules_unknown() {
    let two = format!(
        "{RULE}\n{}",
        RULE.replace("near", "other").replace("\"a\"", "\"b\"")
    );
    let lost = |camera, kind: EventKind| {
        let cameras = [observer("a"), observer("b")];
        let mut monitor = Monitor::new(&config(&two), &cameras).unwrap();
        let now = Instant::now();
        assert_eq!(monitor.tick(now).len(), 2);
        for frame in 0..2 {
            for camera in 0..2 {
                monitor.frame(camera, frame, now, &found(3.0), now);
            }
        }
        monitor
            .event(camera, &kind, now)
            .into_iter()
            .map(|(camera, warning)| (camera, warning.why))
            .collect::<Vec<_>>()
    };
    let failed = EventKind::Failed {
        reason: "gone".into(),
        retry_in: None,
    };
    assert_eq!(
        lost(Some(1), EventKind::Stale),
        [(Some(1), Some(Why::Stale))]
    );
    assert_eq!(lost(Some(0), failed), [(Some(0), Some(Why::Failed))]);
    assert_eq!(
        lost(Some(0), EventKind::Ended),
        [(Some(0), Some(Why::Ended))]
    );
    let why = Some(Why::DeviceLost);
    let reason = String::from("unplugged");
    assert_eq!(
        lost(None, EventKind::DeviceLost { reason }),
        [(Some(0), why), (Some(1), why)]
    );
    assert_eq!(lost(Some(0), EventKind::Live), []);
    assert_eq!(lost(None, EventKind::DeviceBack), []);
}

#[test]
fn of_several_cameras_the_worst_counts() {
    use State::{Clear, Stop, Unknown, Warn};
    let state = |expect: &str, unknown: &str, [a, b]: [Option<f64>; 2]| {
        let text = RULE.replace("[\"a\"]", "[\"b\", \"a\"]");
        let text = format!("{text}expect = \"{expect}\"\nunknown = \"{unknown}\"\n");
        let mut clocked = Clocked::new(&text, &[observer("a"), observer("b")]);
        let estimate = |d: Option<f64>| d.map_or_else(|| nothing(Status::NotFound), found);
        clocked
            .frames(&[(0, estimate(a)), (1, estimate(b))])
            .map_or(Unknown, |(_, warning)| warning.state)
    };
    let (far, near, nearest) = (Some(3.0), Some(1.5), Some(0.5));
    for unknown in ["ignore", "warn", "stop"] {
        assert_eq!(state("all", unknown, [far, far]), Clear);
        assert_eq!(state("all", unknown, [far, near]), Warn);
        assert_eq!(state("all", unknown, [nearest, near]), Stop);
        // Whatever unknown counts as, it is not clear, and less than a stop.
        assert_eq!(state("all", unknown, [far, None]), Unknown);
        assert_eq!(state("all", unknown, [None, nearest]), Stop);
        // Cameras that stand in for each other.
        assert_eq!(state("any", unknown, [far, None]), Clear);
        assert_eq!(state("any", unknown, [None, near]), Warn);
        assert_eq!(state("any", unknown, [None, None]), Unknown);
    }
    assert_eq!(state("all", "ignore", [near, None]), Warn);
    assert_eq!(state("all", "warn", [near, None]), Warn);
    assert_eq!(state("all", "stop", [near, None]), Unknown);
}

#[test]
fn places_are_in_the_common_frame() {
    // The camera hangs 3 m above the origin and looks down: the arm, 1 m before it, is 2 m up.
    let pose = Pose::new([0.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0]).unwrap();
    let camera = Observer {
        world_from_camera: Some(pose),
        ..observer("a")
    };
    let measured = |protect: &str| {
        let text = RULE.replace("\"camera\"", protect);
        let mut clocked = Clocked::new(&text, std::slice::from_ref(&camera));
        let (_, warning) = clocked.frames(&[(0, found(1.0))]).unwrap();
        (warning.distance_m.unwrap() * 1e9).round() / 1e9
    };
    assert_eq!(measured("{ points_m = [[0, 0, 0]] }"), 2.0);
    assert_eq!(measured("{ points_m = [[0, 0, 9.0], [0, 0, 0.5]] }"), 1.5);
    assert_eq!(
        measured(
            "{ points_m = [[0, 0, 0]], boxes_m = [{ min = [-1, -1, 0], max = [1, 1, 1.25] }] }"
        ),
        0.75
    );
    // Who wears the camera is where it is, wherever that is.
    assert_eq!(measured("\"camera\""), 1.0);
}

#[test]
fn the_card_says_how_far_off_joints_are() {
    let of = |card: Value| {
        let layers = json!({"layers": []});
        let description = json!({
            "version": 1, "family": "paper", "robot": "ur5", "joints": ["elbow"],
            "input": {"width": 16, "height": 12}, "camera": {"fx": 8.0, "fy": 8.0, "cx": 7.5, "cy": 5.5},
            "mask_network": layers, "overlay": {"rule": "multiply"}, "joint_network": layers,
            "presence": {"mask_threshold": 0.5, "sure_threshold": 0.7, "min_sure": 0.01},
            "card": card,
        });
        uncertainty_m(&serde_json::from_value::<Description>(description).unwrap())
    };
    let stated = of(json!({"figures": {"estimated_mask_mean_cm": 13.63}})).unwrap();
    assert!((stated - 0.1363).abs() < 1e-12);
    assert_eq!(of(json!({})), None);
    assert_eq!(of(json!({"figures": {"estimated_mask_mean_cm": -1}})), None);
}

// The configuration.

/// Where the configuration is wrong, and what is said.
fn error(text: &str) -> (String, String) {
    let pose = Pose::new([0.0; 3], [0.0, 0.0, 0.0, 1.0]).unwrap();
    let cameras = [
        observer("a"),
        Observer {
            world_from_camera: Some(pose),
            ..observer("posed")
        },
        Observer {
            uncertainty_m: None,
            ..observer("own weights")
        },
    ];
    let at = |span: Range<usize>| text[span].to_owned();
    match toml::from_str::<Config>(text) {
        Ok(config) => {
            let error = config.check(&cameras).unwrap_err();
            (at(error.span.clone()), error.to_string())
        }
        Err(error) => (at(error.span().unwrap()), error.message().to_owned()),
    }
}

#[test]
fn errors_say_where_and_what() {
    let mut wrong = Vec::new();
    let mut check = |text: String, place: &str, message: &str| {
        let (found_place, found_message) = error(&text);
        if found_place != place || !found_message.contains(message) {
            wrong.push(format!(
                "{found_place}: {found_message}, not {place}: {message}"
            ));
        }
    };
    let rule = |from: &str, to: &str| {
        assert!(RULE.contains(from), "{from}");
        RULE.replace(from, to)
    };
    let stop = |to| rule("stop_m = 1", &format!("stop_m = {to}"));
    check(
        stop("-1"),
        "-1",
        "warning.stop_m: expected metres greater than 0, found -1",
    );
    check(stop("nan"), "nan", "found NaN");
    check(
        stop("2"),
        "2",
        "warning.stop_m: expected less than warn_m, which is 2, found 2",
    );
    check(
        stop("1\nagree = 0"),
        "0",
        "warning.agree: expected 1 to 100, found 0",
    );
    check(stop("1\nmax_age_s = 0"), "0", "warning.max_age_s");
    check(stop("1\nhysteresis_m = inf"), "inf", "warning.hysteresis_m");
    check(
        stop("1\nuncertainty_m = -0.1"),
        "-0.1",
        "warning.uncertainty_m",
    );
    check(stop("1\nstopp_m = 2"), "stopp_m", "unknown field");
    check(stop("\"near\""), "\"near\"", "invalid type");
    check(
        rule("\"near\"", "\"\""),
        "\"\"",
        "warning.name: expected a name, found none",
    );
    check(
        format!("{RULE}{RULE}"),
        "\"near\"",
        "warning.name: expected each name once",
    );
    check(
        rule("[\"a\"]", "[]"),
        "[]",
        "warning.cameras: expected at least one",
    );
    check(
        rule("[\"a\"]", "[\"a\", \"c\"]"),
        "\"c\"",
        "expected the name of a [[camera]], found \"c\"",
    );
    check(
        rule("[\"a\"]", "[\"own weights\"]"),
        "\"own weights\"",
        "expected uncertainty_m",
    );
    check(
        rule("\"camera\"", "\"wearer\""),
        "\"wearer\"",
        "expected \"camera\", or points_m",
    );
    check(
        rule("\"camera\"", "{}"),
        "{}",
        "warning.protect: expected at least one point or box",
    );
    let place = "{ points_m = [[0, 0, 0]] }";
    check(
        rule("\"camera\"", place),
        "\"a\"",
        "expected cameras with world_from_camera",
    );
    let place = "{ points_m = [[0, inf, 0]] }";
    check(
        rule("\"camera\"", place),
        place,
        "expected points in finite metres",
    );
    let place = "{ boxes_m = [{ min = [0, 0, 1], max = [1, 1, 0] }] }";
    check(rule("\"camera\"", place), place, "min no greater than max");

    let action = |rest: &str| format!("{RULE}[[action]]\nname = \"do\"\non = [\"stop\"]\n{rest}");
    check(
        "[[action]]\nname = \"do\"\non = [\"stop\"]\ncommand = [\"x\"]\n".into(),
        "\"do\"",
        "action: expected a [[warning]] that it acts on, found none",
    );
    check(
        action(""),
        "\"do\"",
        "action: expected one of command, post, dashboard, found none",
    );
    check(
        action("command = [\"x\"]\npost = \"http://x\""),
        "\"do\"",
        "found command, post",
    );
    check(
        action("command = []"),
        "[]",
        "action.command: expected a program",
    );
    check(
        action("post = \"x\""),
        "\"x\"",
        "action.post: expected an http:// address",
    );
    check(action("post = \"https://x/y\""), "\"https://x/y\"", "curl");
    check(
        action("post = \"http://x\"\nattempts = 0"),
        "0",
        "action.attempts",
    );
    check(
        action("post = \"http://x\"\ntimeout_s = 1e9"),
        "1e9",
        "action.timeout_s",
    );
    check(
        action("post = \"http://x\"\nwarnings = [\"far\"]"),
        "\"far\"",
        "the name of a [[warning]]",
    );
    check(
        action("dashboard = { host = \"x\", send = \"halt\" }"),
        "\"halt\"",
        "unknown variant",
    );
    check(
        action("post = \"http://x\"").replace("[\"stop\"]", "[]"),
        "[]",
        "action.on",
    );
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn what_is_right_is_accepted() {
    let text = RULE.replace("\"a\"", "\"own weights\"") + "uncertainty_m = 0.2\n";
    let own = Observer {
        uncertainty_m: None,
        ..observer("own weights")
    };
    config(&text).check(std::slice::from_ref(&own)).unwrap();
    // The greater of card and rule counts.
    for (card, expected) in [(None, 0.2), (Some(0.1), 0.2), (Some(0.3), 0.3)] {
        let camera = Observer {
            uncertainty_m: card,
            ..own.clone()
        };
        let mut clocked = Clocked::new(&text, &[camera]);
        let (_, warning) = clocked.frames(&[(0, found(1.5))]).unwrap();
        assert_eq!(warning.uncertainty_m, Some(expected));
    }
    Config::default().check(&[]).unwrap();
}

/// The README's example is one that is accepted.
#[test]
fn the_readme_s_example_is_right() {
    let readme = include_str!("../../docs/watch.md");
    let section = readme.split("\n## Warnings\n").nth(1).unwrap();
    let text = section.split("```toml").nth(1).unwrap();
    let text = text.split("```").next().unwrap();
    #[derive(serde::Deserialize)]
    struct File {
        camera: Vec<Table>,
        warning: Vec<whereabot::live::warning::Rule>,
        action: Vec<whereabot::live::warning::Action>,
    }
    #[derive(serde::Deserialize)]
    struct Table {
        name: String,
        world_from_camera: Option<Pose>,
    }
    let File {
        camera,
        warning,
        action,
    } = toml::from_str(text).unwrap();
    let observers: Vec<_> = camera
        .into_iter()
        .map(
            |Table {
                 name,
                 world_from_camera,
             }| Observer {
                name,
                world_from_camera,
                uncertainty_m: Some(0.1),
            },
        )
        .collect();
    let config = Config {
        rules: warning,
        actions: action,
    };
    config.check(&observers).unwrap();
    assert!(!config.rules.is_empty() && !config.actions.is_empty());
    assert!(config.check(&observers[..1]).is_err());
}

// Actions.

/// Warnings of one camera, with what they emit.
struct Running {
    warnings: Warnings,
    events: Receiver<Event>,
    frame: u64,
}

impl Running {
    /// Rules that take a single frame's word.
    fn new(rest: &str) -> Self {
        let text = format!("{RULE}agree = 1\nmax_age_s = 60\n{rest}");
        let (sender, events) = mpsc::channel();
        let sender = Mutex::new(sender);
        let emit = move |event| {
            let _ = sender.lock().unwrap().send(event);
        };
        let warnings = Warnings::start(&config(&text), &[observer("a")], emit).unwrap();
        Self {
            warnings,
            events,
            frame: 0,
        }
    }

    fn see(&mut self, distance_m: f64) {
        let now = Instant::now();
        self.warnings.observation(&Observation {
            file: None,
            camera: 0,
            frame: self.frame,
            acquired: SystemTime::now(),
            acquired_at: now,
            answered_at: now,
            image: Arc::new(RgbaImage::new(1, 1)),
            view: Camera::assumed(1, 1),
            estimate: found(distance_m),
        });
        self.frame += 1;
    }

    fn next(&self) -> EventKind {
        self.events.recv_timeout(20 * SECOND).unwrap().kind
    }

    /// The next report of an action.
    fn report(&self) -> ActionReport {
        loop {
            if let EventKind::Action(report) = self.next() {
                return report;
            }
        }
    }

    /// The next state of a rule.
    fn state(&self) -> State {
        loop {
            if let EventKind::Warning(warning) = self.next() {
                return warning.state;
            }
        }
    }
}

#[test]
fn nobody_needs_to_call_for_a_rule_to_become_unknown() {
    let text = format!("{RULE}agree = 1\nmax_age_s = 1.5\n");
    let mut running = Running::new("");
    let (sender, events) = mpsc::channel();
    let sender = Mutex::new(sender);
    let emit = move |event| sender.lock().unwrap().send(event).unwrap();
    running.warnings = Warnings::start(&config(&text), &[observer("a")], emit).unwrap();
    running.events = events;
    assert_eq!(running.state(), State::Unknown);
    let seen = Instant::now();
    running.see(3.0);
    assert_eq!(running.state(), State::Clear);
    assert_eq!(running.state(), State::Unknown);
    assert!(seen.elapsed() > ms(1500));
    // A camera that is stale is so at once, and is told like all else.
    running.see(0.5);
    assert_eq!(running.state(), State::Stop);
    running.warnings.event(&Event {
        at: SystemTime::now(),
        camera: Some(0),
        kind: EventKind::Stale,
    });
    let EventKind::Warning(warning) = running.next() else {
        panic!()
    };
    assert_eq!(
        (warning.state, warning.why),
        (State::Unknown, Some(Why::Stale))
    );
    let line = serde_json::to_value(&warning).unwrap();
    assert_eq!(line["state"], "unknown");
    assert_eq!(line["why"], "stale");
    assert_eq!(line["before"], "stop");
}

#[cfg(unix)]
#[test]
fn commands_get_the_warning_and_are_held_to_their_time() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("warning.json");
    let script = format!("cat > '{}'", file.display());
    let mut running = Running::new(&format!(
        "[[action]]\nname = \"note\"\non = [\"stop\"]\ncommand = [\"sh\", \"-c\", {script:?}]\ntimeout_s = 20\n\
         [[action]]\nname = \"hang\"\non = [\"warn\"]\ncommand = [\"sleep\", \"60\"]\ntimeout_s = 0.1\nattempts = 2\n\
         [[action]]\nname = \"fail\"\non = [\"clear\"]\ncommand = [\"false\"]\nattempts = 1\ntimeout_s = 20\n\
         [[action]]\nname = \"miss\"\non = [\"unknown\"]\ncommand = [\"no-such-program\"]\nattempts = 1\n"
    ));
    // At the start unknown counts as a warning.
    let mut reports: Vec<_> = (0..3).map(|_| running.report()).collect();
    reports.sort_by_key(|report| (report.action.clone(), report.attempt));
    let [first, second, miss] = &reports[..] else {
        panic!()
    };
    assert_eq!(
        (first.action.as_str(), first.attempt, first.attempts),
        ("hang", 1, 2)
    );
    assert!(!first.done && first.message.contains("killed"), "{first:?}");
    assert_eq!((second.attempt, second.done), (2, false));
    assert!(
        !miss.done && miss.message.contains("no-such-program"),
        "{miss:?}"
    );

    running.see(0.5);
    let report = running.report();
    assert!(report.done && report.state == State::Stop, "{report:?}");
    let body: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    assert_eq!(body["rule"], "near");
    assert_eq!(body["state"], "stop");
    assert_eq!(body["camera"], "a");
    assert_eq!(body["distance_m"], 0.5);
    assert_eq!(body["uncertainty_m"], 0.1);
    assert!(body["latency_ms"].as_f64().unwrap() >= 0.0);
    assert!(body["at_s"].as_f64().unwrap() > 1.7e9);

    running.see(3.0);
    let report = running.report();
    assert!(
        !report.done && report.message.contains("exit status: 1"),
        "{report:?}"
    );
}

/// An HTTP server on loopback that answers each connection with the next of these; an empty one never answers.
///
/// With a gate it waits for a word before each answer.
fn http(
    answers: Vec<&'static str>,
    gate: Option<Receiver<()>>,
) -> (String, Receiver<(String, Value)>) {
    http_on(TcpListener::bind("127.0.0.1:0").unwrap(), answers, gate)
}

fn http_on(
    listener: TcpListener,
    answers: Vec<&'static str>,
    gate: Option<Receiver<()>>,
) -> (String, Receiver<(String, Value)>) {
    let url = format!("http://{}/alarm", listener.local_addr().unwrap());
    let (sender, requests) = mpsc::channel();
    thread::spawn(move || {
        let mut kept = Vec::new();
        for answer in answers {
            let (stream, _) = listener.accept().unwrap();
            let mut reader = BufReader::new(stream.try_clone().unwrap());
            let (mut head, mut length) = (String::new(), 0);
            loop {
                let mut line = String::new();
                reader.read_line(&mut line).unwrap();
                let lower = line.to_lowercase();
                if let Some(value) = lower.strip_prefix("content-length:") {
                    length = value.trim().parse().unwrap();
                }
                if line.trim().is_empty() {
                    break;
                }
                head += &lower;
            }
            let mut body = vec![0; length];
            reader.read_exact(&mut body).unwrap();
            let _ = sender.send((head, serde_json::from_slice(&body).unwrap()));
            if let Some(gate) = &gate {
                let _ = gate.recv();
            }
            let mut stream = stream;
            let _ = stream.write_all(answer.as_bytes());
            // What never answers keeps its connection.
            kept.push(answer.is_empty().then_some(stream));
        }
    });
    (url, requests)
}

const OK: &str = "HTTP/1.1 200 OK\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const BUSY: &str = "HTTP/1.1 503 Busy\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";

#[test]
fn posts_carry_the_warning_and_are_tried_again() {
    const MOVED: &str =
        "HTTP/1.1 301 Moved\r\nlocation: /x\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
    let (url, requests) = http(vec![BUSY, "", MOVED, "rubbish\r\n\r\n", OK], None);
    let mut running = Running::new(&format!(
        "[[action]]\nname = \"post\"\non = [\"stop\"]\npost = \"{url}\"\nattempts = 5\ntimeout_s = 1\n"
    ));
    running.see(0.5);
    let reports: Vec<_> = (0..5).map(|_| running.report()).collect();
    let done: Vec<_> = reports.iter().map(|report| report.done).collect();
    assert_eq!(done, [false, false, false, false, true], "{reports:?}");
    assert!(reports[0].message.contains("found 503"), "{reports:?}");
    assert!(reports[1].message.contains("timeout"), "{reports:?}");
    assert!(reports[2].message.contains("found 301"), "{reports:?}");
    for _ in 0..5 {
        let (head, body) = requests.recv_timeout(SECOND).unwrap();
        assert!(head.starts_with("post /alarm http/1.1"), "{head}");
        assert!(head.contains("content-type: application/json"), "{head}");
        assert_eq!(body["state"], "stop");
    }
}

#[test]
fn a_newer_state_takes_an_older_one_s_place_and_nobody_waits() {
    // The server answers when it is told to; what is to be posted meanwhile waits.
    let (open, gate) = mpsc::channel();
    let (url, requests) = http(vec![BUSY, OK], Some(gate));
    let mut running = Running::new(&format!(
        "[[action]]\nname = \"post\"\non = [\"clear\", \"warn\", \"stop\"]\npost = \"{url}\"\ntimeout_s = 60\n"
    ));
    let (_, body) = requests.recv_timeout(20 * SECOND).unwrap();
    assert_eq!(
        (&body["state"], &body["acts_as"]),
        (&json!("unknown"), &json!("warn"))
    );
    for _ in 0..200 {
        running.see(3.0);
        running.see(1.5);
    }
    running.see(0.5);
    // All states are told, although nothing is acted on.
    let told: Vec<_> = (0..402).map(|_| running.state()).collect();
    assert_eq!(told.last(), Some(&State::Stop));
    // The first attempt fails, and is not tried again: the newest state is.
    for _ in 0..2 {
        open.send(()).unwrap();
    }
    let (_, body) = requests.recv_timeout(20 * SECOND).unwrap();
    assert_eq!(body["state"], "stop");
    let tried = [running.report(), running.report()];
    let tried = tried.map(|report| (report.state, report.attempt, report.done));
    assert_eq!(tried, [(State::Unknown, 1, false), (State::Stop, 1, true)]);
}

/// Unknown that counts as a warning and a warning are one to who acts on warnings.
#[test]
fn what_is_acted_on_already_is_not_acted_on_again() {
    let (url, requests) = http(vec![OK; 3], None);
    let mut running = Running::new(&format!(
        "[[action]]\nname = \"post\"\non = [\"warn\"]\npost = \"{url}\"\ntimeout_s = 20\n"
    ));
    let next = || requests.recv_timeout(20 * SECOND).unwrap().1;
    assert_eq!(next()["state"], "unknown");
    running.see(1.5);
    assert!(running.report().done);
    running.see(0.5);
    running.see(1.5);
    let body = next();
    assert_eq!(
        (&body["before"], &body["state"]),
        (&json!("stop"), &json!("warn"))
    );
}

#[test]
fn the_end_does_not_wait_for_who_never_answers() {
    let (url, requests) = http(vec![""; 2], None);
    let mut running = Running::new(&format!(
        "[[action]]\nname = \"post\"\non = [\"stop\"]\npost = \"{url}\"\ntimeout_s = 60\n"
    ));
    running.see(0.5);
    requests.recv_timeout(20 * SECOND).unwrap();
    let before = Instant::now();
    drop(running);
    assert!(before.elapsed() < 10 * SECOND);
}

// The dashboard server.

/// What a connection to the fake goes like.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Manner {
    /// As a controller does.
    Faithful,
    /// A byte each 30 ms.
    Slow,
    /// The program goes on for 200 ms after it was told to pause or stop.
    Late,
    /// The connection is taken, and nothing is said.
    Silent,
    /// A greeting, and nothing more.
    Deaf,
    /// The connection ends when a command comes, which is not done.
    Dropping,
    /// Says that it was done, and it was not.
    Lying,
    /// Something else.
    Garbage,
    /// Bytes without an end of line, for ever.
    Flood,
    /// Another server's greeting.
    Stranger,
    /// A controller under local control.
    Local,
}

/// A Universal Robots dashboard server on loopback; connections after the last manner are faithful.
struct Robot {
    port: u16,
    playing: Arc<AtomicBool>,
    commands: Arc<Mutex<Vec<String>>>,
}

impl Robot {
    fn new(playing: bool, manners: &[Manner]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let robot = Self {
            port: listener.local_addr().unwrap().port(),
            playing: Arc::new(AtomicBool::new(playing)),
            commands: Arc::default(),
        };
        let (playing, commands) = (Arc::clone(&robot.playing), Arc::clone(&robot.commands));
        let manners = manners.to_vec();
        thread::spawn(move || {
            let mut manners = manners.into_iter();
            while let Ok((stream, _)) = listener.accept() {
                let manner = manners.next().unwrap_or(Manner::Faithful);
                let (playing, commands) = (Arc::clone(&playing), Arc::clone(&commands));
                thread::spawn(move || serve(&stream, manner, &playing, &commands));
            }
        });
        robot
    }

    fn action(&self, send: &str, timeout_s: f64) -> String {
        format!(
            "[[action]]\nname = \"robot\"\non = [\"stop\"]\ntimeout_s = {timeout_s}\n\
             dashboard = {{ host = \"127.0.0.1\", port = {}, send = \"{send}\" }}\n",
            self.port
        )
    }

    fn commands(&self) -> Vec<String> {
        self.commands.lock().unwrap().clone()
    }
}

fn serve(
    stream: &TcpStream,
    manner: Manner,
    playing: &Arc<AtomicBool>,
    commands: &Mutex<Vec<String>>,
) -> Option<()> {
    let say = |line: &str| {
        let line = format!("{line}\n");
        for byte in line
            .as_bytes()
            .chunks(if manner == Manner::Slow { 1 } else { 4096 })
        {
            if manner == Manner::Slow {
                thread::sleep(ms(30));
            }
            let mut stream = stream;
            stream.write_all(byte).ok()?;
        }
        Some(())
    };
    let idle = || -> Option<()> {
        loop {
            thread::sleep(SECOND);
        }
    };
    match manner {
        Manner::Silent => idle()?,
        Manner::Flood => loop {
            let mut stream = stream;
            stream.write_all(&[0xff; 100]).ok()?;
        },
        Manner::Garbage => say("\u{0}\u{1}\u{fffd}{\"x\":")?,
        Manner::Stranger => say("220 ready")?,
        _ => say("Connected: Universal Robots Dashboard Server")?,
    }
    let mut paused = false;
    for line in BufReader::new(stream).lines() {
        let line = line.ok()?;
        commands.lock().unwrap().push(line.clone());
        let runs = playing.load(Ordering::SeqCst);
        match manner {
            Manner::Deaf => idle()?,
            Manner::Dropping => return None,
            Manner::Local if line != "running" && line != "programState" => {
                say("Command is not allowed due to safety reasons")?;
                continue;
            }
            _ => (),
        }
        let halt = || {
            let playing = Arc::clone(playing);
            match manner {
                Manner::Lying => (),
                Manner::Late => {
                    thread::spawn(move || {
                        thread::sleep(ms(200));
                        playing.store(false, Ordering::SeqCst);
                    });
                }
                _ => playing.store(false, Ordering::SeqCst),
            }
        };
        match (line.as_str(), runs) {
            ("pause", true) => {
                paused = true;
                halt();
                say("Pausing program")?;
            }
            ("stop", true) => {
                halt();
                say("Stopped")?;
            }
            ("pause" | "stop", false) => say(&format!("Failed to execute: {line}"))?,
            ("running", runs) => say(&format!("Program running: {runs}"))?,
            ("programState", true) => say("PLAYING pick.urp")?,
            ("programState", false) if paused => say("PAUSED pick.urp")?,
            ("programState", false) => say("STOPPED pick.urp")?,
            _ => say(&format!("could not understand: '{line}'"))?,
        }
    }
    Some(())
}

/// Tries all cases, each in a thread: most of their time they wait.
fn at_once<T: Copy + Send + Sync>(cases: &[T], attempt: impl Fn(T) + Sync) {
    thread::scope(|scope| {
        for &case in cases {
            let attempt = &attempt;
            scope.spawn(move || attempt(case));
        }
    });
}

#[test]
fn the_robot_is_told_and_what_it_does_is_read_back() {
    for (send, answer, asked) in [
        ("pause", "Pausing program; PAUSED pick.urp", "programState"),
        ("stop", "Stopped; Program running: false", "running"),
    ] {
        let robot = Robot::new(true, &[]);
        let mut running = Running::new(&robot.action(send, 20.0));
        running.see(1.5);
        running.see(3.0);
        running.see(0.5);
        let report = running.report();
        assert!(report.done && report.attempt == 1, "{report:?}");
        assert_eq!(report.message, answer);
        assert_eq!(robot.commands(), [send, asked]);
        assert!(!robot.playing.load(Ordering::SeqCst));
    }
    // Where nothing runs it fails to be paused, and all is well.
    for send in ["pause", "stop"] {
        let robot = Robot::new(false, &[]);
        let mut running = Running::new(&robot.action(send, 20.0));
        running.see(0.5);
        let report = running.report();
        assert!(report.done, "{report:?}");
        assert!(
            report.message.starts_with("Failed to execute"),
            "{report:?}"
        );
    }
}

#[test]
fn a_robot_that_takes_its_time_is_waited_for() {
    let cases = [Manner::Late, Manner::Slow].map(|manner| [(manner, "pause"), (manner, "stop")]);
    at_once(cases.as_flattened(), |(manner, send)| {
        let robot = Robot::new(true, &[manner]);
        let mut running = Running::new(&robot.action(send, 20.0));
        running.see(0.5);
        let report = running.report();
        assert!(report.done && report.attempt == 1, "{manner:?} {report:?}");
        assert!(!robot.playing.load(Ordering::SeqCst));
    });
}

#[test]
fn a_robot_that_does_not_do_it_is_told_again() {
    let cases = [
        (Manner::Slow, "no answer in time"),
        (Manner::Silent, "greeting: no answer in time"),
        (Manner::Deaf, "stop: no answer in time"),
        (Manner::Dropping, "stop: "),
        (
            Manner::Lying,
            "it answered \"Stopped\", but the program still runs",
        ),
        (Manner::Garbage, "greeting: expected"),
        (Manner::Flood, "greeting: expected a line"),
        (Manner::Stranger, "found \"220 ready\""),
        (Manner::Local, "found \"Command is not allowed"),
    ];
    at_once(&cases, |(manner, message)| {
        let robot = Robot::new(true, &[manner]);
        let mut running = Running::new(&robot.action("stop", 1.0));
        running.see(0.5);
        let first = running.report();
        assert!(
            !first.done && first.message.contains(message),
            "{manner:?} {first:?}"
        );
        // The next connection is to a controller.
        let second = running.report();
        assert!(second.done && second.attempt == 2, "{manner:?} {second:?}");
        assert!(!robot.playing.load(Ordering::SeqCst));
    });
}

#[test]
fn attempts_come_to_an_end() {
    let robot = Robot::new(true, &[Manner::Lying; 9]);
    let mut running = Running::new(&(robot.action("pause", 0.2) + "attempts = 2\n"));
    running.see(0.5);
    let attempts: Vec<_> = (0..2).map(|_| running.report()).collect();
    assert!(attempts.iter().all(|report| !report.done), "{attempts:?}");
    assert!(robot.playing.load(Ordering::SeqCst));
    // Nobody is at the port.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let gone = Robot {
        port: listener.local_addr().unwrap().port(),
        playing: Arc::default(),
        commands: Arc::default(),
    };
    drop(listener);
    let mut running = Running::new(&(gone.action("pause", 2.0) + "attempts = 1\n"));
    running.see(0.5);
    let report = running.report();
    assert!(
        !report.done && report.message.contains("connecting: "),
        "{report:?}"
    );
}

/// Nobody is at the port while the rule is unknown, which counts as a stop; then somebody is, and it really is a stop.
#[test]
fn what_failed_for_good_is_acted_on_again() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let mut running = Running::new(&format!(
        "unknown = \"stop\"\n[[action]]\nname = \"post\"\non = [\"stop\"]\npost = \"http://{address}/\"\nattempts = 2\n"
    ));
    let failed = [running.report(), running.report()];
    let tried = failed.map(|report| (report.state, report.attempt, report.done));
    assert_eq!(
        tried,
        [(State::Unknown, 1, false), (State::Unknown, 2, false)]
    );
    let listener = TcpListener::bind(address).unwrap();
    let (_, requests) = http_on(listener, vec![OK; 2], None);
    running.see(0.5);
    let report = running.report();
    assert!(report.done && report.state == State::Stop, "{report:?}");
    // Now that it is done, unknown is no news, and nor is the stop behind it.
    let stale = Event {
        at: SystemTime::now(),
        camera: Some(0),
        kind: EventKind::Stale,
    };
    running.warnings.event(&stale);
    running.see(0.5);
    running.see(3.0);
    while running.state() != State::Clear {}
    requests.recv_timeout(SECOND).unwrap();
    assert!(requests.recv_timeout(ms(300)).is_err());
}

/// A stop that the robot was not told yet is still told when it is clear again.
#[test]
fn a_stop_is_not_forgotten() {
    let robot = Robot::new(true, &[Manner::Deaf]);
    let mut running = Running::new(&robot.action("pause", 1.0));
    running.see(0.5);
    running.see(3.0);
    assert!(!running.report().done);
    let report = running.report();
    assert!(report.done && report.state == State::Stop, "{report:?}");
    assert!(!robot.playing.load(Ordering::SeqCst));
}
