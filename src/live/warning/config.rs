use std::collections::HashSet;
use std::ops::{Range, RangeInclusive};
use std::time::Duration;

use serde::Deserialize;
use toml::Spanned;

use super::judge::Limits;
use super::{Pose, State, Zone};
use crate::network::Description;

/// What cameras.toml says about warnings: its `[[warning]]` and `[[action]]` tables.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// When it is too close.
    #[serde(default, rename = "warning")]
    pub rules: Vec<Rule>,
    /// What is done then.
    #[serde(default, rename = "action")]
    pub actions: Vec<Action>,
}

/// A `[[warning]]`: how close the robot may come to something.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// Its name, which no other has.
    pub(super) name: Spanned<String>,
    /// The names of the cameras that it looks through.
    pub(super) cameras: Spanned<Vec<Spanned<String>>>,
    /// Which of them must see the robot.
    #[serde(default)]
    pub(super) expect: Expect,
    /// What the robot must not come close to.
    pub(super) protect: Spanned<Protect>,
    /// It is a warning within this distance, in metres.
    pub(super) warn_m: Spanned<f64>,
    /// It is a stop within this distance, in metres.
    pub(super) stop_m: Spanned<f64>,
    /// How much farther than a distance it must be to be less dangerous again, in metres.
    #[serde(default = "hysteresis_m")]
    pub(super) hysteresis_m: Spanned<f64>,
    /// So many frames must agree before anything changes.
    #[serde(default = "agree")]
    pub(super) agree: Spanned<u32>,
    /// A frame says nothing about now once it is older than this, in seconds.
    #[serde(default = "max_age_s")]
    pub(super) max_age_s: Spanned<f64>,
    /// What is taken off measured distances, in metres, where it is more than what the weights' card says.
    pub(super) uncertainty_m: Option<Spanned<f64>>,
    /// What unknown counts as.
    #[serde(default)]
    pub(super) unknown: Policy,
}

/// Which of a rule's cameras must see the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Expect {
    /// Each one; the rule is unknown while one of them does not.
    #[default]
    All,
    /// At least one: cameras that show the same robot, and stand in for each other.
    Any,
}

/// What unknown counts as.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Policy {
    /// Only what acts on unknown itself.
    Ignore,
    /// As a warning.
    #[default]
    Warn,
    /// As a stop.
    Stop,
}

/// What the robot must not come close to.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(
    untagged,
    expecting = "expected \"camera\", or points_m = [[x, y, z], ...] and boxes_m = [{ min = [x, y, z], max = [x, y, z] }, ...] with min no greater than max"
)]
pub enum Protect {
    /// The camera itself, and so who wears it.
    Camera(Itself),
    /// Places in the common frame.
    Places(Places),
}

/// The word for the camera itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub enum Itself {
    /// The camera's optical centre.
    #[serde(rename = "camera")]
    Camera,
}

/// Places in the common frame.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Places {
    /// Points, in metres.
    #[serde(default)]
    pub points_m: Vec<[f64; 3]>,
    /// Boxes along the axes, in metres.
    #[serde(default)]
    pub boxes_m: Vec<Zone>,
}

/// An `[[action]]`: what is done when a rule's state changes. It has one of `command`, `post` and `dashboard`.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Action {
    /// Its name, which no other has.
    pub(super) name: Spanned<String>,
    /// The states that it is done for.
    pub(super) on: Spanned<Vec<State>>,
    /// The rules that it is done for; all where none are named.
    pub(super) warnings: Option<Vec<Spanned<String>>>,
    /// A program and its arguments. It gets the warning as JSON on its standard input.
    pub(super) command: Option<Spanned<Vec<String>>>,
    /// Where the warning is posted to as JSON.
    pub(super) post: Option<Spanned<String>>,
    /// A robot that is told to pause or stop.
    pub(super) dashboard: Option<Spanned<Dashboard>>,
    /// How long one attempt may take, in seconds.
    #[serde(default = "timeout_s")]
    pub(super) timeout_s: Spanned<f64>,
    /// How often it is tried.
    #[serde(default = "attempts")]
    pub(super) attempts: Spanned<u32>,
}

