//! As much of HTTP/1.1 (RFC 9112) as a page needs: GET and HEAD, no bodies, every wait with an end.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// The most that a request's line and headers may take, in bytes.
const LONGEST_HEAD: usize = 16 * 1024;
const MOST_HEADERS: usize = 64;
/// Within which a connection's first request must have come: whoever connects and says nothing keeps others out.
const FIRST_REQUEST_LIMIT: Duration = Duration::from_secs(1);
/// Within which a further one must have come, counted from the last answer.
const REQUEST_LIMIT: Duration = Duration::from_secs(5);
/// Within which a client must have taken so much of an answer as [`PIECE`], or what is left of it.
const PIECE_LIMIT: Duration = Duration::from_secs(5);
/// In bytes: a slow line takes as many in that time, one that is as good as none does not.
const PIECE: usize = 32 * 1024;

const OK: &str = "200 OK";

/// What a client asks for.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Request {
    /// Of the target, what is before a `?`.
    pub path: String,
    /// What is behind it.
    pub query: String,
    /// The header `Host`.
    pub host: String,
    /// Only the answer's headers are wanted.
    head: bool,
    /// Another request may follow.
    again: bool,
}

/// What a client gets.
#[derive(Debug)]
pub(super) struct Answer {
    status: &'static str,
    kind: &'static str,
    /// Of the body, one after the other.
    parts: Vec<Arc<[u8]>>,
}

impl Answer {
    pub fn new(kind: &'static str, parts: Vec<Arc<[u8]>>) -> Self {
        Self {
            status: OK,
            kind,
            parts,
        }
    }

    /// A status other than 200, and a sentence for people.
    pub fn refusal(status: &'static str, why: &str) -> Self {
        Self {
            status,
            kind: "text/plain; charset=utf-8",
            parts: vec![format!("{why}\n").into_bytes().into()],
        }
    }

    fn headers(&self, again: bool) -> String {
        let Self { status, kind, .. } = self;
        let length: usize = self.parts.iter().map(|part| part.len()).sum();
        let connection = if again { "keep-alive" } else { "close" };
        format!(
            "HTTP/1.1 {status}\r\n\
             Content-Type: {kind}\r\n\
             Content-Length: {length}\r\n\
             Connection: {connection}\r\n\
             Cache-Control: no-store\r\n\
             Content-Security-Policy: default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n\
             Cross-Origin-Opener-Policy: same-origin\r\n\
             Cross-Origin-Resource-Policy: same-origin\r\n\
             Referrer-Policy: no-referrer\r\n\
             X-Content-Type-Options: nosniff\r\n\r\n"
        )
    }
}

/// Why a connection ends.
enum End {
    /// The client went, or said nothing.
    Gone,
    /// It is told why.
    Refused(Answer),
}

/// A client's connection.
struct Connection {
    stream: TcpStream,
    /// What was read and is not yet used.
    buffer: Vec<u8>,
}

/// Answers the requests of a client until it goes, asks for what cannot be, is too slow, or there is no answer.
pub(super) fn serve(stream: TcpStream, answer: impl Fn(&Request) -> Option<Answer>) {
    // Without it small answers wait; where it fails they do.
    let _ = stream.set_nodelay(true);
    let mut connection = Connection {
        stream,
        buffer: Vec::new(),
    };
    let mut limit = FIRST_REQUEST_LIMIT;
    loop {
        match connection.request(limit) {
            Ok(request) => {
                let Some(answer) = answer(&request) else {
                    return;
                };
                // Who is refused, such as for want of the token, keeps no seat either.
                let again = request.again && answer.status == OK;
                let sent = connection.send(&answer, again, request.head);
                if sent.is_err() || !again {
                    return;
                }
                limit = REQUEST_LIMIT;
            }
            Err(End::Gone) => return,
            Err(End::Refused(answer)) => {
                if connection.send(&answer, false, false).is_ok() {
                    connection.linger();
                }
                return;
            }
        }
    }
}

