//! The dashboard server of Universal Robots controllers (CB3 and e-series): lines of text over TCP, one answer a command.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use super::config::{Dashboard, DashboardCommand};

/// Why a dashboard server did not do what it was told.
#[derive(Debug, thiserror::Error)]
pub enum DashboardError {
    /// The connection failed.
    #[error("{during}: {cause}")]
    Io {
        during: &'static str,
        cause: std::io::Error,
    },
    /// It took too long.
    #[error("{during}: no answer in time")]
    Timeout { during: &'static str },
    /// Something else is on the other side, or the robot is not under remote control.
    #[error("{during}: expected {expected}, found \"{found}\"")]
    Answer {
        during: &'static str,
        expected: &'static str,
        found: String,
    },
    /// It answered well, and the robot runs on.
    #[error("it answered \"{answer}\", but the program still runs: \"{state}\"")]
    Running { answer: String, state: String },
}

/// Tells a robot to pause or stop, and reads back that its program does not run. What was answered.
///
/// # Errors
/// Where it is not sure within `timeout` that the program does not run.
pub fn tell(dashboard: &Dashboard, timeout: Duration) -> Result<String, DashboardError> {
    let mut connection = Connection::open(dashboard, Instant::now() + timeout)?;
    let answer = match dashboard.send {
        DashboardCommand::Pause => connection.ask("pause")?,
        DashboardCommand::Stop => connection.ask("stop")?,
    };
    let accepted = match dashboard.send {
        DashboardCommand::Pause => answer == "Pausing program",
        DashboardCommand::Stop => answer == "Stopped",
    };
    // It also fails where no program runs, and then all is well: the state tells.
    let failed = answer.starts_with("Failed to execute");
    if !accepted && !failed {
        return Err(DashboardError::Answer {
            during: dashboard.send.name(),
            expected: "\"Pausing program\", \"Stopped\" or \"Failed to execute\"",
            found: answer,
        });
    }
    loop {
        let (runs, state) = connection.runs(dashboard.send)?;
        if !runs {
            return Ok(format!("{answer}; {state}"));
        }
        // A program that was told to pause may take a moment.
        let left = connection.end.saturating_duration_since(Instant::now());
        if failed || left < 2 * POLL {
            return Err(DashboardError::Running { answer, state });
        }
        thread::sleep(POLL);
    }
}

/// Between two questions whether the program still runs.
const POLL: Duration = Duration::from_millis(50);

/// The longest line that is read, in bytes.
const LONGEST: usize = 1024;

impl DashboardCommand {
    fn name(self) -> &'static str {
        match self {
            Self::Pause => "pause",
            Self::Stop => "stop",
        }
    }
}

struct Connection {
    stream: TcpStream,
    /// What was read beyond the last line.
    rest: Vec<u8>,
    end: Instant,
}

impl Connection {
    fn open(dashboard: &Dashboard, end: Instant) -> Result<Self, DashboardError> {
        let during = "connecting";
        let addresses = resolve(dashboard, end)?;
        let mut failure = DashboardError::Timeout { during };
        for address in addresses {
            match TcpStream::connect_timeout(&address, left(end, during)?) {
                Ok(stream) => {
                    let mut connection = Self {
                        stream,
                        rest: Vec::new(),
                        end,
                    };
                    connection.greeting()?;
                    return Ok(connection);
                }
                Err(cause) => failure = io(during)(cause),
            }
        }
        Err(failure)
    }

    fn greeting(&mut self) -> Result<(), DashboardError> {
        let during = "greeting";
        let found = self.line(during)?;
        if found.starts_with("Connected: Universal Robots Dashboard Server") {
            Ok(())
        } else {
            Err(DashboardError::Answer {
                during,
                expected: "\"Connected: Universal Robots Dashboard Server\"",
                found,
            })
        }
    }

    /// Sends a command; its answer.
    fn ask(&mut self, command: &'static str) -> Result<String, DashboardError> {
        let timeout = left(self.end, command)?;
        self.stream
            .set_write_timeout(Some(timeout))
            .and_then(|()| self.stream.write_all(format!("{command}\n").as_bytes()))
            .map_err(io(command))?;
        self.line(command)
    }

    /// Whether the program runs, and how it was said. After a stop `running` tells; a paused program's state is asked for
    /// by name, as `running` is not documented for it.
    fn runs(&mut self, told: DashboardCommand) -> Result<(bool, String), DashboardError> {
        let (question, expected, yes, no): (_, _, _, &[&str]) = match told {
            DashboardCommand::Stop => (
                "running",
                "\"Program running: true\" or \"false\"",
                "program running: true",
                &["program running: false"],
            ),
            DashboardCommand::Pause => (
                "programState",
                "\"PLAYING\", \"PAUSED\" or \"STOPPED\"",
                "playing",
                &["paused", "stopped"],
            ),
        };
        let found = self.ask(question)?;
        let lower = found.to_lowercase();
        if lower.starts_with(yes) {
            Ok((true, found))
        } else if no.iter().any(|no| lower.starts_with(no)) {
            Ok((false, found))
        } else {
            Err(DashboardError::Answer {
                during: question,
                expected,
                found,
            })
        }
    }

    /// Reads a line, without its end.
    fn line(&mut self, during: &'static str) -> Result<String, DashboardError> {
        loop {
            if let Some(end) = self.rest.iter().position(|&byte| byte == b'\n') {
                let line: Vec<u8> = self.rest.drain(..=end).collect();
                return Ok(String::from_utf8_lossy(&line).trim().to_owned());
            }
            if self.rest.len() > LONGEST {
                let start = self.rest.iter().take(40).copied().collect::<Vec<_>>();
                return Err(DashboardError::Answer {
                    during,
                    expected: "a line",
                    found: format!("{}...", String::from_utf8_lossy(&start)),
                });
            }
            let mut buffer = [0; 256];
            self.stream
                .set_read_timeout(Some(left(self.end, during)?))
                .map_err(io(during))?;
            let read = self.stream.read(&mut buffer).map_err(io(during))?;
            if read == 0 {
                return Err(io(during)(ErrorKind::UnexpectedEof.into()));
            }
            self.rest.extend(buffer.iter().take(read));
        }
    }
}

/// The addresses of a host. The system's resolver knows no time-outs, so a thread waits for it.
fn resolve(dashboard: &Dashboard, end: Instant) -> Result<Vec<SocketAddr>, DashboardError> {
    let during = "looking up the host";
    let (sender, receiver) = mpsc::channel();
    let host = (dashboard.host.clone(), dashboard.port);
    thread::Builder::new()
        .name("resolver".into())
        .spawn(move || {
            let found = host.to_socket_addrs().map(Iterator::collect);
            // Nobody waits any more: too late.
            let _ = sender.send(found);
        })
        .map_err(io(during))?;
    receiver
        .recv_timeout(left(end, during)?)
        .map_err(|_| DashboardError::Timeout { during })?
        .map_err(io(during))
}

/// The time that is left.
fn left(end: Instant, during: &'static str) -> Result<Duration, DashboardError> {
    let left = end.saturating_duration_since(Instant::now());
    if left.is_zero() {
        Err(DashboardError::Timeout { during })
    } else {
        Ok(left)
    }
}

fn io(during: &'static str) -> impl Fn(std::io::Error) -> DashboardError {
    move |cause| match cause.kind() {
        ErrorKind::WouldBlock | ErrorKind::TimedOut => DashboardError::Timeout { during },
        _ => DashboardError::Io { during, cause },
    }
}
