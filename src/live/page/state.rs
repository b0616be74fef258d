//! What the page shows now. Results come in without a wait; a client asks for what has changed since it last asked, so
//! that a slow one gets less, and none has a queue.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde::Serialize;

use super::CameraInfo;
use super::tile::Tile;
use crate::cascade::Status;
use crate::live::warning::{self, Warning, Why};
use crate::live::{Event, EventKind, Observation, Rates, Statistics};

/// Between two pictures of a camera.
const TILE_PERIOD: Duration = Duration::from_millis(100);
/// Of an answer's tiles, in bytes, unless there is one alone: what is newer waits for them on a slow line.
const MOST_TILE_BYTES: usize = 200_000;
/// How long a client is kept waiting for something new.
const LONGEST_WAIT: Duration = Duration::from_secs(1);
/// For so long after a client asked, pictures are encoded for it.
const WATCHED: Duration = Duration::from_secs(3);
/// The events that are kept for those who come later.
const MOST_EVENTS: usize = 100;
/// Characters of an event's reason.
const LONGEST_REASON: usize = 300;

/// Shared by the sink, the painter and the clients.
#[derive(Debug)]
pub(super) struct Board {
    cameras: Vec<CameraInfo>,
    /// The first change's number: another run has others.
    run: u64,
    state: Mutex<State>,
    /// For the painter.
    work: Condvar,
    /// For clients.
    news: Condvar,
}

#[derive(Debug)]
struct State {
    /// Changes are counted, so that a client can say what it knows.
    change: u64,
    /// A camera each.
    views: Vec<View>,
    alarms: BTreeMap<String, Alarm>,
    alarms_change: u64,
    statistics: Option<Statistics>,
    statistics_change: u64,
    events: VecDeque<(u64, EventMessage)>,
    gpu_lost: bool,
    /// When a client last asked.
    asked_at: Option<Instant>,
    closed: bool,
}

#[derive(Debug, Default)]
struct View {
    condition: Condition,
    /// The newest observation, until it is painted.
    newest: Option<Observation>,
    painted: Option<Painted>,
}

/// An observation as it is sent.
#[derive(Debug, Clone)]
struct Painted {
    change: u64,
    acquired_at: Instant,
    message: TileMessage,
    tile: Tile,
}

/// What a camera's source does.
#[derive(Debug, Clone, Copy, Default, Serialize)]
#[serde(rename_all = "snake_case")]
enum Condition {
    #[default]
    Waiting,
    Live,
    Stale,
    Failed,
    Ended,
}

/// What a client gets, before the files of its tiles.
#[derive(Serialize)]
struct Message<'a> {
    run: u64,
    change: u64,
    gpu_lost: bool,
    /// For a client that knows nothing.
    #[serde(skip_serializing_if = "Option::is_none")]
    cameras: Option<&'a [CameraInfo]>,
    conditions: Vec<Condition>,
    #[serde(skip_serializing_if = "Option::is_none")]
    alarms: Option<Vec<&'a Alarm>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    statistics: Option<Vec<RatesMessage>>,
    events: Vec<&'a EventMessage>,
    tiles: Vec<TileMessage>,
    /// The cameras whose tiles there was no room for, first whose turn is next.
    owed: Vec<usize>,
}

#[derive(Debug, Clone, Serialize)]
struct TileMessage {
    camera: usize,
    frame: u64,
    status: &'static str,
    coverage: f64,
    /// From acquisition to answer.
    age_ms: f64,
    /// From acquisition until it was sent.
    old_ms: f64,
    /// Of the image that `joints` and the intrinsics are of.
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    joints: Vec<JointMessage>,
    picture_bytes: usize,
    tint_bytes: usize,
}

#[derive(Debug, Clone, Serialize)]
struct JointMessage {
    name: String,
    xyz_m: [f64; 3],
    px: [f64; 2],
}

/// What a rule says now.
#[derive(Debug, Serialize)]
struct Alarm {
    rule: String,
    /// Since when.
    at_ms: u64,
    camera: Option<usize>,
    state: warning::State,
    /// The distance that made it so.
    distance_m: Option<f64>,
    /// Why nobody knows.
    reason: Option<&'static str>,
}

