//! Newest frame wins, overload is shared, cameras do not wait for each other.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::simulated::{Collector, Simulated, StandIn, watch};
use whereabot::camera::Camera;
use whereabot::live::{Event, EventKind, Input, Observation, Sink, Statistics, Stop};

const MS: Duration = Duration::from_millis(1);

fn run(inputs: Vec<Input>, engine: StandIn) -> Collector {
    let collector = Collector::default();
    let sinks = vec![Box::new(collector.clone()) as _];
    watch(inputs, Box::new(engine), sinks, &Arc::new(Stop::default()));
    collector
}

/// The 99th percentile of the ages but for the first frames', when nothing is known of the engine.
fn age_p99(observations: &[Observation]) -> Duration {
    let mut ages: Vec<_> = observations
        .iter()
        .filter(|o| o.frame > 5)
        .map(Observation::age)
        .collect();
    ages.sort();
    ages[(ages.len() * 99).div_ceil(100) - 1]
}

/// How many of a camera's frames got answers.
fn answers(observations: &[Observation], cameras: usize) -> Vec<usize> {
    let of = |camera| observations.iter().filter(|o| o.camera == camera).count();
    (0..cameras).map(of).collect()
}

fn are_even(counts: &[usize]) -> bool {
    counts.iter().max().unwrap() - counts.iter().min().unwrap() <= 2
}

#[test]
fn overload_drops_evenly_and_answers_stay_young() {
    const CAMERAS: usize = 64;
    const FRAMES: u64 = 30;
    let service = 250 * MS;
    let cameras = || (0..CAMERAS).map(|_| Simulated::new(100 * MS, FRAMES).input());
    let collector = run(cameras().collect(), StandIn::new(service, CAMERAS));
    let observations = collector.observations();
    let counts = answers(&observations, CAMERAS);
    assert!(are_even(&counts), "{counts:?}");
    // Ten frames a second, four answers.
    assert!(
        counts.iter().all(|count| (6..25).contains(count)),
        "{counts:?}"
    );
    let p99 = age_p99(&observations);
    println!("64 cameras, service {service:?}: age p99 {p99:?}, answers {counts:?}");
    assert!(p99 <= 2 * service, "{p99:?}");
    // Of each camera in order; what lies between was dropped, and counted.
    for camera in 0..CAMERAS {
        let mut frames = observations.iter().filter(|o| o.camera == camera);
        let first = frames.next().unwrap().frame;
        frames.fold(first, |last, next| {
            assert!(next.frame > last);
            next.frame
        });
    }
    let statistics = collector.statistics();
    let dropped = |camera: usize| statistics.last().unwrap().cameras[camera].dropped as usize;
    assert!((0..CAMERAS).all(|c| dropped(c) > 0 && dropped(c) + counts[c] <= FRAMES as usize));

    // Negative controls: an engine that takes four times as long, and a camera that gives half as much.
    let slow = run(cameras().collect(), StandIn::new(4 * service, CAMERAS));
    assert!(age_p99(&slow.observations()) > 2 * service);
    let mut uneven: Vec<Input> = cameras().take(3).collect();
    uneven.push(Simulated::new(100 * MS, 4).input());
    let uneven = run(uneven, StandIn::new(service / 4, CAMERAS));
    assert!(!are_even(&answers(&uneven.observations(), 4)));
}

#[test]
fn small_batches_are_shared_too() {
    let cameras = (0..12).map(|_| Simulated::new(30 * MS, 80).input());
    let collector = run(cameras.collect(), StandIn::new(60 * MS, 4));
    let counts = answers(&collector.observations(), 12);
    assert!(are_even(&counts) && counts[0] > 5, "{counts:?}");
}

#[test]
fn without_overload_every_frame_is_answered() {
    let cameras = (0..4).map(|_| Simulated::new(250 * MS, 6).input());
    let collector = run(cameras.collect(), StandIn::new(5 * MS, 1));
    let observations = collector.observations();
    assert_eq!(answers(&observations, 4), [6; 4]);
    let live = |camera| (Some(camera), EventKind::Live);
    let ended = |camera| (Some(camera), EventKind::Ended);
    let events = collector.events();
    for camera in 0..4 {
        assert!(events.contains(&live(camera)) && events.contains(&ended(camera)));
    }
}

