//! The local page's server against clients of all kinds, over plain TCP.
#![cfg(feature = "live")]

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use image::{Rgba, RgbaImage};
use serde_json::{Value, json};
use whereabot::camera::{Camera, Intrinsics};
use whereabot::cascade::{Estimate, Joint, Mask, Status};
use whereabot::live::page::{CameraInfo, PageSink, Server};
use whereabot::live::warning::{State, Warning};
use whereabot::live::{Event, EventKind, Observation, Rates, Sink, Statistics};

/// A page of the cameras `bench` and `gate` on this machine alone.
fn page() -> (Server, PageSink, SocketAddr) {
    let server = Server::bind("127.0.0.1:0", cameras()).unwrap();
    let sink = server.sink();
    let address = address(&server);
    (server, sink, address)
}

fn cameras() -> Vec<CameraInfo> {
    let camera = |name: &str| CameraInfo {
        name: name.to_owned(),
        robot: "ur5".to_owned(),
        canonical: Camera::from_hfov(16, 12, 1.2).intrinsics,
        common_from_camera: None,
    };
    vec![camera("bench"), camera("gate")]
}

fn address(server: &Server) -> SocketAddr {
    let url = server.url();
    let rest = url.strip_prefix("http://").unwrap();
    rest.split_once('/').unwrap().0.parse().unwrap()
}

/// Frame `frame` of a camera with 640 x 480 pixels: all of one grey, with a robot in the left half.
fn observation(camera: usize, frame: u64) -> Observation {
    let now = Instant::now();
    let grey = (frame % 256) as u8;
    Observation {
        file: None,
        camera,
        frame,
        acquired: SystemTime::now(),
        acquired_at: now,
        answered_at: now + Duration::from_millis(20),
        image: Arc::new(RgbaImage::from_pixel(
            640,
            480,
            Rgba([grey, grey, grey, 255]),
        )),
        view: Camera::from_hfov(640, 480, 1.2),
        estimate: Estimate {
            status: Status::Found,
            coverage: 0.5,
            bbox_px: None,
            field: 1.0,
            joints: vec![Joint {
                name: "elbow".to_owned(),
                xyz_m: [0.125, -0.25, 1.5],
                px: [400.0, 100.5],
            }],
            mask: Some(Mask {
                width: 16,
                height: 12,
                probability: (0..16 * 12)
                    .map(|i| f32::from(u8::from(i % 16 < 8)))
                    .collect(),
            }),
        },
    }
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    let patience = Some(Duration::from_secs(30));
    stream.set_read_timeout(patience).unwrap();
    stream
}

/// What comes until the server closes; the status line, the headers, the body.
fn exchange(address: SocketAddr, request: &[u8]) -> (String, String, Vec<u8>) {
    let mut stream = connect(address);
    // The server may refuse before it has read all.
    let _ = stream.write_all(request);
    let mut bytes = Vec::new();
    if let Err(error) = stream.read_to_end(&mut bytes) {
        assert_eq!(error.kind(), ErrorKind::ConnectionReset);
    }
    let end = bytes.windows(4).position(|four| four == b"\r\n\r\n");
    let end = end.unwrap_or_else(|| panic!("no answer to {}", String::from_utf8_lossy(request)));
    let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let (status, headers) = head.split_once("\r\n").unwrap();
    (
        status.to_owned(),
        headers.to_owned(),
        bytes[end + 4..].to_vec(),
    )
}

fn get(address: SocketAddr, path: &str, host: &str) -> (String, String, Vec<u8>) {
    let request = format!("GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n");
    exchange(address, request.as_bytes())
}

fn status(address: SocketAddr, path: &str, host: &str) -> u16 {
    code(&get(address, path, host).0)
}

fn code(status: &str) -> u16 {
    let code = status.strip_prefix("HTTP/1.1 ").unwrap();
    code[..3].parse().unwrap()
}

/// What has changed since `known`: the message, and its tiles' files.
fn changes(address: SocketAddr, known: u64) -> (Value, Vec<[Vec<u8>; 2]>) {
    ask(address, &format!("since={known}"))
}