#[derive(Debug, Serialize)]
struct RatesMessage {
    frames_per_s: f64,
    answers_per_s: f64,
    dropped: u64,
    age_p50_ms: Option<f64>,
    age_p99_ms: Option<f64>,
}

#[derive(Debug, Serialize)]
struct EventMessage {
    at_ms: u64,
    camera: Option<usize>,
    kind: &'static str,
    text: String,
}

impl Board {
    pub fn new(cameras: Vec<CameraInfo>) -> Self {
        // Later runs have larger numbers, and JavaScript still counts them.
        let run = milliseconds(SystemTime::now());
        let views = cameras.iter().map(|_| View::default()).collect();
        let state = State {
            change: run,
            views,
            alarms: BTreeMap::new(),
            alarms_change: 0,
            statistics: None,
            statistics_change: 0,
            events: VecDeque::new(),
            gpu_lost: false,
            asked_at: None,
            closed: false,
        };
        Self {
            cameras,
            run,
            state: Mutex::new(state),
            work: Condvar::new(),
            news: Condvar::new(),
        }
    }

    pub fn observe(&self, observation: &Observation) {
        let mut state = self.lock();
        let watched = state.is_watched();
        if let Some(view) = state.views.get_mut(observation.camera) {
            view.newest = Some(observation.clone());
            if watched {
                self.work.notify_one();
            }
        }
    }

    pub fn tell(&self, event: &Event) {
        let (kind, text) = in_words(&event.kind);
        let mut state = self.lock();
        match &event.kind {
            EventKind::DeviceLost { .. } => state.gpu_lost = true,
            EventKind::DeviceBack => state.gpu_lost = false,
            EventKind::Live => state.set_condition(event.camera, Condition::Live),
            EventKind::Stale => state.set_condition(event.camera, Condition::Stale),
            EventKind::Failed { .. } => state.set_condition(event.camera, Condition::Failed),
            EventKind::Ended => state.set_condition(event.camera, Condition::Ended),
            EventKind::Warning(warning) => state.set_alarm(event, warning),
            EventKind::Action(_) => {}
        }
        state.log(event.at, event.camera, kind, text);
        self.news.notify_all();
    }

    pub fn count(&self, statistics: &Statistics) {
        let mut state = self.lock();
        state.statistics_change = state.next_change();
        state.statistics = Some(statistics.clone());
        self.news.notify_all();
    }

    /// Nobody waits any more.
    pub fn close(&self) {
        self.lock().closed = true;
        self.work.notify_all();
        self.news.notify_all();
    }

    pub fn is_closed(&self) -> bool {
        self.lock().closed
    }

    /// Encodes what clients wait for, until the board is closed.
    pub fn paint(&self) {
        loop {
            let start = Instant::now();
            let Some(observations) = self.wait_for_work() else {
                return;
            };
            let painted: Vec<_> = observations
                .iter()
                .filter_map(|observation| {
                    let camera = self.cameras.get(observation.camera)?;
                    match Tile::new(observation, &camera.canonical) {
                        Ok(tile) => Some((observation, tile)),
                        Err(error) => {
                            log::warn!("{}: no picture for the page: {error}", camera.name);
                            None
                        }
                    }
                })
                .collect();
            let mut state = self.lock();
            let change = state.next_change();
            for (observation, tile) in painted {
                if let Some(view) = state.views.get_mut(observation.camera) {
                    view.painted = Some(Painted {
                        change,
                        acquired_at: observation.acquired_at,
                        message: TileMessage::new(observation, &tile),
                        tile,
                    });
                }
            }
            self.news.notify_all();
            // New observations wake it as well: only a closed board cuts the pause short.
            while !state.closed && start.elapsed() < TILE_PERIOD {
                let left = TILE_PERIOD.saturating_sub(start.elapsed());
                state = wait(&self.work, state, left);
            }
        }
    }

