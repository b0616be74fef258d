//! An RTSP server on loopback: what `ffmpeg` sends it as RTP, it hands to one player at a time (RFC 2326, interleaved).

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

pub struct Server {
    pub address: String,
    sender: Child,
}

impl Server {
    /// Sends a moving picture of `size`, `rate` frames a second. `folder` is for its files.
    pub fn new(folder: &Path, size: &str, rate: u32) -> Self {
        let rtp = UdpSocket::bind("127.0.0.1:0").unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("rtsp://{}/camera", listener.local_addr().unwrap());
        let sdp = folder.join("stream.sdp");
        let sender = Command::new("ffmpeg")
            .args(["-nostdin", "-v", "error", "-re", "-f", "lavfi", "-i"])
            .arg(format!("testsrc=size={size}:rate={rate}"))
            .args([
                "-c:v",
                "mpeg4",
                "-q:v",
                "2",
                "-g",
                "5",
                "-flags",
                "+global_header",
            ])
            .args(["-f", "rtp"])
            .arg("-sdp_file")
            .arg(&sdp)
            .arg(format!("rtp://{}?pkt_size=1300", rtp.local_addr().unwrap()))
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        std::thread::spawn(move || {
            for player in listener.incoming() {
                // A player that leaves is no fault.
                let _ = serve(player.unwrap(), &sdp, &rtp);
            }
        });
        Self { address, sender }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.sender.kill().unwrap();
        self.sender.wait().unwrap();
    }
}

fn serve(mut player: TcpStream, sdp: &Path, rtp: &UdpSocket) -> std::io::Result<()> {
    let mut requests = BufReader::new(player.try_clone()?);
    loop {
        let mut request = Vec::new();
        loop {
            let mut line = String::new();
            if requests.read_line(&mut line)? == 0 {
                return Ok(());
            }
            if line.trim().is_empty() {
                break;
            }
            request.push(line);
        }
        let method = request[0].split(' ').next().unwrap_or_default();
        let sequence = request
            .iter()
            .find(|line| line.to_lowercase().starts_with("cseq"))
            .map(|line| line.trim().to_owned())
            .unwrap_or_default();
        let (headers, body) = match method {
            "OPTIONS" => (
                "Public: OPTIONS, DESCRIBE, SETUP, PLAY\r\n".into(),
                String::new(),
            ),
            "DESCRIBE" => {
                let body = description(sdp);
                let headers = format!(
                    "Content-Type: application/sdp\r\nContent-Length: {}\r\n",
                    body.len()
                );
                (headers, body)
            }
            "SETUP" => {
                let transport = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n";
                (transport.to_owned(), String::new())
            }
            _ => ("Session: 1\r\n".to_owned(), String::new()),
        };
        write!(
            player,
            "RTSP/1.0 200 OK\r\n{sequence}\r\n{headers}\r\n{body}"
        )?;
        if method == "PLAY" {
            break;
        }
    }
    // What was sent before anybody looked.
    let mut packet = [0; 65536];
    rtp.set_nonblocking(true)?;
    while rtp.recv(&mut packet).is_ok() {}
    rtp.set_nonblocking(false)?;
    rtp.set_read_timeout(Some(Duration::from_secs(10)))?;
    loop {
        let size = rtp.recv(&mut packet)?;
        let mut framed = vec![b'$', 0];
        framed.extend((size as u16).to_be_bytes());
        framed.extend(&packet[..size]);
        player.write_all(&framed)?;
    }
}

/// Written once the sender has begun.
fn description(sdp: &Path) -> String {
    let start = Instant::now();
    loop {
        let text = std::fs::read_to_string(sdp).unwrap_or_default();
        if text.contains("config=") && text.ends_with('\n') {
            return text + "a=control:video\r\n";
        }
        assert!(start.elapsed() < Duration::from_secs(20), "{text}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
