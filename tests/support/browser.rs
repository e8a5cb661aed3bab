//! A real headless Chromium, driven by the Chrome DevTools Protocol over two pipes.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, PipeReader, PipeWriter, Write};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Condvar, Mutex};
use std::thread;

use base64::Engine;
use command_fds::{CommandFdExt, FdMapping};
use serde_json::{Value, json};

use super::patience::{PATIENCE, eventually};
use super::scratch::Scratch;

/// The file descriptor at which Chromium reads commands.
const COMMANDS_FD: i32 = 3;
const ANSWERS_FD: i32 = 4;

#[derive(Debug, Default)]
struct Inbox {
    answers: VecDeque<Value>,
    events: Vec<Value>,
    closed: bool,
}

/// A page in a Chromium that was started for it.
#[derive(Debug)]
pub(crate) struct Browser {
    process: Child,
    commands: PipeWriter,
    inbox: Arc<(Mutex<Inbox>, Condvar)>,
    session: Option<String>,
    count: u64,
}

impl Browser {
    #[track_caller]
    pub(crate) fn start(scratch: &Scratch) -> Self {
        let names = ["chromium", "chromium-headless-shell", "google-chrome"];
        let path = std::env::var_os("PATH").unwrap_or_default();
        let program = names
            .iter()
            .flat_map(|name| std::env::split_paths(&path).map(move |folder| folder.join(name)))
            .find(|program| program.is_file())
            .expect("Chromium is not installed: apt-get install chromium");
        let (commands_out, commands) = std::io::pipe().unwrap();
        let (answers, answers_in) = std::io::pipe().unwrap();
        let mut command = Command::new(program);
        scratch.prepare(&mut command);
        let profile = scratch.path("chromium");
        command
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--no-first-run",
            ])
            .args(["--disable-dev-shm-usage", "--disable-background-networking"])
            .args([
                "--disable-component-update",
                "--disable-sync",
                "--hide-scrollbars",
            ])
            .arg("--remote-debugging-pipe")
            .arg(format!("--user-data-dir={}", profile.display()))
            .env("HOME", scratch.path(""))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(std::fs::File::create(scratch.path("chromium.log")).unwrap())
            .fd_mappings(vec![
                FdMapping {
                    parent_fd: commands_out.into(),
                    child_fd: COMMANDS_FD,
                },
                FdMapping {
                    parent_fd: answers_in.into(),
                    child_fd: ANSWERS_FD,
                },
            ])
            .unwrap();
        let process = command.spawn().unwrap();
        // The command holds the other ends of the pipes. They must be closed for Chromium's end to be
        // noticed.
        drop(command);
        let inbox = Arc::default();
        thread::spawn({
            let inbox = Arc::clone(&inbox);
            move || read(answers, &inbox)
        });
        let mut browser = Self {
            process,
            commands,
            inbox,
            session: None,
            count: 0,
        };
        let target = browser.call("Target.createTarget", json!({"url": "about:blank"}));
        let target = json!({"targetId": target["targetId"], "flatten": true});
        let session = browser.call("Target.attachToTarget", target);
        browser.session = session["sessionId"].as_str().map(str::to_owned);
        for domain in ["Page", "Runtime", "Network", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        browser
    }

    #[track_caller]
    fn call(&mut self, method: &str, params: Value) -> Value {
        self.count += 1;
        let mut call = json!({"id": self.count, "method": method, "params": params});
        if let Some(session) = &self.session {
            call["sessionId"] = session.as_str().into();
        }
        let call = serde_json::to_string(&call).unwrap() + "\0";
        let sent = self.commands.write_all(call.as_bytes());
        sent.unwrap_or_else(|error| panic!("Chromium has ended: {error}; see chromium.log"));
        let (inbox, arrived) = &*self.inbox;
        let is_ours = |answer: &Value| answer["id"] == self.count;
        let (mut inbox, _) = arrived
            .wait_timeout_while(inbox.lock().unwrap(), PATIENCE, |inbox| {
                !inbox.closed && !inbox.answers.iter().any(is_ours)
            })
            .unwrap();
        let place = inbox.answers.iter().position(is_ours);
        let place = place.unwrap_or_else(|| panic!("Chromium does not answer {method}"));
        let mut answer = inbox.answers.remove(place).unwrap();
        assert!(answer["error"].is_null(), "{method}: {}", answer["error"]);
        answer["result"].take()
    }

    /// Sets the size of the screen, and whether it is dark.
    pub(crate) fn screen(&mut self, width: u32, height: u32, dark: bool) {
        let size = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600});
        self.call("Emulation.setDeviceMetricsOverride", size);
        let scheme = if dark { "dark" } else { "light" };
        let feature = json!({"name": "prefers-color-scheme", "value": scheme});
        self.call("Emulation.setEmulatedMedia", json!({"features": [feature]}));
    }

    #[track_caller]
    pub(crate) fn open(&mut self, url: &str) {
        let opened = self.call("Page.navigate", json!({"url": url}));
        assert!(opened["errorText"].is_null(), "{url}: {opened}");
    }

    /// Evaluates an expression in the page.
    #[track_caller]
    pub(crate) fn js(&mut self, expression: &str) -> Value {
        let params = json!({"expression": expression, "awaitPromise": true, "returnByValue": true});
        let mut found = self.call("Runtime.evaluate", params);
        let thrown = &found["exceptionDetails"];
        assert!(thrown.is_null(), "{expression}: {thrown}");
        found["result"]["value"].take()
    }

    /// Waits until an expression is true.
    #[track_caller]
    pub(crate) fn shows(&mut self, what: &str, expression: &str) {
        // The elements that the expression looks at may not exist yet.
        let expression = format!(
            "(() => {{ try {{ return Boolean({expression}) }} catch {{ return false }} }})()"
        );
        eventually(what, || self.js(&expression) == true);
    }

    /// The visible text of the page.
    #[track_caller]
    pub(crate) fn text(&mut self) -> String {
        let text = self.js("document.body.innerText");
        text.as_str().unwrap_or_default().to_owned()
    }

    /// A picture of the whole page, as PNG.
    pub(crate) fn screenshot(&mut self) -> Vec<u8> {
        let params = json!({"format": "png", "captureBeyondViewport": true});
        let shot = self.call("Page.captureScreenshot", params);
        let engine = base64::engine::general_purpose::STANDARD;
        engine.decode(shot["data"].as_str().unwrap()).unwrap()
    }

    /// Presses a key like a user.
    pub(crate) fn press(&mut self, key: &str) {
        // Only with its code does a key do what it does in a browser.
        let (code, text) = match key {
            "Tab" => (9, ""),
            "Enter" => (13, "\r"),
            _ => panic!("the code of {key} is missing here"),
        };
        for kind in ["keyDown", "keyUp"] {
            let event =
                json!({"type": kind, "key": key, "windowsVirtualKeyCode": code, "text": text});
            self.call("Input.dispatchKeyEvent", event);
        }
    }

    fn events(&self, method: &str) -> Vec<Value> {
        let inbox = self.inbox.0.lock().unwrap();
        let events = inbox.events.iter();
        let events = events.filter(|event| event["method"] == method);
        events.map(|event| event["params"].clone()).collect()
    }

    /// Errors and warnings on the console, and exceptions. Network errors are left out: a browser reports
    /// them whenever its server dies.
    pub(crate) fn complaints(&self) -> Vec<String> {
        let exceptions = self.events("Runtime.exceptionThrown").into_iter();
        let said = self.events("Runtime.consoleAPICalled").into_iter();
        let logged = self.events("Log.entryAdded").into_iter();
        let logged =
            logged.filter(|entry| !entry["entry"]["text"].to_string().contains("net::ERR_"));
        let all = exceptions.chain(said).chain(logged);
        all.map(|complaint| complaint.to_string()).collect()
    }

    /// The addresses of all requests so far.
    pub(crate) fn requests(&self) -> Vec<String> {
        let sent = self.events("Network.requestWillBeSent").into_iter();
        let urls = sent.filter_map(|event| Some(event["request"]["url"].as_str()?.to_owned()));
        urls.collect()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Collects Chromium's messages until it ends.
fn read(answers: PipeReader, inbox: &(Mutex<Inbox>, Condvar)) {
    let (inbox, arrived) = inbox;
    for message in BufReader::new(answers).split(0) {
        let Ok(message) = message else { break };
        let message: Value = serde_json::from_slice(&message).unwrap_or_default();
        let mut inbox = inbox.lock().unwrap();
        match message["id"].is_null() {
            true => inbox.events.push(message),
            false => inbox.answers.push_back(message),
        }
        arrived.notify_all();
    }
    inbox.lock().unwrap().closed = true;
    arrived.notify_all();
}