fn ask(address: SocketAddr, query: &str) -> (Value, Vec<[Vec<u8>; 2]>) {
    let (status, _, body) = get(address, &format!("/changes?{query}"), "localhost");
    assert_eq!(code(&status), 200);
    let (length, rest) = body.split_at(4);
    let length = u32::from_le_bytes(length.try_into().unwrap()) as usize;
    let (json, mut rest) = rest.split_at(length);
    let message: Value = serde_json::from_slice(json).unwrap();
    let tiles = message["tiles"].as_array().unwrap().iter();
    let files = tiles.map(|tile| {
        ["picture_bytes", "tint_bytes"].map(|name| {
            let (file, others) = rest.split_at(tile[name].as_u64().unwrap() as usize);
            rest = others;
            file.to_vec()
        })
    });
    let files = files.collect();
    assert!(rest.is_empty());
    (message, files)
}

fn change(message: &Value) -> u64 {
    message["change"].as_u64().unwrap()
}

/// Asks until a message has what is looked for.
fn wait_for(
    address: SocketAddr,
    mut known: u64,
    found: impl Fn(&Value) -> bool,
) -> (Value, Vec<[Vec<u8>; 2]>) {
    let start = Instant::now();
    loop {
        let (message, files) = changes(address, known);
        if found(&message) {
            return (message, files);
        }
        known = change(&message);
        assert!(start.elapsed() < Duration::from_secs(30), "{message}");
    }
}

#[test]
fn files_come_with_headers_that_keep_others_out() {
    let (_server, _, address) = page();
    for (path, kind, word) in [
        ("/", "text/html", "<!doctype html>"),
        ("/style.css", "text/css", ":root"),
        ("/page.js", "text/javascript", "import"),
        ("/scene.js", "text/javascript", "export"),
        ("/icon.svg", "image/svg+xml", "<svg"),
    ] {
        let (status, headers, body) = get(address, path, "localhost");
        assert_eq!(code(&status), 200, "{path}");
        assert!(
            headers.contains(&format!("Content-Type: {kind}")),
            "{headers}"
        );
        assert!(
            headers.contains("Content-Security-Policy: default-src 'self';"),
            "{headers}"
        );
        assert!(
            headers.contains("X-Content-Type-Options: nosniff"),
            "{headers}"
        );
        assert!(
            headers.contains("Cross-Origin-Resource-Policy: same-origin"),
            "{headers}"
        );
        assert!(headers.contains("frame-ancestors 'none'"), "{headers}");
        assert!(!headers.contains("Access-Control"), "{headers}");
        assert!(String::from_utf8(body).unwrap().contains(word), "{path}");
    }
    let head = "HEAD /page.js HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
    let (status, headers, body) = exchange(address, head.as_bytes());
    assert_eq!((code(&status), body.len()), (200, 0));
    assert!(!headers.contains("Content-Length: 0"));
}

