//! A headless Chromium, driven by its DevTools protocol over a pipe.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use base64::prelude::*;
use serde_json::{Value, json};
use tempfile::TempDir;

/// One page. Chromium ends with it.
pub struct Page {
    chromium: Child,
    commands: ChildStdin,
    messages: Receiver<Value>,
    session: Option<String>,
    count: u64,
    /// What went wrong in the page by itself: exceptions that nobody caught, errors on its console.
    pub faults: Vec<String>,
    _profile: TempDir,
}

impl Page {
    /// WebGPU in software takes seconds for a picture, and everything takes more on a busy machine.
    const PATIENCE: Duration = Duration::from_secs(240);

    /// Opens a page on nothing, in a Chromium with more `flags`.
    pub fn open(flags: &[&str]) -> Self {
        let chromium = std::env::var("CHROMIUM").unwrap_or_else(|_| "chromium".into());
        let profile = tempfile::tempdir().unwrap();
        // The protocol is on file descriptors 3 and 4.
        let mut child = Command::new("sh")
            .args([
                "-c",
                r#"exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null 2>&1"#,
                &chromium,
            ])
            .args(["--headless=new", "--no-sandbox", "--remote-debugging-pipe"])
            .args(flags)
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .args([
                "--no-first-run",
                "--disable-quic",
                "--disable-background-networking",
            ])
            .args([
                "--disable-component-update",
                "--disable-sync",
                "--hide-scrollbars",
            ])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let commands = child.stdin.take().unwrap();
        let answers = BufReader::new(child.stdout.take().unwrap());
        let (sender, messages) = channel();
        std::thread::spawn(move || {
            for message in answers.split(0).map_while(Result::ok) {
                let message = serde_json::from_slice(&message).unwrap();
                if sender.send(message).is_err() {
                    return;
                }
            }
        });
        let mut page = Self {
            chromium: child,
            commands,
            messages,
            session: None,
            count: 0,
            faults: Vec::new(),
            _profile: profile,
        };
        let target = page.call("Target.createTarget", json!({"url": "about:blank"}));
        let target = json!({"targetId": target["targetId"], "flatten": true});
        let attached = page.call("Target.attachToTarget", target);
        page.session = attached["sessionId"].as_str().map(str::to_owned);
        page.call("Page.enable", json!({}));
        page.call("Runtime.enable", json!({}));
        page
    }

    /// Calls a method of the protocol.
    pub fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.count += 1;
        let mut command = json!({"id": self.count, "method": method, "params": parameters});
        if let Some(session) = &self.session {
            command["sessionId"] = json!(session);
        }
        self.commands
            .write_all(format!("{command}\0").as_bytes())
            .unwrap();
        let start = Instant::now();
        loop {
            let left = Self::PATIENCE.saturating_sub(start.elapsed());
            let mut message = match self.messages.recv_timeout(left) {
                Ok(message) => message,
                Err(RecvTimeoutError::Timeout) => {
                    panic!("{method}: no answer; page: {:?}", self.faults)
                }
                Err(RecvTimeoutError::Disconnected) => {
                    panic!(
                        "{method}: is Chromium installed, and does it start? Its name or path can be in CHROMIUM"
                    )
                }
            };
            if message["id"] == self.count {
                assert!(message["error"].is_null(), "{method}: {}", message["error"]);
                return message["result"].take();
            }
            let event = &message["params"];
            match message["method"].as_str() {
                Some("Runtime.exceptionThrown") => {
                    self.faults.push(event["exceptionDetails"].to_string());
                }
                Some("Runtime.consoleAPICalled") if event["type"] == "error" => {
                    self.faults.push(event["args"].to_string());
                }
                _ => {}
            }
        }
    }

    /// Goes to `url`, and waits until it is loaded, its scripts included.
    pub fn go(&mut self, url: &str) {
        self.call("Page.navigate", json!({"url": url}));
        self.wait_until("document.readyState === 'complete'");
    }

    /// Runs the body of an asynchronous function: what it returns.
    pub fn run(&mut self, body: &str) -> Value {
        let expression = format!("(async () => {{ {body} }})()");
        let mut answer = self.call(
            "Runtime.evaluate",
            json!({"expression": expression, "awaitPromise": true, "returnByValue": true, "userGesture": true}),
        );
        let thrown = &answer["exceptionDetails"];
        assert!(thrown.is_null(), "{body}\nthrew {thrown}");
        answer["result"]["value"].take()
    }

    /// Waits until an expression is true.
    pub fn wait_until(&mut self, expression: &str) {
        let start = Instant::now();
        while self.run(&format!("return {expression}")) != true {
            if start.elapsed() > Self::PATIENCE {
                let text = self.run("return document.body.innerText");
                panic!(
                    "still not so: {expression}; page: {:?}, says {text}",
                    self.faults
                );
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Makes the page so many CSS pixels wide and high, each `scale` x `scale` pixels, in light or dark.
    pub fn resize(&mut self, width: u32, height: u32, scale: u32, theme: &str) {
        self.call(
            "Emulation.setDeviceMetricsOverride",
            json!({"width": width, "height": height, "deviceScaleFactor": scale, "mobile": width < 600}),
        );
        let theme = json!([{"name": "prefers-color-scheme", "value": theme}]);
        self.call("Emulation.setEmulatedMedia", json!({"features": theme}));
    }

    /// The page, or the part `clip` of it, as a PNG.
    pub fn screenshot(&mut self, clip: &Value) -> Vec<u8> {
        let parameters = match clip {
            Value::Null => json!({}),
            clip => json!({"clip": clip}),
        };
        let picture = self.call("Page.captureScreenshot", parameters);
        BASE64_STANDARD
            .decode(picture["data"].as_str().unwrap())
            .unwrap()
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        // Its helper processes see their pipes close, and end too.
        let _ = self.chromium.kill();
        let _ = self.chromium.wait();
    }
}