#[test]
fn frames_that_the_engine_cannot_take_are_their_camera_s_failure() {
    let run = |max_side| {
        let mut engine = StandIn::new(5 * MS, 1);
        engine.max_side = max_side;
        let collector = run(vec![Simulated::new(20 * MS, 3).input()], engine);
        let events = collector.events().into_iter();
        let failures = events.filter_map(|(camera, kind)| match kind {
            EventKind::Failed { reason, .. } => Some((camera, reason)),
            EventKind::DeviceLost { reason } => panic!("{reason}"),
            _ => None,
        });
        (failures.collect::<Vec<_>>(), collector.observations().len())
    };
    assert_eq!(run(64), (Vec::new(), 3));
    let (failures, answers) = run(63);
    assert_eq!(answers, 0);
    let (camera, reason) = &failures[0];
    assert_eq!(*camera, Some(0));
    assert!(
        reason.contains("1 to 63 pixels on a side, found 64 x 48"),
        "{reason}"
    );
}

/// Each camera's failures.
fn failures(collector: &Collector) -> Vec<(Option<usize>, String)> {
    let events = collector.events().into_iter();
    let failures = events.filter_map(|(camera, kind)| match kind {
        EventKind::Failed { reason, .. } => Some((camera, reason)),
        _ => None,
    });
    failures.collect()
}

fn losses(collector: &Collector) -> usize {
    let lost = |(_, kind): &(_, EventKind)| matches!(kind, EventKind::DeviceLost { .. });
    collector
        .events()
        .iter()
        .filter(|event| lost(event))
        .count()
}

#[test]
fn a_frame_that_is_not_its_camera_s_is_that_camera_s_failure() {
    let run = |width| {
        let wrong = Simulated {
            camera: Some(Camera::from_hfov(width, 48, 1.2)),
            ..Simulated::new(20 * MS, 2)
        };
        run(
            vec![wrong.input(), Simulated::new(100 * MS, 3).input()],
            StandIn::new(MS, 2),
        )
    };
    let collector = run(65);
    assert_eq!(answers(&collector.observations(), 2), [0, 3]);
    let (camera, reason) = &failures(&collector)[0];
    assert_eq!(*camera, Some(0));
    assert!(
        reason.contains("65 x 48") && reason.contains("64 x 48"),
        "{reason}"
    );
    // Negative control: the right camera.
    let collector = run(64);
    assert!(answers(&collector.observations(), 2)[0] > 0);
    assert_eq!(failures(&collector), []);
}

#[test]
fn frames_that_the_engine_refuses_are_their_camera_s_failure() {
    let run = |refuses| {
        let mut engine = StandIn::new(5 * MS, 3);
        engine.refuses = refuses;
        let cameras = (0..3).map(|_| Simulated::new(100 * MS, 12).input());
        run(cameras.collect(), engine)
    };
    let collector = run(Some(1));
    let counts = answers(&collector.observations(), 3);
    // A frame or two are lost while it is found out whose fault it is.
    assert!(
        counts[0] >= 8 && counts[1] == 0 && counts[2] >= 8,
        "{counts:?}"
    );
    assert_eq!(losses(&collector), 0);
    // Told once.
    let told = failures(&collector);
    assert_eq!(told.len(), 1, "{told:?}");
    assert_eq!(told[0].0, Some(1));
    assert!(told[0].1.contains("no place for that"), "{told:?}");
    let dropped = collector.statistics().last().unwrap().cameras[1].dropped;
    assert!(dropped > 5, "{dropped}");
    // Its frames come, but it is not live: nobody sees what it does.
    let of_it = |collector: &Collector| {
        let events = collector.events().into_iter();
        let kinds = events.filter_map(|(camera, kind)| match kind {
            EventKind::Live => Some((camera?, "live")),
            EventKind::Failed { .. } => Some((camera?, "failed")),
            _ => None,
        });
        let kinds = kinds.filter_map(|(camera, kind)| (camera == 1).then_some(kind));
        kinds.collect::<Vec<_>>()
    };
    assert_eq!(of_it(&collector), ["live", "failed"]);
    // Negative control: nothing is refused.
    let collector = run(None);
    assert_eq!(of_it(&collector), ["live"]);
    assert!(answers(&collector.observations(), 3)[1] > 0);
    assert_eq!(failures(&collector), []);
}