    /// The observations to paint; `None` when the board is closed.
    fn wait_for_work(&self) -> Option<Vec<Observation>> {
        let mut state = self.lock();
        loop {
            if state.closed {
                return None;
            }
            if state.is_watched() {
                let newest = state.views.iter_mut().filter_map(|view| view.newest.take());
                let newest: Vec<_> = newest.collect();
                if !newest.is_empty() {
                    return Some(newest);
                }
            }
            state = self
                .work
                .wait(state)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// What has changed since change `known`, 0 for all, and the tiles of the cameras `owed` before other tiles; waits a
    /// second for it at most. Little-endian u32: the length of a JSON object; the object; then for each of its `tiles` the
    /// files `picture` and `tint`.
    pub fn changes_since(&self, known: u64, owed: &[usize]) -> Vec<Arc<[u8]>> {
        let until = Instant::now() + LONGEST_WAIT;
        let mut state = self.lock();
        if !state.is_watched() {
            state.forget_old_pictures();
        }
        state.asked_at = Some(Instant::now());
        self.work.notify_one();
        // A number from the future is another run's.
        let known = if known > state.change { 0 } else { known };
        let nothing_for_it = |state: &State| {
            state.change == known && owed.iter().all(|camera| state.painted(*camera).is_none())
        };
        while nothing_for_it(&state) && !state.closed && Instant::now() < until {
            let left = until.saturating_duration_since(Instant::now());
            state = wait(&self.news, state, left);
        }
        state.asked_at = Some(Instant::now());
        let (message, tiles) = self.message(&state, known, owed);
        drop(state);
        let mut parts = vec![message];
        for tile in tiles {
            parts.extend([tile.picture, tile.tint]);
        }
        parts
    }

    fn message(&self, state: &State, known: u64, owed: &[usize]) -> (Arc<[u8]>, Vec<Tile>) {
        let (painted, owed) = state.tiles_for(known, owed);
        let alarms = || state.alarms.values().collect();
        let statistics = state.statistics.as_ref();
        let statistics = statistics.filter(|_| state.statistics_change > known);
        let events = state.events.iter().filter(|(change, _)| *change > known);
        let message = Message {
            run: self.run,
            change: state.change,
            gpu_lost: state.gpu_lost,
            cameras: (known == 0).then_some(&self.cameras),
            conditions: state.views.iter().map(|view| view.condition).collect(),
            alarms: (state.alarms_change > known).then(alarms),
            statistics: statistics.map(|all| all.cameras.iter().map(RatesMessage::new).collect()),
            events: events.map(|(_, event)| event).collect(),
            tiles: painted.iter().map(|tile| tile.message_now()).collect(),
            owed,
        };
        // Strings, numbers and lists alone.
        let json = serde_json::to_vec(&message).unwrap_or_default();
        let length = u32::try_from(json.len()).unwrap_or_default();
        let bytes = [&length.to_le_bytes(), json.as_slice()].concat();
        let tiles = painted.iter().map(|painted| painted.tile.clone()).collect();
        (bytes.into(), tiles)
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing that holds it can leave it half changed.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn wait<'a>(
    condvar: &Condvar,
    state: MutexGuard<'a, State>,
    at_most: Duration,
) -> MutexGuard<'a, State> {
    let waited = condvar.wait_timeout(state, at_most);
    waited.unwrap_or_else(PoisonError::into_inner).0
}

impl State {
    fn next_change(&mut self) -> u64 {
        self.change += 1;
        self.change
    }

    fn is_watched(&self) -> bool {
        self.asked_at.is_some_and(|at| at.elapsed() < WATCHED)
    }

    fn painted(&self, camera: usize) -> Option<&Painted> {
        self.views.get(camera)?.painted.as_ref()
    }

    /// The tiles to send to a client that is owed some and knows the others up to change `known`, those that it has waited
    /// for longest first; and the cameras whose tiles it is still owed.
    fn tiles_for(&self, known: u64, owed: &[usize]) -> (Vec<&Painted>, Vec<usize>) {
        let is_new = |camera: &usize| self.painted(*camera).is_some_and(|at| at.change > known);
        let new = (0..self.views.len()).filter(is_new);
        let mut cameras = Vec::new();
        for camera in owed.iter().copied().chain(new) {
            if camera < self.views.len() && !cameras.contains(&camera) {
                cameras.push(camera);
            }
        }
        let (mut tiles, mut left, mut bytes) = (Vec::new(), Vec::new(), 0);
        for camera in cameras {
            match self.painted(camera) {
                Some(painted) if bytes == 0 || bytes + painted.tile.bytes() <= MOST_TILE_BYTES => {
                    bytes += painted.tile.bytes();
                    tiles.push(painted);
                }
                // No room for it, or forgotten until it is painted anew.
                _ => left.push(camera),
            }
        }
        (tiles, left)
    }

    /// A picture from when somebody last watched is not shown if there is a newer one.
    fn forget_old_pictures(&mut self) {
        for view in &mut self.views {
            if view.newest.is_some() {
                view.painted = None;
            }
        }
    }

    /// A rule has one alarm: the newest.
    fn set_alarm(&mut self, event: &Event, warning: &Warning) {
        let alarm = Alarm {
            rule: warning.rule.clone(),
            at_ms: milliseconds(event.at),
            camera: event.camera,
            state: warning.state,
            distance_m: warning.distance_m,
            reason: warning.why.map(why_in_words),
        };
        self.alarms_change = self.next_change();
        self.alarms.insert(warning.rule.clone(), alarm);
    }

    fn set_condition(&mut self, camera: Option<usize>, condition: Condition) {
        if let Some(view) = camera.and_then(|camera| self.views.get_mut(camera)) {
            view.condition = condition;
        }
    }

    fn log(&mut self, at: SystemTime, camera: Option<usize>, kind: &'static str, text: String) {
        let event = EventMessage {
            at_ms: milliseconds(at),
            camera,
            kind,
            text: text.chars().take(LONGEST_REASON).collect(),
        };
        let change = self.next_change();
        self.events.push_back((change, event));
        if self.events.len() > MOST_EVENTS {
            self.events.pop_front();
        }
    }
}

impl Painted {
    fn message_now(&self) -> TileMessage {
        TileMessage {
            old_ms: to_milliseconds(self.acquired_at.elapsed()),
            ..self.message.clone()
        }
    }
}

impl TileMessage {
    fn new(observation: &Observation, tile: &Tile) -> Self {
        let estimate = &observation.estimate;
        let intrinsics = observation.view.intrinsics;
        let joints = estimate.joints.iter().map(|joint| JointMessage {
            name: joint.name.clone(),
            xyz_m: joint.xyz_m,
            px: joint.px,
        });
        Self {
            camera: observation.camera,
            frame: observation.frame,
            status: match estimate.status {
                Status::Found => "found",
                Status::NotFound => "not_found",
                Status::Invalid => "invalid",
            },
            coverage: estimate.coverage,
            age_ms: to_milliseconds(observation.age()),
            old_ms: 0.0,
            width: observation.view.width,
            height: observation.view.height,
            fx: intrinsics.fx,
            fy: intrinsics.fy,
            cx: intrinsics.cx,
            cy: intrinsics.cy,
            joints: joints.collect(),
            picture_bytes: tile.picture.len(),
            tint_bytes: tile.tint.len(),
        }
    }
}

impl RatesMessage {
    fn new(rates: &Rates) -> Self {
        Self {
            frames_per_s: rates.frames_per_s,
            answers_per_s: rates.answers_per_s,
            dropped: rates.dropped,
            age_p50_ms: rates.age_p50.map(to_milliseconds),
            age_p99_ms: rates.age_p99.map(to_milliseconds),
        }
    }
}

fn in_words(kind: &EventKind) -> (&'static str, String) {
    match kind {
        EventKind::Live => ("live", "gives frames".into()),
        EventKind::Stale => ("stale", "no frame in time".into()),
        EventKind::Failed { reason, retry_in } => {
            let next = match retry_in {
                Some(wait) => format!("tried again in {:.1} s", wait.as_secs_f64()),
                None => "not tried again".into(),
            };
            ("failed", format!("failed, {next}: {reason}"))
        }
        EventKind::Ended => ("ended", "has ended".into()),
        EventKind::DeviceLost { reason } => ("device_lost", format!("the GPU failed: {reason}")),
        EventKind::DeviceBack => ("device_back", "a GPU is open again".into()),
        EventKind::Warning(warning) => {
            let state = state_name(warning.state);
            let reason = warning.why.map(|why| format!(": {}", why_in_words(why)));
            let text = format!("{}: {state}{}", warning.rule, reason.unwrap_or_default());
            (state, text)
        }
        EventKind::Action(report) => {
            let (kind, done) = match report.done {
                true => ("done", "done"),
                false => ("failed", "not done"),
            };
            let text = format!(
                "{} for {}: {done}: {}",
                report.action, report.rule, report.message
            );
            (kind, text)
        }
    }
}

fn state_name(state: warning::State) -> &'static str {
    match state {
        warning::State::Clear => "clear",
        warning::State::Warn => "warn",
        warning::State::Stop => "stop",
        warning::State::Unknown => "unknown",
    }
}

fn why_in_words(why: Why) -> &'static str {
    match why {
        Why::Starting => "too few answers yet",
        Why::NotFound => "no robot where one is expected",
        Why::Invalid => "what was found is no robot",
        Why::Late => "answers come too late",
        Why::NoAnswer => "no robot for too long",
        Why::Stale => "the camera gives no frames",
        Why::Failed => "the camera failed",
        Why::Ended => "the camera has ended",
        Why::DeviceLost => "the GPU failed",
    }
}