/// Turns a client away, without a wait.
pub(super) fn turn_away(stream: TcpStream) {
    let answer = Answer::refusal(
        "503 Service Unavailable",
        "too many clients: close some of them",
    );
    let mut connection = Connection {
        stream,
        buffer: Vec::new(),
    };
    // So little fits into the system's buffer.
    let _ = connection.send(&answer, false, false);
}

impl Connection {
    fn request(&mut self, limit: Duration) -> Result<Request, End> {
        let until = Instant::now() + limit;
        loop {
            if let Some((request, length)) = parse(&self.buffer).map_err(End::Refused)? {
                self.buffer.drain(..length);
                return Ok(request);
            }
            if self.buffer.len() >= LONGEST_HEAD {
                return Err(End::Refused(too_large()));
            }
            let mut bytes = [0; 4096];
            let read = self
                .stream
                .set_read_timeout(Some(left(until)))
                .and_then(|()| self.stream.read(&mut bytes));
            match read {
                Ok(0) => return Err(End::Gone),
                Ok(length) => self.buffer.extend(bytes.iter().take(length)),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if is_timeout(&error) && !self.buffer.is_empty() => {
                    let why = "the request did not come in time";
                    return Err(End::Refused(Answer::refusal("408 Request Timeout", why)));
                }
                Err(_) => return Err(End::Gone),
            }
        }
    }

    fn send(&mut self, answer: &Answer, again: bool, head: bool) -> io::Result<()> {
        let mut bytes = answer.headers(again).into_bytes();
        if !head {
            bytes.extend(answer.parts.concat());
        }
        bytes.chunks(PIECE).try_for_each(|piece| self.write(piece))
    }

    /// `write_all`, but a client that takes a byte now and then does not win time by it.
    fn write(&mut self, mut bytes: &[u8]) -> io::Result<()> {
        let until = Instant::now() + PIECE_LIMIT;
        while !bytes.is_empty() {
            if Instant::now() >= until {
                return Err(io::ErrorKind::TimedOut.into());
            }
            self.stream.set_write_timeout(Some(left(until)))?;
            match self.stream.write(bytes) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(length) => bytes = bytes.get(length..).unwrap_or_default(),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Reads what a refused client still sends, for a moment: a connection that is closed before may lose the refusal.
    fn linger(&mut self) {
        let until = Instant::now() + Duration::from_secs(1);
        let _ = self.stream.shutdown(Shutdown::Write);
        let mut bytes = [0; 4096];
        while Instant::now() < until {
            let read = self
                .stream
                .set_read_timeout(Some(left(until)))
                .and_then(|()| self.stream.read(&mut bytes));
            if !matches!(read, Ok(length) if length > 0) {
                return;
            }
        }
    }
}

/// A request at the start of `bytes`, and its length; `None` while it is not whole.
fn parse(bytes: &[u8]) -> Result<Option<(Request, usize)>, Answer> {
    let bad = |why: &str| Answer::refusal("400 Bad Request", why);
    let mut headers = [httparse::EMPTY_HEADER; MOST_HEADERS];
    let mut parsed = httparse::Request::new(&mut headers);
    let length = match parsed.parse(bytes) {
        Ok(httparse::Status::Complete(length)) => length,
        Ok(httparse::Status::Partial) => return Ok(None),
        Err(httparse::Error::TooManyHeaders) => return Err(too_large()),
        Err(error) => return Err(bad(&format!("not HTTP/1.1: {error}"))),
    };
    if length > LONGEST_HEAD {
        return Err(too_large());
    }
    let head = match parsed.method {
        Some("GET") => false,
        Some("HEAD") => true,
        _ => {
            let why = "expected GET or HEAD: nothing can be changed here";
            return Err(Answer::refusal("405 Method Not Allowed", why));
        }
    };
    let of_name = |name: &'static str| {
        let named = move |header: &&httparse::Header<'_>| header.name.eq_ignore_ascii_case(name);
        parsed.headers.iter().filter(named).map(|h| h.value)
    };
    if of_name("Transfer-Encoding").next().is_some()
        || of_name("Content-Length").any(|value| value != b"0")
    {
        return Err(bad("expected no body"));
    }
    let mut hosts = of_name("Host");
    let (Some(host), None) = (hosts.next(), hosts.next()) else {
        return Err(bad("expected one header Host"));
    };
    let close = |value: &[u8]| value.eq_ignore_ascii_case(b"close");
    let target = parsed.path.unwrap_or_default();
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    let request = Request {
        path: path.to_owned(),
        query: query.to_owned(),
        host: String::from_utf8_lossy(host).into_owned(),
        head,
        again: parsed.version == Some(1) && !of_name("Connection").any(close),
    };
    Ok(Some((request, length)))
}

fn too_large() -> Answer {
    let why = format!("expected at most {LONGEST_HEAD} bytes and {MOST_HEADERS} headers");
    Answer::refusal("431 Request Header Fields Too Large", &why)
}

/// Until then; the system refuses to wait for no time at all.
fn left(until: Instant) -> Duration {
    let left = until.saturating_duration_since(Instant::now());
    left.max(Duration::from_millis(1))
}

fn is_timeout(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut
    )
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::net::TcpListener;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;