#[test]
fn frames_of_a_rig_are_taken_together() {
    let run = |rig| {
        // One frame a submission, which takes as long as three frames come.
        let cameras = (0..3).map(|camera| Input {
            rig: Some(0).filter(|_| rig && camera != 1),
            ..Simulated::new(40 * MS, 60).input()
        });
        let observations = run(cameras.collect(), StandIn::new(120 * MS, 1)).observations();
        let all = answers(&observations, 3);
        assert!(are_even(&all), "{all:?}");
        let of = |camera| {
            let of = observations.iter().filter(move |o| o.camera == camera);
            of.map(|o| o.acquired_at).collect::<Vec<_>>()
        };
        let (first, other) = (of(0), of(2));
        let together = first.iter().filter(|&&at| {
            let apart = |&then: &Instant| at.max(then) - at.min(then) < 50 * MS;
            other.iter().any(apart)
        });
        (together.count(), first.len())
    };
    let (together, all) = run(true);
    assert!(all >= 4 && together + 1 >= all, "{together} of {all}");
    // Negative control: without a rig each is taken when its turn comes.
    let (together, all) = run(false);
    assert!(2 * together < all, "{together} of {all}");
}

#[test]
fn a_source_that_panics_has_failed() {
    let run = |panics_at| {
        let broken = Simulated {
            panics_at,
            ..Simulated::new(20 * MS, 3)
        };
        let stop = Arc::new(Stop::default());
        let collector = Collector::default();
        let sinks = vec![Box::new(collector.clone()) as _];
        let cameras = vec![broken.input(), Simulated::new(100 * MS, 5).input()];
        let stopper = {
            let (stop, collector) = (Arc::clone(&stop), collector.clone());
            // It would be opened again and again.
            std::thread::spawn(move || {
                while failures(&collector).len() < 2 && !stop.wait(20 * MS) {}
                stop.set();
            })
        };
        watch(cameras, Box::new(StandIn::new(MS, 2)), sinks, &stop);
        stop.set();
        stopper.join().unwrap();
        collector
    };
    let collector = run(Some(1));
    let (camera, reason) = &failures(&collector)[0];
    assert_eq!(*camera, Some(0));
    assert!(reason.contains("this source is broken"), "{reason}");
    // The frame before came, and the other camera was answered all the time.
    let counts = answers(&collector.observations(), 2);
    assert!(counts[0] >= 1 && counts[1] >= 2, "{counts:?}");
    // Negative control: the last frame is not reached.
    assert_eq!(failures(&run(Some(3))), []);
}

#[test]
fn an_engine_that_panics_is_a_device_that_is_lost() {
    let mut engine = StandIn::new(5 * MS, 1);
    engine.panics = Some(3);
    let collector = run(vec![Simulated::new(50 * MS, 20).input()], engine);
    let events = collector.events();
    let lost = events.iter().find_map(|(_, kind)| match kind {
        EventKind::DeviceLost { reason } => Some(reason),
        _ => None,
    });
    assert!(lost.unwrap().contains("this engine is broken"), "{lost:?}");
    assert!(events.contains(&(None, EventKind::DeviceBack)));
    assert!(answers(&collector.observations(), 1)[0] > 3);
}

/// A sink that takes a second for its first observation.
struct Slow(Collector);

impl Sink for Slow {
    fn observation(&mut self, observation: &Observation) {
        if self.0.observations().is_empty() {
            std::thread::sleep(1000 * MS);
        }
        self.0.observation(observation);
    }

    fn event(&mut self, event: &Event) {
        self.0.event(event);
    }

    fn statistics(&mut self, statistics: &Statistics) {
        Sink::statistics(&mut self.0, statistics);
    }
}