/// A Universal Robots controller's dashboard server.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dashboard {
    /// The controller's name or address.
    pub host: String,
    /// The dashboard server's port.
    #[serde(default = "dashboard_port")]
    pub port: u16,
    /// What it is told.
    pub send: DashboardCommand,
}

/// What a dashboard server is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DashboardCommand {
    /// The program pauses, and can be continued.
    Pause,
    /// The program ends.
    Stop,
}

fn hysteresis_m() -> Spanned<f64> {
    Spanned::new(0..0, 0.1)
}

fn agree() -> Spanned<u32> {
    Spanned::new(0..0, 2)
}

fn max_age_s() -> Spanned<f64> {
    Spanned::new(0..0, 1.0)
}

fn timeout_s() -> Spanned<f64> {
    Spanned::new(0..0, 2.0)
}

fn attempts() -> Spanned<u32> {
    Spanned::new(0..0, 3)
}

fn dashboard_port() -> u16 {
    29999
}

/// A camera as rules see it, in the configuration's order.
#[derive(Debug, Clone, PartialEq)]
pub struct Observer {
    /// Its name.
    pub name: String,
    /// Where it is in the common frame, where that is known.
    pub world_from_camera: Option<Pose>,
    /// How far off its robot's joints are, in metres: [`uncertainty_m`] of its weights.
    pub uncertainty_m: Option<f64>,
}

/// How far off joints are according to a model's card, in metres: the mean error of the full system on the images that it
/// was judged on (`figures.estimated_mask_mean_cm`).
pub fn uncertainty_m(description: &Description) -> Option<f64> {
    let centimetres = description
        .card
        .get("figures")?
        .get("estimated_mask_mean_cm")?
        .as_f64()?;
    (centimetres.is_finite() && centimetres >= 0.0).then_some(centimetres / 100.0)
}

/// What is wrong with warnings in cameras.toml, and where.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key}: expected {expected}, found {found}")]
pub struct ConfigError {
    /// Bytes of the file's text.
    pub span: Range<usize>,
    /// The key, such as `warning.stop_m`.
    pub key: &'static str,
    /// What was expected.
    pub expected: String,
    /// What is there.
    pub found: String,
}

impl ConfigError {
    fn new(
        span: Range<usize>,
        key: &'static str,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> Self {
        Self {
            span,
            key,
            expected: expected.into(),
            found: found.into(),
        }
    }
}

/// Checks a number.
fn number(
    key: &'static str,
    value: &Spanned<f64>,
    range: RangeInclusive<f64>,
    expected: &str,
) -> Result<(), ConfigError> {
    let found = *value.get_ref();
    if range.contains(&found) {
        Ok(())
    } else {
        Err(ConfigError::new(
            value.span(),
            key,
            expected,
            found.to_string(),
        ))
    }
}

/// Checks a count.
fn count(key: &'static str, value: &Spanned<u32>) -> Result<(), ConfigError> {
    let found = *value.get_ref();
    if (1..=100).contains(&found) {
        Ok(())
    } else {
        Err(ConfigError::new(
            value.span(),
            key,
            "1 to 100",
            found.to_string(),
        ))
    }
}

/// Checks that names are there, and are each other's only ones.
fn names<'a>(
    key: &'static str,
    names: impl Iterator<Item = &'a Spanned<String>>,
) -> Result<(), ConfigError> {
    let mut seen = HashSet::new();
    for name in names {
        let found = name.get_ref().as_str();
        if found.is_empty() {
            return Err(ConfigError::new(name.span(), key, "a name", "none"));
        }
        if !seen.insert(found) {
            return Err(ConfigError::new(
                name.span(),
                key,
                "each name once",
                format!("a second \"{found}\""),
            ));
        }
    }
    Ok(())
}