    /// What comes of sending a large answer to a client that takes at most so many bytes ten times a second, and how long
    /// it took.
    fn send_to_a_client_of(bytes: usize) -> (io::Result<()>, Duration) {
        // More than the system's buffers hold.
        let answer = Answer::new("text/plain", vec![vec![0; 48 << 20].into()]);
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let mut connection = Connection {
            stream: listener.accept().unwrap().0,
            buffer: Vec::new(),
        };
        let done = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let mut buffer = vec![0; bytes];
                while !done.load(Ordering::Relaxed) && client.read(&mut buffer).unwrap() > 0 {
                    std::thread::sleep(Duration::from_millis(100));
                }
            });
            let start = Instant::now();
            let sent = connection.send(&answer, false, false);
            let time = start.elapsed();
            done.store(true, Ordering::Relaxed);
            drop(connection);
            (sent, time)
        })
    }

    #[test]
    fn a_slow_client_gets_all_and_one_that_takes_next_to_nothing_is_dropped() {
        let hardly = std::thread::spawn(|| send_to_a_client_of(100));
        let (sent, time) = send_to_a_client_of(400_000);
        assert!(sent.is_ok(), "{sent:?} after {time:?}");
        // A limit on the whole answer would have ended it.
        assert!(time > PIECE_LIMIT, "{time:?}");
        let (sent, time) = hardly.join().unwrap();
        assert!(sent.is_err(), "after {time:?}");
        assert!(time < 4 * PIECE_LIMIT, "{time:?}");
    }

    fn refusal(text: &str) -> &'static str {
        parse(text.as_bytes()).unwrap_err().status
    }

    #[test]
    fn a_request_is_read_when_it_is_whole() {
        let text = "GET /next?after=7 HTTP/1.1\r\nhost: localhost:80\r\n\r\nGET";
        let (request, length) = parse(text.as_bytes()).unwrap().unwrap();
        assert_eq!(length, text.len() - 3);
        assert_eq!(
            (request.path.as_str(), request.query.as_str()),
            ("/next", "after=7")
        );
        assert_eq!(request.host, "localhost:80");
        assert!(request.again && !request.head);
        for cut in [0, 3, 20, length - 1] {
            assert_eq!(parse(&text.as_bytes()[..cut]).unwrap(), None);
        }
        let old = parse(b"HEAD / HTTP/1.0\r\nHost: a\r\n\r\n");
        let (old, _) = old.unwrap().unwrap();
        assert!(old.head && !old.again);
    }

    #[test]
    fn what_is_no_plain_request_is_refused() {
        assert!(refusal("\0\0\0\0").starts_with("400"));
        assert!(refusal("GET / HTTP/1.1\r\n\r\n").starts_with("400"));
        assert!(refusal("GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n").starts_with("400"));
        let body = "GET / HTTP/1.1\r\nHost: a\r\nContent-Length: 4\r\n\r\n";
        assert!(refusal(body).starts_with("400"));
        let chunked = "GET / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n";
        assert!(refusal(chunked).starts_with("400"));
        assert!(refusal("POST / HTTP/1.1\r\nHost: a\r\n\r\n").starts_with("405"));
        let many = format!("GET / HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(100));
        assert!(refusal(&many).starts_with("431"));
    }
}