#[test]
fn a_sink_that_waits_gets_the_newest_answers_and_all_events() {
    const FRAMES: usize = 30;
    let run = |slow: bool| {
        let collector = Collector::default();
        let sink: Box<dyn Sink> = if slow {
            Box::new(Slow(collector.clone()))
        } else {
            Box::new(collector.clone())
        };
        let mut engine = StandIn::new(MS, 1);
        engine.lost = Some((FRAMES / 3, 8192));
        let cameras = vec![Simulated::new(50 * MS, FRAMES as u64).input()];
        let stop = Arc::new(Stop::default());
        watch(cameras, Box::new(engine), vec![sink], &stop);
        collector
    };
    let collector = run(true);
    let observations = collector.observations();
    // Of those that came meanwhile, one.
    assert!(observations.len() < FRAMES / 2, "{}", observations.len());
    let last = FRAMES as u64 - 1;
    assert_eq!(observations.last().unwrap().frame, last);
    assert_eq!(losses(&collector), 1);
    let statistics = collector.statistics();
    let dropped = statistics.last().unwrap().cameras[0].dropped as usize;
    assert!(dropped + observations.len() <= FRAMES && dropped > FRAMES / 3);
    // Negative control: one that does not wait gets nearly all.
    assert!(run(false).observations().len() > FRAMES * 2 / 3);
}

#[test]
fn another_device_s_limits_are_asked_for() {
    let run = |max_side| {
        let mut engine = StandIn::new(5 * MS, 1);
        engine.lost = Some((3, max_side));
        run(vec![Simulated::new(50 * MS, 10).input()], engine)
    };
    let collector = run(63);
    assert_eq!(losses(&collector), 1);
    assert_eq!(answers(&collector.observations(), 1), [3]);
    let told = failures(&collector);
    assert!(told[0].1.contains("1 to 63 pixels"), "{told:?}");
    // Negative control: it takes the frames, too.
    let collector = run(64);
    assert_eq!(losses(&collector), 1);
    assert!(answers(&collector.observations(), 1)[0] > 3);
    assert_eq!(failures(&collector), []);
}

#[test]
fn a_camera_that_pauses_is_stale_and_no_other_is_disturbed() {
    let paused = Simulated {
        pause: Some((10, 1500 * MS)),
        ..Simulated::new(50 * MS, 20)
    };
    let steady = Simulated::new(50 * MS, 50);
    let collector = run(
        vec![paused.input(), steady.input()],
        StandIn::new(5 * MS, 2),
    );
    let told = collector.told.lock().unwrap().clone();
    let events: Vec<_> = collector
        .events()
        .into_iter()
        .filter(|(camera, _)| *camera == Some(0))
        .map(|(_, kind)| kind)
        .collect();
    use EventKind::{Ended, Live, Stale};
    assert_eq!(events, [Live, Stale, Live, Ended]);
    // In time: before the pause was half over.
    let observations = collector.observations();
    let of_0 = |frame| {
        observations
            .iter()
            .find(|o| o.camera == 0 && o.frame == frame)
    };
    let last = of_0(9).unwrap().acquired;
    let stale = told.iter().find_map(|told| match told {
        super::simulated::Told::Event(event) if event.kind == Stale => Some(event.at),
        _ => None,
    });
    let late = stale.unwrap().duration_since(last).unwrap();
    assert!((150 * MS..750 * MS).contains(&late), "{late:?}");
    // All of them, but that this machine may have other work.
    assert!(answers(&observations, 2)[1] > 40);
}

#[test]
fn a_clock_that_jumps_back_changes_no_age_and_no_order() {
    let hour = Duration::from_secs(3600);
    let camera = Simulated {
        clock_back: Some((5, hour)),
        ..Simulated::new(50 * MS, 10)
    };
    let collector = run(vec![camera.input()], StandIn::new(5 * MS, 1));
    let observations = collector.observations();
    let frames: Vec<_> = observations.iter().map(|o| o.frame).collect();
    assert_eq!(frames, (0..10).collect::<Vec<_>>());
    assert!(observations.iter().all(|o| o.age() < hour / 2));
    // It did jump.
    assert!(observations[5].acquired < observations[4].acquired);
    let stale = |(_, kind): &(_, EventKind)| *kind == EventKind::Stale;
    assert!(!collector.events().iter().any(stale));
}