impl Config {
    /// Checks what the types do not say, with the cameras of the same file.
    ///
    /// # Errors
    /// The first thing that is wrong, and where.
    pub fn check(&self, cameras: &[Observer]) -> Result<(), ConfigError> {
        names("warning.name", self.rules.iter().map(|rule| &rule.name))?;
        for rule in &self.rules {
            rule.check(cameras)?;
        }
        names(
            "action.name",
            self.actions.iter().map(|action| &action.name),
        )?;
        for action in &self.actions {
            if self.rules.is_empty() {
                let expected = "a [[warning]] that it acts on";
                return Err(ConfigError::new(
                    action.name.span(),
                    "action",
                    expected,
                    "none",
                ));
            }
            action.check(&self.rules)?;
        }
        Ok(())
    }
}

impl Rule {
    fn check(&self, cameras: &[Observer]) -> Result<(), ConfigError> {
        let metres = "metres greater than 0";
        number(
            "warning.stop_m",
            &self.stop_m,
            f64::MIN_POSITIVE..=f64::MAX,
            metres,
        )?;
        number(
            "warning.warn_m",
            &self.warn_m,
            f64::MIN_POSITIVE..=f64::MAX,
            metres,
        )?;
        let [warn_m, stop_m] = [&self.warn_m, &self.stop_m].map(|value| *value.get_ref());
        if stop_m >= warn_m {
            return Err(ConfigError::new(
                self.stop_m.span(),
                "warning.stop_m",
                format!("less than warn_m, which is {warn_m}"),
                stop_m.to_string(),
            ));
        }
        let metres = "metres, at least 0";
        number(
            "warning.hysteresis_m",
            &self.hysteresis_m,
            0.0..=f64::MAX,
            metres,
        )?;
        if let Some(uncertainty_m) = &self.uncertainty_m {
            number(
                "warning.uncertainty_m",
                uncertainty_m,
                0.0..=f64::MAX,
                metres,
            )?;
        }
        // Beyond an hour an answer is no news.
        number(
            "warning.max_age_s",
            &self.max_age_s,
            0.001..=3600.0,
            "seconds, 0.001 to 3600",
        )?;
        count("warning.agree", &self.agree)?;
        if let Protect::Places(places) = self.protect.get_ref() {
            let wrong = |expected: &str, found: String| {
                ConfigError::new(self.protect.span(), "warning.protect", expected, found)
            };
            if places.points_m.is_empty() && places.boxes_m.is_empty() {
                return Err(wrong("at least one point or box", "none".into()));
            }
            let infinite = |point: &&[f64; 3]| !point.iter().all(|v| v.is_finite());
            if let Some(point) = places.points_m.iter().find(infinite) {
                return Err(wrong("points in finite metres", format!("{point:?}")));
            }
        }
        if self.cameras.get_ref().is_empty() {
            return Err(ConfigError::new(
                self.cameras.span(),
                "warning.cameras",
                "at least one camera's name",
                "none",
            ));
        }
        names("warning.cameras", self.cameras.get_ref().iter())?;
        for name in self.cameras.get_ref() {
            self.check_camera(name, cameras)?;
        }
        Ok(())
    }

    fn check_camera(
        &self,
        name: &Spanned<String>,
        cameras: &[Observer],
    ) -> Result<(), ConfigError> {
        let wrong = |expected: &str, found: String| {
            ConfigError::new(name.span(), "warning.cameras", expected, found)
        };
        let Some(camera) = cameras.iter().find(|camera| camera.name == *name.get_ref()) else {
            let found = format!("\"{}\"", name.get_ref());
            return Err(wrong("the name of a [[camera]]", found));
        };
        if matches!(self.protect.get_ref(), Protect::Places(_))
            && camera.world_from_camera.is_none()
        {
            return Err(wrong(
                "cameras with world_from_camera, as places are in the common frame",
                format!("\"{}\" without", camera.name),
            ));
        }
        if self.uncertainty_m(camera).is_none() {
            return Err(wrong(
                "uncertainty_m, as the weights' card has no figures.estimated_mask_mean_cm",
                format!("\"{}\" without", camera.name),
            ));
        }
        Ok(())
    }