fn milliseconds(at: SystemTime) -> u64 {
    let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or_default()
}

fn to_milliseconds(duration: Duration) -> f64 {
    1e3 * duration.as_secs_f64()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::indexing_slicing)]
mod tests {
    use image::RgbaImage;
    use serde_json::{Value, json};

    use super::*;
    use crate::camera::Camera;
    use crate::cascade::Estimate;

    fn board() -> Board {
        Board::new(vec![CameraInfo {
            name: "bench".into(),
            robot: "ur5".into(),
            canonical: Camera::from_hfov(4, 4, 1.0).intrinsics,
            common_from_camera: None,
        }])
    }

    fn observation(frame: u64) -> Observation {
        Observation {
            file: None,
            camera: 0,
            frame,
            acquired: SystemTime::now(),
            acquired_at: Instant::now(),
            answered_at: Instant::now(),
            image: Arc::new(RgbaImage::new(4, 4)),
            view: Camera::from_hfov(4, 4, 1.0),
            estimate: Estimate {
                status: Status::NotFound,
                coverage: 0.0,
                bbox_px: None,
                field: 1.0,
                joints: Vec::new(),
                mask: None,
            },
        }
    }

    /// The frames that a client that knows nothing gets.
    fn frames(board: &Board) -> Vec<Value> {
        let parts = board.changes_since(0, &[]);
        let message: Value = serde_json::from_slice(&parts[0][4..]).unwrap();
        let tiles = message["tiles"].as_array().unwrap();
        tiles.iter().map(|tile| tile["frame"].clone()).collect()
    }