#[test]
fn bad_requests_are_refused_and_good_ones_still_answered() {
    let (_server, _, address) = page();
    for path in [
        "/../Cargo.toml",
        "/..%2fCargo.toml",
        "/%2e%2e/%2e%2e/etc/passwd",
        "//etc/passwd",
        "/style.css/",
        "/favicon.ico",
        "/changes/",
    ] {
        assert_eq!(status(address, path, "localhost"), 404, "{path}");
    }
    for query in [
        "",
        "?since=",
        "?since=-1",
        "?since=1e3",
        "?since=99999999999999999999",
        "?since=0&owed=",
        "?since=0&owed=1,",
        "?since=0&owed=-1",
        "?owed=1&since=0",
    ] {
        let path = format!("/changes{query}");
        assert_eq!(status(address, &path, "localhost"), 400, "{path}");
    }
    let long = "a".repeat(20_000);
    for (request, expected) in [
        ("\u{16}\u{3}\u{1}\u{2}\r\n\r\n".to_owned(), 400),
        ("GET / HTTP/1.1\r\n\r\n".to_owned(), 400),
        ("GET /\r\n\r\n".to_owned(), 400),
        (
            "POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc".to_owned(),
            405,
        ),
        (
            "GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc".to_owned(),
            400,
        ),
        (
            format!("GET / HTTP/1.1\r\nHost: localhost\r\nX: {long}\r\n\r\n"),
            431,
        ),
        (
            format!(
                "GET / HTTP/1.1\r\nHost: localhost\r\nX: {}",
                "a".repeat(2_000_000)
            ),
            431,
        ),
        (
            format!("GET /{long} HTTP/1.1\r\nHost: localhost\r\n\r\n"),
            431,
        ),
        (
            format!("GET / HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(200)),
            431,
        ),
    ] {
        let (status, ..) = exchange(address, request.as_bytes());
        assert_eq!(
            code(&status),
            expected,
            "{}",
            &request[..request.len().min(80)]
        );
        assert_eq!(self::status(address, "/", "localhost"), 200);
    }
}

#[test]
fn names_that_were_pointed_here_are_refused() {
    let (_server, _, address) = page();
    let port = address.port();
    for host in [
        "evil.example",
        "127.0.0.1.evil.example",
        "localhost.evil.example",
        "",
        "a:b",
    ] {
        assert_eq!(status(address, "/", host), 421, "{host}");
        assert_eq!(status(address, "/changes?since=0", host), 421, "{host}");
    }
    assert_eq!(status(address, "/", &format!("evil.example:{port}")), 421);
    for host in [
        "localhost",
        "LOCALHOST:8088",
        "127.0.0.1",
        "[::1]",
        "[::1]:8088",
    ] {
        assert_eq!(status(address, "/", host), 200, "{host}");
    }
    assert_eq!(status(address, "/", &address.to_string()), 200);
}

#[test]
fn others_need_the_token() {
    let server = Server::bind("0.0.0.0:0", cameras()).unwrap();
    let url = server.url();
    let (host, path) = url
        .strip_prefix("http://")
        .unwrap()
        .split_once('/')
        .unwrap();
    let port = host.rsplit_once(':').unwrap().1;
    let address: SocketAddr = format!("127.0.0.1:{port}").parse().unwrap();
    let token = path.strip_suffix('/').unwrap();
    assert_eq!(token.len(), 32);
    assert!(token.bytes().all(|byte| byte.is_ascii_hexdigit()));

    for file in ["", "page.js", "changes?since=0"] {
        assert_eq!(
            status(address, &format!("/{token}/{file}"), host),
            200,
            "{file}"
        );
        let last = if token.ends_with('0') { '1' } else { '0' };
        let wrong = format!("{}{last}", &token[..31]);
        for path in [
            format!("/{file}"),
            format!("//{file}"),
            format!("/{wrong}/{file}"),
            format!("/{}/{file}", &token[..31]),
            format!("/{token}0/{file}"),
            format!("/{file}?token={token}"),
        ] {
            assert_eq!(status(address, &path, host), 403, "{path}");
        }
    }
    assert_eq!(status(address, &format!("/{token}/"), "evil.example"), 421);

    let other = Server::bind("0.0.0.0:0", cameras()).unwrap();
    assert!(!other.url().contains(token));
    // On this machine alone there is nobody to keep out.
    let (local, ..) = page();
    assert_eq!(local.url().matches('/').count(), 3);
}

#[test]
fn an_address_that_cannot_be_is_an_error_with_its_text() {
    let (_server, _, address) = page();
    for wrong in [
        "nowhere",
        "127.0.0.1",
        "127.0.0.1:99999",
        &address.to_string(),
    ] {
        let error = Server::bind(wrong, cameras()).unwrap_err().to_string();
        assert!(error.starts_with(&format!("page on {wrong}: ")), "{error}");
    }
}

#[test]
fn what_comes_in_is_what_a_client_gets() {
    let (_server, mut sink, address) = page();
    let (first, files) = changes(address, 0);
    assert!(files.is_empty());
    assert_eq!(first["cameras"][1]["name"], "gate");
    assert_eq!(first["conditions"], json!(["waiting", "waiting"]));

    sink.observation(&observation(1, 7));
    // A camera that is not in the configuration is nobody's.
    sink.observation(&observation(2, 8));
    let is_seen = |message: &Value| message["tiles"] != json!([]);
    let (message, files) = wait_for(address, change(&first), is_seen);
    assert!(message["cameras"].is_null() && message["alarms"].is_null());
    assert_eq!(files.len(), 1);
    let tile = &message["tiles"][0];
    assert_eq!((&tile["camera"], &tile["frame"]), (&json!(1), &json!(7)));
    assert_eq!(
        (&tile["status"], &tile["width"]),
        (&json!("found"), &json!(640))
    );
    assert_eq!(tile["age_ms"], 20.0);
    assert!(tile["old_ms"].as_f64().unwrap() > 0.0);
    let joint = json!({"name": "elbow", "xyz_m": [0.125, -0.25, 1.5], "px": [400.0, 100.5]});
    assert_eq!(tile["joints"], json!([joint]));
    let [picture, tint] = &files[0];
    let picture = image::load_from_memory(picture).unwrap().into_rgb8();
    assert_eq!(picture.dimensions(), (512, 384));
    assert!(picture.get_pixel(5, 5).0[0].abs_diff(7) <= 1);
    let tint = image::load_from_memory(tint).unwrap().into_rgba8();
    assert!(tint.get_pixel(20, 96).0[3] > 100 && tint.get_pixel(230, 96).0[3] == 0);

    let at = SystemTime::now();
    let reason = "ffmpeg ended".to_owned();
    let failed = EventKind::Failed {
        reason,
        retry_in: Some(Duration::from_secs(2)),
    };
    for (camera, kind) in [(0, EventKind::Live), (1, failed), (0, EventKind::Stale)] {
        sink.event(&Event {
            at,
            camera: Some(camera),
            kind,
        });
    }
    sink.event(&Event {
        at,
        camera: None,
        kind: EventKind::DeviceLost {
            reason: "gone".to_owned(),
        },
    });
    let rates = Rates {
        frames_per_s: 30.0,
        answers_per_s: 12.5,
        dropped: 3,
        age_p50: Some(Duration::from_millis(80)),
        age_p99: None,
    };
    sink.statistics(&Statistics {
        at,
        cameras: vec![rates, Rates::default()],
    });
    let warned = |distance_m| {
        let warning = Warning {
            rule: "near".to_owned(),
            state: State::Warn,
            before: None,
            acts_as: State::Warn,
            acted_as: None,
            distance_m: Some(distance_m),
            uncertainty_m: None,
            why: None,
            frame_number: None,
            latency_ms: None,
        };
        Event {
            at,
            camera: Some(0),
            kind: EventKind::Warning(warning),
        }
    };
    sink.event(&warned(0.75));
    let (message, _) = changes(address, change(&message));
    assert_eq!(message["conditions"], json!(["stale", "failed"]));
    assert_eq!(message["gpu_lost"], true);
    let texts: Vec<_> = message["events"]
        .as_array()
        .unwrap()
        .iter()
        .map(|event| &event["text"])
        .collect();
    let failed = "failed, tried again in 2.0 s: ffmpeg ended";
    let lost = "the GPU failed: gone";
    assert_eq!(
        texts,
        [
            "gives frames",
            failed,
            "no frame in time",
            lost,
            "near: warn"
        ]
    );
    let expected = json!({"frames_per_s": 30.0, "answers_per_s": 12.5, "dropped": 3, "age_p50_ms": 80.0, "age_p99_ms": null});
    assert_eq!(message["statistics"][0], expected);
    assert_eq!(message["alarms"][0]["state"], "warn");
    assert_eq!(message["alarms"][0]["distance_m"], 0.75);

    // A rule has one alarm, and what was known is not said again.
    sink.event(&warned(0.5));
    let (message, _) = changes(address, change(&message));
    assert_eq!(message["alarms"][0]["distance_m"], 0.5);
    assert_eq!(message["alarms"].as_array().unwrap().len(), 1);
    assert_eq!(message["events"].as_array().unwrap().len(), 1);
    assert!(message["statistics"].is_null() && !is_seen(&message));
    // With nothing new a client gets an answer all the same.
    let (after, _) = changes(address, change(&message));
    assert_eq!(change(&after), change(&message));
    // A client of an earlier run, whose clock was ahead, gets everything.
    let (all, files) = changes(address, u64::MAX);
    assert_eq!((all["cameras"].is_array(), files.len()), (true, 1));
}

#[test]
fn the_newest_frame_wins_and_tiles_have_a_pace() {
    let (_server, mut sink, address) = page();
    let mut known = change(&changes(address, 0).0);
    let start = Instant::now();
    let feeder = std::thread::spawn(move || {
        for frame in 0..300 {
            sink.observation(&observation(0, frame));
            std::thread::sleep(Duration::from_millis(5));
        }
    });
    let mut frames: Vec<u64> = Vec::new();
    while frames.last() != Some(&299) {
        assert!(start.elapsed() < Duration::from_secs(60), "{frames:?}");
        let (message, _) = changes(address, known);
        known = change(&message);
        let tiles = message["tiles"].as_array().unwrap().iter();
        frames.extend(tiles.map(|tile| tile["frame"].as_u64().unwrap()));
    }
    let most = start.elapsed().as_millis() / 100 + 2;
    feeder.join().unwrap();
    assert!(
        frames.windows(2).all(|pair| pair[0] < pair[1]),
        "{frames:?}"
    );
    assert!(
        frames.len() > 2 && frames.len() as u128 <= most,
        "{frames:?}"
    );
}

#[test]
fn an_answer_is_never_large_and_each_camera_has_its_turn() {
    const CAMERAS: usize = 6;
    let [camera, _] = cameras().try_into().unwrap();
    let server = Server::bind("127.0.0.1:0", vec![camera; CAMERAS]).unwrap();
    let address = address(&server);
    let mut sink = server.sink();
    // Noise hardly shrinks.
    let mut random = 1_u32;
    let noise = RgbaImage::from_fn(400, 300, |_, _| {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let [.., grey] = random.to_le_bytes();
        Rgba([grey, grey, grey, 255])
    });
    let noise = Arc::new(noise);
    let mut frame = 0;
    let mut feed = || {
        frame += 1;
        for camera in 0..CAMERAS {
            sink.observation(&Observation {
                image: noise.clone(),
                view: Camera::from_hfov(400, 300, 1.2),
                ..observation(camera, frame)
            });
        }
    };
    feed();
    wait_for(address, 0, |message| message["tiles"] != json!([]));

    // How often a client that is slower than the cameras sees each of them. All have something new whenever it asks.
    let mut seen = |asks_for_what_is_owed: bool| {
        let mut seen = [0; CAMERAS];
        let (mut known, mut owed) = (0, String::new());
        for _ in 0..18 {
            feed();
            std::thread::sleep(Duration::from_millis(200));
            let (message, files) = ask(address, &format!("since={known}{owed}"));
            let bytes: usize = files.as_flattened().iter().map(Vec::len).sum();
            assert!(bytes <= 200_000 && files.len() < CAMERAS, "{bytes}");
            for tile in message["tiles"].as_array().unwrap() {
                seen[tile["camera"].as_u64().unwrap() as usize] += 1;
            }
            known = change(&message);
            let left = message["owed"].as_array().unwrap().iter();
            let left: Vec<_> = left.map(Value::to_string).collect();
            if asks_for_what_is_owed && !left.is_empty() {
                owed = format!("&owed={}", left.join(","));
            }
        }
        seen
    };
    let fair = seen(true);
    let (least, most) = (fair.iter().min().unwrap(), fair.iter().max().unwrap());
    assert!(*least > 0 && most - least <= 1, "{fair:?}");
    // Negative control: who does not say what it is owed sees the first cameras alone.
    let unfair = seen(false);
    assert_eq!(unfair[CAMERAS - 1], 0, "{unfair:?}");
}

#[test]
fn a_client_that_never_reads_is_dropped_and_delays_nobody() {
    let (_server, mut sink, address) = page();
    changes(address, 0);
    sink.observation(&observation(0, 0));
    wait_for(address, 0, |message| message["tiles"] != json!([]));

    // More answers than the system's buffers hold.
    const REQUESTS: usize = 3000;
    let request = "GET /page.js HTTP/1.1\r\nHost: localhost\r\n\r\n";
    let ask = |count: usize| {
        let mut stream = connect(address);
        stream.set_nonblocking(true).unwrap();
        // As much as the server's buffer takes.
        let _ = stream.write_all(request.repeat(count).as_bytes());
        stream.set_nonblocking(false).unwrap();
        stream
    };
    let all_of = |mut stream: TcpStream| {
        let mut bytes = Vec::new();
        let _ = stream.read_to_end(&mut bytes);
        bytes.len()
    };
    let asleep = ask(REQUESTS);
    let start = Instant::now();
    for frame in 1..=500 {
        sink.observation(&observation(0, frame));
    }
    // The images alone take most of it.
    assert!(
        start.elapsed() < Duration::from_secs(20),
        "{:?}",
        start.elapsed()
    );
    let newest = |message: &Value| message["tiles"][0]["frame"] == 500;
    wait_for(address, 0, newest);

    // Long enough for the server to lose patience.
    std::thread::sleep(Duration::from_secs(7));
    let one = include_str!("../../src/live/page/page.js").len();
    let dropped = all_of(asleep);
    assert!(
        dropped > one && dropped < REQUESTS * one / 2,
        "{dropped} of {}",
        REQUESTS * one
    );
    // Control: one that reads gets all it asked for.
    assert!(all_of(ask(20)) > 20 * one);
}

#[test]
fn a_request_that_never_ends_is_cut_off() {
    let (_server, _, address) = page();
    let start = Instant::now();
    let mut slow = connect(address);
    let mut half = slow.try_clone().unwrap();
    half.write_all(b"GET / HTTP/1.1\r\n").unwrap();
    // A byte now and then does not win it time.
    let drip = std::thread::spawn(move || {
        while half.write_all(b"a").is_ok() && start.elapsed() < Duration::from_secs(30) {
            std::thread::sleep(Duration::from_millis(200));
        }
    });
    let mut answer = Vec::new();
    let _ = slow.read_to_end(&mut answer);
    assert!(
        answer.starts_with(b"HTTP/1.1 408 "),
        "{}",
        String::from_utf8_lossy(&answer)
    );
    assert!(start.elapsed() < Duration::from_secs(20));
    drop(slow);
    drip.join().unwrap();
}

#[test]
fn who_says_nothing_or_has_no_token_keeps_no_seat() {
    let server = Server::bind("0.0.0.0:0", cameras()).unwrap();
    let url = server.url();
    let (host, path) = url.split_once("//").unwrap().1.split_once('/').unwrap();
    let port = host.rsplit_once(':').unwrap().1;
    let address: SocketAddr = format!("127.0.0.1:{port}").parse().unwrap();
    let kept = |request: &str| {
        let start = Instant::now();
        let mut stream = connect(address);
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        (String::from_utf8(answer).unwrap(), start.elapsed())
    };
    let get = |path: &str| format!("GET /{path}icon.svg HTTP/1.1\r\nHost: {host}\r\n\r\n");
    let (answer, time) = kept("");
    assert!(
        answer.is_empty() && time < Duration::from_secs(4),
        "{time:?}"
    );
    let (answer, time) = kept(&get(""));
    assert!(answer.starts_with("HTTP/1.1 403"), "{answer}");
    assert!(time < Duration::from_secs(4), "{time:?}");
    // Negative control: who has the token may ask again.
    let (answer, time) = kept(&get(path));
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    assert!(time > Duration::from_secs(4), "{time:?}");
}

#[test]
fn too_many_clients_are_turned_away_until_others_go() {
    let (_server, _, address) = page();
    let clients: Vec<_> = (0..64).map(|_| connect(address)).collect();
    let start = Instant::now();
    // The last ones may still be on their way to a seat.
    let mut refused = connect(address);
    let mut answer = Vec::new();
    refused.read_to_end(&mut answer).unwrap();
    assert!(
        answer.starts_with(b"HTTP/1.1 503 "),
        "{}",
        String::from_utf8_lossy(&answer)
    );
    drop(clients);
    let again = || {
        let mut stream = connect(address);
        let _ = stream.write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        answer.starts_with(b"HTTP/1.1 200 ")
    };
    while !again() {
        assert!(start.elapsed() < Duration::from_secs(20));
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_page_that_is_dropped_frees_its_port_and_lets_clients_go() {
    let (server, mut sink, address) = page();
    let known = change(&changes(address, 0).0);
    // Connections that would be kept: one waits for news, one has got its answer.
    let ask = |path: &str| {
        let mut stream = connect(address);
        write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        stream
    };
    let mut waiting = ask(&format!("/changes?since={known}"));
    let mut kept = ask("/icon.svg");
    std::thread::sleep(Duration::from_millis(100));
    let start = Instant::now();
    drop(server);
    assert!(start.elapsed() < Duration::from_secs(5));
    assert!(TcpStream::connect(address).is_err());
    // Its sink goes nowhere, and says nothing of it.
    sink.observation(&observation(0, 0));
    let mut answer = Vec::new();
    waiting.read_to_end(&mut answer).unwrap();
    assert!(answer.is_empty());
    let _ = kept.write_all(b"GET /icon.svg HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let _ = kept.read_to_end(&mut answer);
    let answers = String::from_utf8(answer).unwrap();
    assert_eq!(answers.matches("HTTP/1.1 200").count(), 1);
}

#[test]
fn figures_that_are_no_numbers_are_still_json() {
    let (_server, mut sink, address) = page();
    changes(address, 0);
    let mut odd = observation(0, 0);
    odd.estimate.coverage = f64::NAN;
    odd.view.intrinsics = Intrinsics {
        fx: f64::INFINITY,
        ..odd.view.intrinsics
    };
    sink.observation(&odd);
    let (message, _) = wait_for(address, 0, |message| message["tiles"] != json!([]));
    assert!(message["tiles"][0]["coverage"].is_null());
}
