//! The local page: what all cameras show and what was found there, alarms, rates and events, in a browser.
//!
//! [`Server`] answers on a port of this machine; its [`PageSink`] takes results without a wait. Pictures are encoded
//! only while a client watches. Whoever is not on this machine needs the token in [`Server::url`].

mod http;
mod state;
mod tile;

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use serde::Serialize;
use subtle::ConstantTimeEq;

use self::http::{Answer, Request};
use self::state::Board;
use super::{Event, Observation, Sink, Statistics};
use crate::camera::Intrinsics;

/// Connections at a time; a browser's tab holds one or two.
const MOST_CLIENTS: usize = 64;

const HTML: &str = "text/html; charset=utf-8";
const JAVASCRIPT: &str = "text/javascript; charset=utf-8";

/// By the paths that they are asked for.
static FILES: [(&str, &str, &str); 5] = [
    ("", HTML, include_str!("index.html")),
    (
        "style.css",
        "text/css; charset=utf-8",
        include_str!("style.css"),
    ),
    ("page.js", JAVASCRIPT, include_str!("page.js")),
    ("scene.js", JAVASCRIPT, include_str!("scene.js")),
    ("icon.svg", "image/svg+xml", include_str!("icon.svg")),
];

/// What the page has to know about a camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraInfo {
    /// Its name.
    pub name: String,
    /// The robot that is looked for, as the model names it.
    pub robot: String,
    /// The pinhole of the model's networks, which [`Mask`](crate::cascade::Mask) is seen through.
    #[serde(skip)]
    pub canonical: Intrinsics,
    /// Takes points of the camera's optical frame, in metres, to a frame that cameras share, z up: 4 x 4, row by
    /// row. Cameras that have it are shown together.
    pub common_from_camera: Option<[[f64; 4]; 4]>,
}

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PageError {
    /// The address is none that this machine can listen on.
    #[error("page on {address}: {cause}")]
    Address {
        /// As it was given.
        address: String,
        /// What the system said.
        cause: io::Error,
    },
    /// There is no token, as the system gives no random bytes.
    #[error("page: no random token: {0}")]
    Random(#[from] getrandom::Error),
    /// There is no thread for it.
    #[error("page: no thread: {0}")]
    Thread(io::Error),
}

/// A page, until it is dropped.
#[derive(Debug)]
pub struct Server {
    site: Arc<Site>,
    address: SocketAddr,
    closed: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

/// Where a page's results go. Nothing that a client does can make it wait.
#[derive(Debug)]
pub struct PageSink {
    board: Arc<Board>,
}

/// What clients can ask for.
#[derive(Debug)]
struct Site {
    board: Arc<Board>,
    /// The path's first segment; none where only this machine can ask.
    token: Option<String>,
    /// A name that the page may be asked for by.
    host: String,
}

impl Server {
    /// A page of `cameras` at `address`, `HOST:PORT`; port 0 is any that is free. On an address that other machines
    /// reach it makes a random token, without which it says nothing.
    ///
    /// # Errors
    /// An address that is none, is in use or is not this machine's; a system without random bytes or threads.
    pub fn bind(address: &str, cameras: Vec<CameraInfo>) -> Result<Self, PageError> {
        let wrong = |cause| PageError::Address {
            address: address.to_owned(),
            cause,
        };
        let listener = TcpListener::bind(address).map_err(wrong)?;
        let bound = listener.local_addr().map_err(wrong)?;
        let token = if bound.ip().is_loopback() {
            None
        } else {
            let mut bytes = [0; 16];
            getrandom::fill(&mut bytes)?;
            Some(format!("{:032x}", u128::from_le_bytes(bytes)))
        };
        let site = Arc::new(Site {
            board: Arc::new(Board::new(cameras)),
            token,
            host: without_port(address).to_owned(),
        });
        let closed = Arc::new(AtomicBool::new(false));
        let mut server = Self {
            site: site.clone(),
            address: bound,
            closed: closed.clone(),
            threads: Vec::new(),
        };
        let board = site.board.clone();
        server.spawn("page painter", move || board.paint())?;
        server.spawn("page", move || listen(&listener, &site, &closed))?;
        Ok(server)
    }

    /// Where to open it, with the token where there is one.
    pub fn url(&self) -> String {
        let ip = match self.address.ip() {
            ip if ip.is_unspecified() => own_address().unwrap_or(Ipv4Addr::LOCALHOST.into()),
            ip => ip,
        };
        let address = SocketAddr::new(ip, self.address.port());
        match &self.site.token {
            Some(token) => format!("http://{address}/{token}/"),
            None => format!("http://{address}/"),
        }
    }

    /// A way in for results, with masks where those are to be seen; there may be several.
    pub fn sink(&self) -> PageSink {
        PageSink {
            board: self.site.board.clone(),
        }
    }

    fn spawn(&mut self, name: &str, run: impl FnOnce() + Send + 'static) -> Result<(), PageError> {
        let thread = Builder::new().name(name.into()).spawn(run);
        self.threads.push(thread.map_err(PageError::Thread)?);
        Ok(())
    }
}

impl Drop for Server {
    /// Closes the port. Clients in the middle of an answer end by themselves.
    fn drop(&mut self) {
        self.closed.store(true, Ordering::Relaxed);
        self.site.board.close();
        // The listener waits for somebody.
        let ip = match self.address.ip() {
            IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
            IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
            ip => ip,
        };
        let address = SocketAddr::new(ip, self.address.port());
        if TcpStream::connect_timeout(&address, Duration::from_millis(300)).is_ok() {
            for thread in self.threads.drain(..) {
                // One that panicked has said so.
                let _ = thread.join();
            }
        }
    }
}

impl Sink for PageSink {
    fn observation(&mut self, observation: &Observation) {
        self.board.observe(observation);
    }

    fn event(&mut self, event: &Event) {
        self.board.tell(event);
    }

    fn statistics(&mut self, statistics: &Statistics) {
        self.board.count(statistics);
    }
}

fn listen(listener: &TcpListener, site: &Arc<Site>, closed: &AtomicBool) {
    // A client's thread holds one.
    let seats = Arc::new(());
    for stream in listener.incoming() {
        if closed.load(Ordering::Relaxed) {
            return;
        }
        match stream {
            Ok(stream) if Arc::strong_count(&seats) > MOST_CLIENTS => http::turn_away(stream),
            Ok(stream) => {
                let (site, seat) = (site.clone(), seats.clone());
                let client = Builder::new().name("page client".into()).spawn(move || {
                    http::serve(stream, |request| {
                        let answer = site.answer(request);
                        // A browser keeps its connection, and would take an ended program for a live one.
                        (!site.board.is_closed()).then_some(answer)
                    });
                    drop(seat);
                });
                if let Err(error) = client {
                    log::warn!("page: no thread for a client: {error}");
                }
            }
            Err(error) => {
                // Such as no file handle left: it will not be better at once.
                log::warn!("page: {error}");
                std::thread::sleep(Duration::from_millis(100));
            }
        }
    }
}

impl Site {
    fn answer(&self, request: &Request) -> Answer {
        if !self.is_own_host(&request.host) {
            let why = "expected this machine's address in the header Host: open the page by that";
            return Answer::refusal("421 Misdirected Request", why);
        }
        let Some(path) = self.without_token(&request.path) else {
            let why =
                "expected the token in the address: the program said it on stderr at its start";
            return Answer::refusal("403 Forbidden", why);
        };
        if let Some((_, kind, text)) = FILES.iter().find(|(name, ..)| *name == path) {
            return Answer::new(kind, vec![text.as_bytes().into()]);
        }
        if path != "changes" {
            return Answer::refusal("404 Not Found", "there is no such thing here");
        }
        match known_and_owed(&request.query) {
            Some((known, owed)) => {
                let parts = self.board.changes_since(known, &owed);
                Answer::new("application/octet-stream", parts)
            }
            None => {
                let why = "expected ?since=NUMBER or ?since=NUMBER&owed=CAMERA,CAMERA,...";
                Answer::refusal("400 Bad Request", why)
            }
        }
    }

    /// Whether a browser that was asked for `host` means this machine. A page of somebody else's whose name was
    /// pointed here (DNS rebinding) is asked for by that name, never by an address.
    fn is_own_host(&self, host: &str) -> bool {
        let name = without_port(host);
        let address = name.trim_start_matches('[').trim_end_matches(']');
        address.parse::<IpAddr>().is_ok()
            || name.eq_ignore_ascii_case("localhost")
            || name.eq_ignore_ascii_case(&self.host)
    }

    /// What is behind the token; `None` without the right one.
    fn without_token<'a>(&self, path: &'a str) -> Option<&'a str> {
        let path = path.strip_prefix('/')?;
        let Some(token) = &self.token else {
            return Some(path);
        };
        let (given, path) = path.split_once('/')?;
        let right = given.as_bytes().ct_eq(token.as_bytes());
        bool::from(right).then_some(path)
    }
}

/// Of `since=NUMBER&owed=CAMERA,CAMERA,...`, the latter only if there are any.
fn known_and_owed(query: &str) -> Option<(u64, Vec<usize>)> {
    let query = query.strip_prefix("since=")?;
    let Some((known, owed)) = query.split_once("&owed=") else {
        return Some((query.parse().ok()?, Vec::new()));
    };
    let owed: Result<_, _> = owed.split(',').map(str::parse).collect();
    Some((known.parse().ok()?, owed.ok()?))
}

/// Of `HOST:PORT` or `HOST`.
fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    }
}

/// The address that this machine has towards others. Nothing is sent to find it.
fn own_address() -> Option<IpAddr> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
    // An address for documentation (RFC 5737), so on no network near.
    socket.connect((Ipv4Addr::new(192, 0, 2, 1), 9)).ok()?;
    Some(socket.local_addr().ok()?.ip())
}