    #[test]
    fn pictures_are_encoded_only_while_somebody_watches() {
        let board = Arc::new(board());
        let painter = board.clone();
        let painter = std::thread::spawn(move || painter.paint());
        board.observe(&observation(0));
        std::thread::sleep(Duration::from_millis(300));
        assert!(board.lock().views[0].painted.is_none());
        let start = Instant::now();
        while frames(&board) != [json!(0)] {
            assert!(start.elapsed() < Duration::from_secs(30));
        }
        board.close();
        painter.join().unwrap();
    }

    #[test]
    fn who_comes_later_sees_no_picture_of_before() {
        let board = Arc::new(board());
        let painter = board.clone();
        let painter = std::thread::spawn(move || painter.paint());
        board.observe(&observation(0));
        while frames(&board) != [json!(0)] {}
        board.close();
        painter.join().unwrap();

        // Nobody watches for a while, and nothing new comes: the last picture is still the newest.
        board.lock().asked_at = None;
        assert_eq!(frames(&board), [json!(0)]);
        board.lock().asked_at = None;
        board.observe(&observation(1));
        assert!(frames(&board).is_empty());
    }

    #[test]
    fn events_that_are_kept_have_a_bound() {
        let board = board();
        let at = SystemTime::now();
        for _ in 0..1000 {
            let reason = "a".repeat(10_000);
            let kind = EventKind::DeviceLost { reason };
            board.tell(&Event {
                at,
                camera: None,
                kind,
            });
        }
        let state = board.lock();
        assert_eq!(state.events.len(), MOST_EVENTS);
        let longest = state.events.iter().map(|(_, event)| event.text.len()).max();
        assert!(longest.unwrap() <= LONGEST_REASON);
    }
}
