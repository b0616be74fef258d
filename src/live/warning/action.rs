use std::collections::{HashSet, VecDeque};
use std::io::Write;
use std::process::{Command, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use serde_json::{Value, json};

use super::config::{self, Config};
use super::dashboard;
use super::{ActionReport, State, Warning};
use crate::live::{Event, EventKind};

/// Where events go. Must not wait.
pub type Emit = Arc<dyn Fn(Event) + Send + Sync>;

/// Why an attempt failed.
#[derive(Debug, thiserror::Error)]
pub enum ActionError {
    /// The program could not be run.
    #[error("{program}: {cause}")]
    Program {
        program: String,
        cause: std::io::Error,
    },
    /// The program said that it failed.
    #[error("{program}: {status}")]
    Status {
        program: String,
        status: std::process::ExitStatus,
    },
    /// The program did not end.
    #[error("{program}: not done after {} s, killed", after.as_secs_f64())]
    Killed { program: String, after: Duration },
    /// The POST did not get through.
    #[error("POST {url}: {cause}")]
    Http { url: String, cause: ureq::Error },
    /// The POST was not accepted.
    #[error("POST {url}: expected a status of 2xx, found {status}")]
    Refused { url: String, status: u16 },
    /// The dashboard server did not do it.
    #[error("dashboard server {server}: {cause}")]
    Dashboard {
        server: String,
        cause: dashboard::DashboardError,
    },
}

/// What is done.
#[derive(Debug, Clone)]
enum Effect {
    Run(Vec<String>),
    Post(String),
    Dashboard(config::Dashboard),
}

/// A warning that waits for an action.
#[derive(Debug, Clone)]
struct Notice {
    warning: Warning,
    /// The warning as JSON, with its time and camera.
    body: String,
    since: Instant,
    /// Of no use once the notice before it is done: it is there only because that was not.
    again: bool,
}

/// What a worker has to do: at most one notice a rule.
#[derive(Debug, Default)]
struct Pending {
    notices: VecDeque<Notice>,
    /// The rules whose last notice is not done: it waits, is being acted on, or was given up.
    undone: HashSet<String>,
    busy: bool,
    closing: bool,
}

/// Shared by a worker and those who give it work.
#[derive(Debug, Default)]
struct Mailbox {
    pending: Mutex<Pending>,
    changed: Condvar,
}

/// An action with a thread of its own: none waits for another.
struct Worker {
    on: Vec<State>,
    /// The rules that it serves; `None` for all.
    warnings: Option<Vec<String>>,
    mailbox: Arc<Mailbox>,
}

/// Does actions, each in a thread of its own. A newer state of a rule takes the place of an older one that was not acted on
/// yet, or that failed and waits to be tried again. What failed for good is not forgotten: the rule's next state is acted on
/// even if it counts as the one before.
pub struct Actions {
    workers: Vec<Worker>,
}

impl Actions {
    /// How long pending actions may take when the program ends.
    const FAREWELL: Duration = Duration::from_millis(300);

    /// Starts a thread an action of `config`.
    ///
    /// # Errors
    /// The system's where it gives no thread.
    pub fn start(config: &Config, emit: &Emit) -> std::io::Result<Self> {
        let workers = config.actions.iter().map(|action| {
            let mailbox = Arc::new(Mailbox::default());
            let doer = Doer {
                name: action.name.get_ref().clone(),
                effect: effect(action),
                timeout: Duration::from_secs_f64(*action.timeout_s.get_ref()),
                attempts: *action.attempts.get_ref(),
                mailbox: Arc::clone(&mailbox),
                emit: Arc::clone(emit),
            };
            thread::Builder::new()
                .name(format!("action {}", doer.name))
                .spawn(move || doer.run())?;
            let warnings = action.warnings.as_ref().map(|names| {
                let names = names.iter().map(|name| name.get_ref().clone());
                names.collect()
            });
            Ok(Worker {
                on: action.on.get_ref().clone(),
                warnings,
                mailbox,
            })
        });
        Ok(Self {
            workers: workers.collect::<std::io::Result<_>>()?,
        })
    }

    /// A rule's state changed. Returns at once.
    pub fn act(&self, warning: &Warning, camera: Option<&str>, at: SystemTime) {
        let mut body = None;
        for worker in &self.workers {
            let serves = |rules: &Vec<String>| rules.contains(&warning.rule);
            let [before, now] = entered(&worker.on, warning);
            if now.is_none() || !worker.warnings.as_ref().is_none_or(serves) {
                continue;
            }
            let mut pending = worker.mailbox.lock();
            if before == now && !pending.undone.contains(&warning.rule) {
                continue;
            }
            let same = |other: &Notice| other.warning.rule == warning.rule;
            let mut waiting = pending.notices.iter().filter(|other| same(other));
            let again = before == now && waiting.all(|other| other.again);
            let body = body.get_or_insert_with(|| body_of(warning, camera, at));
            let notice = Notice {
                warning: warning.clone(),
                body: body.clone(),
                since: Instant::now(),
                again,
            };
            pending.undone.insert(warning.rule.clone());
            pending.notices.retain(|other| !same(other));
            pending.notices.push_back(notice);
            worker.mailbox.changed.notify_all();
        }
    }

    /// The end: what was not tried yet is tried once, for [`Actions::FAREWELL`] at most.
    pub fn close(&self) {
        for worker in &self.workers {
            worker.mailbox.lock().closing = true;
            worker.mailbox.changed.notify_all();
        }
        let end = Instant::now() + Self::FAREWELL;
        for worker in &self.workers {
            let at_work = |pending: &mut Pending| pending.busy || !pending.notices.is_empty();
            let left = end.saturating_duration_since(Instant::now());
            let waited =
                worker
                    .mailbox
                    .changed
                    .wait_timeout_while(worker.mailbox.lock(), left, at_work);
            let (pending, _) = waited.unwrap_or_else(PoisonError::into_inner);
            for notice in &pending.notices {
                log::warn!("{}: not acted on, as the program ends", notice.warning.rule);
            }
        }
    }
}

impl Mailbox {
    fn lock(&self) -> MutexGuard<'_, Pending> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next notice; `None` once all is closed.
    fn next(&self) -> Option<Notice> {
        let mut pending = self.lock();
        pending.busy = false;
        self.changed.notify_all();
        loop {
            if let Some(notice) = pending.notices.pop_front() {
                pending.busy = true;
                return Some(notice);
            }
            if pending.closing {
                return None;
            }
            pending = self
                .changed
                .wait(pending)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// A notice of `rule` is done.
    fn done(&self, rule: &str) {
        let mut pending = self.lock();
        let of_rule = |notice: &Notice| notice.warning.rule == rule;
        pending.notices.retain(|n| !(of_rule(n) && n.again));
        if !pending.notices.iter().any(of_rule) {
            pending.undone.remove(rule);
        }
    }

    /// Waits before `notice` is tried again. False if it is not to be: a newer one of its rule is there, or the end.
    fn wait(&self, notice: &Notice, pause: Duration) -> bool {
        let current = |pending: &mut Pending| {
            let newer = |other: &Notice| other.warning.rule == notice.warning.rule;
            !pending.closing && !pending.notices.iter().any(newer)
        };
        let waited = self.changed.wait_timeout_while(self.lock(), pause, current);
        let (mut pending, _) = waited.unwrap_or_else(PoisonError::into_inner);
        current(&mut pending)
    }
}

/// What a worker's thread runs.
struct Doer {
    name: String,
    effect: Effect,
    timeout: Duration,
    attempts: u32,
    mailbox: Arc<Mailbox>,
    emit: Emit,
}

impl Doer {
    /// Before the second attempt; twice as much before each further one, up to `LONGEST_PAUSE`.
    const PAUSE: Duration = Duration::from_millis(100);
    const LONGEST_PAUSE: Duration = Duration::from_secs(2);

    fn run(&self) {
        while let Some(notice) = self.mailbox.next() {
            let mut pause = Self::PAUSE;
            for attempt in 1..=self.attempts {
                let done = self.attempt(&notice, attempt);
                if done {
                    self.mailbox.done(&notice.warning.rule);
                }
                if done || attempt == self.attempts || !self.mailbox.wait(&notice, pause) {
                    break;
                }
                pause = (2 * pause).min(Self::LONGEST_PAUSE);
            }
        }
    }

    fn attempt(&self, notice: &Notice, attempt: u32) -> bool {
        let outcome = perform(&self.effect, notice, self.timeout);
        let Warning { rule, state, .. } = &notice.warning;
        let (done, message) = match outcome {
            Ok(message) => (true, message),
            Err(error) => (false, error.to_string()),
        };
        if done {
            log::info!("{} for {rule}: {message}", self.name);
        } else {
            let attempts = self.attempts;
            log::warn!(
                "{} for {rule}, attempt {attempt} of {attempts}: {message}",
                self.name
            );
        }
        (self.emit)(Event {
            at: SystemTime::now(),
            camera: None,
            kind: EventKind::Action(ActionReport {
                action: self.name.clone(),
                rule: rule.clone(),
                state: *state,
                done,
                message,
                attempt,
                attempts: self.attempts,
                elapsed_ms: 1e3 * notice.since.elapsed().as_secs_f64(),
            }),
        });
        done
    }
}

/// Which of the states that an action is done on a rule was in before, and is in now, itself or as what it counts as.
fn entered(on: &[State], warning: &Warning) -> [Option<State>; 2] {
    let entered = |state: State, acts_as: State| {
        let mut ways = [state, acts_as].into_iter();
        ways.find(|state| on.contains(state))
    };
    let now = entered(warning.state, warning.acts_as);
    let before = warning.before.zip(warning.acted_as);
    [
        before.and_then(|(state, acted_as)| entered(state, acted_as)),
        now,
    ]
}

fn effect(action: &config::Action) -> Effect {
    match (&action.post, &action.dashboard) {
        (Some(url), _) => Effect::Post(url.get_ref().clone()),
        (None, Some(dashboard)) => Effect::Dashboard(dashboard.get_ref().clone()),
        (None, None) => Effect::Run(
            action
                .command
                .as_ref()
                .map(|command| command.get_ref().clone())
                .unwrap_or_default(),
        ),
    }
}

/// A warning as JSON, as events are written to standard output.
fn body_of(warning: &Warning, camera: Option<&str>, at: SystemTime) -> String {
    let at = at
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap_or_default();
    let mut body = json!({
        "schema": 1,
        "type": "event",
        "event": "warning",
        "camera": camera,
        "at_s": at.as_secs_f64(),
    });
    if let (Some(body), Ok(Value::Object(fields))) =
        (body.as_object_mut(), serde_json::to_value(warning))
    {
        body.extend(fields);
    }
    body.to_string()
}

/// One attempt; what was answered.
fn perform(effect: &Effect, notice: &Notice, timeout: Duration) -> Result<String, ActionError> {
    match effect {
        Effect::Run(command) => run(command, notice, timeout),
        Effect::Post(url) => post(url, &notice.body, timeout),
        Effect::Dashboard(dashboard) => {
            dashboard::tell(dashboard, timeout).map_err(|cause| ActionError::Dashboard {
                server: format!("{}:{}", dashboard.host, dashboard.port),
                cause,
            })
        }
    }
}

fn run(command: &[String], notice: &Notice, timeout: Duration) -> Result<String, ActionError> {
    let (program, arguments) = command
        .split_first()
        .map_or(("", command), |(program, rest)| (program.as_str(), rest));
    let failed = |cause| ActionError::Program {
        program: program.to_owned(),
        cause,
    };
    // Standard output is for our own lines.
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .map_err(failed)?;
    // A pipe takes so little at once. Who does not read it need not.
    if let Some(mut stdin) = child.stdin.take() {
        let _ = writeln!(stdin, "{}", notice.body);
    }
    let end = Instant::now() + timeout;
    loop {
        match child.try_wait().map_err(failed)? {
            Some(status) if status.success() => return Ok(format!("{program}: {status}")),
            Some(status) => {
                let program = program.to_owned();
                return Err(ActionError::Status { program, status });
            }
            None if Instant::now() >= end => break,
            None => thread::sleep(Duration::from_millis(10)),
        }
    }
    child.kill().and_then(|()| child.wait()).map_err(failed)?;
    Err(ActionError::Killed {
        program: program.to_owned(),
        after: timeout,
    })
}

fn post(url: &str, body: &str, timeout: Duration) -> Result<String, ActionError> {
    // Alarms are near: neither proxies nor other addresses that somebody names come between.
    let agent: ureq::Agent = ureq::Agent::config_builder()
        .timeout_global(Some(timeout))
        .http_status_as_error(false)
        .max_redirects(0)
        .max_redirects_will_error(false)
        .proxy(None)
        .build()
        .into();
    let answer = agent
        .post(url)
        .content_type("application/json")
        .send(body)
        .map_err(|cause| ActionError::Http {
            url: url.to_owned(),
            cause,
        })?;
    let status = answer.status();
    if status.is_success() {
        Ok(format!("POST {url}: {status}"))
    } else {
        Err(ActionError::Refused {
            url: url.to_owned(),
            status: status.as_u16(),
        })
    }
}