    /// What is taken off distances that this camera measures, in metres: the greater of what the card and the rule say.
    pub(super) fn uncertainty_m(&self, camera: &Observer) -> Option<f64> {
        let own = self.uncertainty_m.as_ref().map(|value| *value.get_ref());
        [camera.uncertainty_m, own]
            .into_iter()
            .flatten()
            .max_by(f64::total_cmp)
    }

    pub(super) fn limits(&self) -> Limits {
        Limits {
            warn_m: *self.warn_m.get_ref(),
            stop_m: *self.stop_m.get_ref(),
            hysteresis_m: *self.hysteresis_m.get_ref(),
            agree: usize::try_from(*self.agree.get_ref()).unwrap_or(usize::MAX),
            max_age: Duration::from_secs_f64(*self.max_age_s.get_ref()),
        }
    }
}

impl Action {
    fn check(&self, rules: &[Rule]) -> Result<(), ConfigError> {
        if self.on.get_ref().is_empty() {
            return Err(ConfigError::new(
                self.on.span(),
                "action.on",
                "at least one of clear, warn, stop, unknown",
                "none",
            ));
        }
        for name in self.warnings.iter().flatten() {
            if !rules
                .iter()
                .any(|rule| rule.name.get_ref() == name.get_ref())
            {
                return Err(ConfigError::new(
                    name.span(),
                    "action.warnings",
                    "the name of a [[warning]]",
                    format!("\"{}\"", name.get_ref()),
                ));
            }
        }
        number(
            "action.timeout_s",
            &self.timeout_s,
            0.01..=60.0,
            "seconds, 0.01 to 60",
        )?;
        count("action.attempts", &self.attempts)?;
        match (&self.command, &self.post, &self.dashboard) {
            (Some(command), None, None) => match command.get_ref().first() {
                Some(program) if !program.is_empty() => Ok(()),
                _ => Err(ConfigError::new(
                    command.span(),
                    "action.command",
                    "a program and its arguments",
                    "none",
                )),
            },
            (None, Some(url), None) => check_url(url),
            (None, None, Some(dashboard)) => {
                if dashboard.get_ref().host.is_empty() {
                    return Err(ConfigError::new(
                        dashboard.span(),
                        "action.dashboard",
                        "the controller's host",
                        "none",
                    ));
                }
                Ok(())
            }
            (command, post, dashboard) => {
                let there = [
                    command.is_some().then_some("command"),
                    post.is_some().then_some("post"),
                    dashboard.is_some().then_some("dashboard"),
                ];
                let there: Vec<_> = there.into_iter().flatten().collect();
                let found = if there.is_empty() {
                    "none".to_owned()
                } else {
                    there.join(", ")
                };
                Err(ConfigError::new(
                    self.name.span(),
                    "action",
                    "one of command, post, dashboard",
                    found,
                ))
            }
        }
    }
}

fn check_url(url: &Spanned<String>) -> Result<(), ConfigError> {
    let wrong = |expected: &str, found: String| {
        Err(ConfigError::new(url.span(), "action.post", expected, found))
    };
    let text = url.get_ref();
    match text.parse::<ureq::http::Uri>() {
        Ok(uri) if uri.host().is_some_and(|host| !host.is_empty()) => match uri.scheme_str() {
            Some("http") => Ok(()),
            Some("https") => wrong(
                "an http:// address; for https, command = [\"curl\", \"--fail\", \"--silent\", \"--json\", \"@-\", \"https://...\"]",
                format!("\"{text}\""),
            ),
            _ => wrong("an http:// address", format!("\"{text}\"")),
        },
        _ => wrong("an http:// address", format!("\"{text}\"")),
    }
}
