//! Black-box tests of the real binaries: common helpers.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::time::{Duration, Instant};

/// Returns the path of the `vizflyt` program built next to this test.
///
/// # Panics
/// If it is not built; the message names the command.
pub fn vizflyt() -> PathBuf {
    // target/PROFILE/deps/this-test
    let test = std::env::current_exe().expect("a test knows its own path");
    let program = test.ancestors().nth(2).expect("target/PROFILE").join("vizflyt");
    assert!(
        program.exists(),
        "{} is not built; run `cargo build` first (tests/run does)",
        program.display()
    );
    program
}

/// Runs `vizflyt ARGS` and waits for its end.
///
/// # Panics
/// If the program cannot be started.
pub fn run(args: &[&str]) -> Output {
    Command::new(vizflyt()).args(args).output().expect("vizflyt starts")
}

/// Runs `vizflyt ARGS` in a folder; returns whether it succeeded, and all of its output.
///
/// # Panics
/// If the program cannot be started.
pub fn run_in(folder: &Path, args: &[&str]) -> (bool, String) {
    let output =
        Command::new(vizflyt()).current_dir(folder).args(args).output().expect("vizflyt starts");
    let text = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8_lossy(&text).into_owned())
}

/// Runs `vizflyt ARGS`, and returns its standard output.
///
/// # Panics
/// If it fails; the message is its standard error.
pub fn good(args: &[&str]) -> String {
    let output = run(args);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args:?}: {errors}");
    String::from_utf8(output.stdout).expect("standard output is text")
}

/// Runs `vizflyt ARGS`, which must fail with a message that contains every given text.
///
/// # Panics
/// If it succeeds, panics, or prints another message.
pub fn check_refused(args: &[&str], texts: &[&str]) {
    let output = run(args);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success(), "{args:?} succeeded");
    assert!(!message.contains("panicked"), "{args:?}: {message}");
    for text in texts {
        assert!(message.contains(text), "{args:?} does not contain '{text}': {message}");
    }
}

/// Returns the root of the repository.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).expect("tests/e2e").to_owned()
}

/// Parameters of `hardware/airframe` for the autopilot's own failsafes and speeds. The runtime cannot act for an
/// autopilot that it does not reach.
const FAILSAFE_PARAMETERS: [&str; 26] = [
    "FS_GCS_ENABLE",
    "FS_GCS_TIMEOUT",
    "FS_THR_ENABLE",
    "FS_EKF_ACTION",
    "FS_CRASH_CHECK",
    "FS_OPTIONS",
    "GUID_TIMEOUT",
    "FENCE_ENABLE",
    "FENCE_TYPE",
    "FENCE_ACTION",
    "FENCE_ALT_MAX",
    "FENCE_RADIUS",
    "BATT_MONITOR",
    "BATT_LOW_VOLT",
    "BATT_FS_LOW_ACT",
    "WP_SPD",
    "WP_SPD_UP",
    "WP_SPD_DN",
    "WP_ACC",
    "WP_ACC_Z",
    "PSC_JERK_NE",
    "PSC_JERK_D",
    "WP_YAW_BEHAVIOR",
    "LAND_SPD_MS",
    "LAND_SPD_HIGH_MS",
    "LAND_ALT_LOW_M",
];

/// Returns the names and values of [`FAILSAFE_PARAMETERS`] from the file in `hardware/airframe`.
///
/// # Panics
/// If a parameter is missing.
pub fn airframe_parameters() -> Vec<(String, f32)> {
    let path = root().join("hardware/airframe/whippet-copter-4.8.param");
    let text = std::fs::read_to_string(path).expect("the vehicle's parameters are there");
    let values: Vec<_> = text
        .lines()
        .filter_map(|line| line.split_once(','))
        .filter(|(name, _)| FAILSAFE_PARAMETERS.contains(name))
        .map(|(name, value)| (name.to_owned(), value.trim().parse().expect("a number")))
        .collect();
    assert_eq!(values.len(), FAILSAFE_PARAMETERS.len(), "hardware/airframe lacks one of them");
    values
}

/// Maximum image rate of a flight, unless a test is about rates: leaves processor time for other tests. [Hz]
const MAX_RATE_HZ: f64 = 40.0;

/// A running `vizflyt` with captured output. Killed when dropped.
pub struct Demo {
    child: Child,
    lines: Receiver<String>,
    /// Lines printed so far, for failure messages.
    pub seen: Vec<String>,
    load: Load,
}

/// Measurement of how long tasks of this machine wait for a processor.
#[derive(Debug)]
pub struct Load {
    started: Instant,
    /// [`cpu_waits_s`] at the start.
    cpu_waited_s: f64,
}

/// Fraction of time in which tasks wait for a processor, above which a machine is too busy for a live flight.
const BUSY: f64 = 0.3;

impl Load {
    /// Starts a measurement.
    pub fn start() -> Self {
        Self { started: Instant::now(), cpu_waited_s: cpu_waits_s() }
    }

    /// Returns whether the machine has been too busy since the start to promise a live flight.
    pub fn is_too_high(&self) -> bool {
        cpu_waits_s() - self.cpu_waited_s > BUSY * self.started.elapsed().as_secs_f64()
    }
}

/// Returns the total time in which some task has waited for a processor (Linux's pressure stall information); 0 if the
/// kernel does not measure it. [s]
fn cpu_waits_s() -> f64 {
    let text = std::fs::read_to_string("/proc/pressure/cpu").unwrap_or_default();
    let total_us = text.split("total=").nth(1).and_then(|rest| rest.split_whitespace().next());
    total_us.and_then(|number| number.parse::<f64>().ok()).map_or(0.0, |us| us * 1e-6)
}

impl Demo {
    /// Returns whether the flight of `report` has finished. If not, the machine was too busy and a safety rule landed
    /// the vehicle; then there is nothing else to check.
    ///
    /// # Panics
    /// If the flight ended in another way.
    pub fn has_finished(&self, report: &serde_json::Value, code: Option<i32>) -> bool {
        let has_finished = self.has_ended(report, &["finished"]);
        assert!(!has_finished || code == Some(0), "{code:?} {report:#} {:#?}", self.seen);
        has_finished
    }

    /// Like [`Self::has_finished`], for a flight that ends with one of `outcomes`.
    ///
    /// # Panics
    /// If the flight ended in another way.
    pub fn has_ended(&self, report: &serde_json::Value, outcomes: &[&str]) -> bool {
        let explained = format!("{report:#} {:#?}", self.seen);
        if report["outcome"].as_str().is_some_and(|outcome| outcomes.contains(&outcome)) {
            return true;
        }
        // The simulator catches up if it falls behind only a little; other processes may have been delayed instead.
        let stood_still = report["seconds_given_up"].as_f64() > Some(0.1);
        assert!(stood_still || self.load.is_too_high(), "{explained}");
        assert!(
            self.seen.iter().any(|line| line.contains("on the ground, disarmed")),
            "{explained}"
        );
        assert!(report["min_clearance_m"].as_f64().is_none_or(|m| m > 0.0), "{explained}");
        false
    }

    /// Starts `vizflyt demo --headless ARGS`, at [`MAX_RATE_HZ`] unless `ARGS` contain a rate.
    ///
    /// # Panics
    /// If the program cannot be started.
    pub fn start(args: &[&str]) -> Self {
        let rate = "--max-rate";
        let is_given = args.iter().any(|argument| argument.starts_with(rate));
        let rate = (!is_given).then(|| format!("{rate}={MAX_RATE_HZ}"));
        let mut command = Command::new(vizflyt());
        Self::spawn(command.args(["demo", "--headless"]).args(rate).args(args))
    }

    /// Starts `command` in the root of the repository.
    ///
    /// # Panics
    /// If the program cannot be started.
    pub fn spawn(command: &mut Command) -> Self {
        let mut child = command
            .current_dir(root())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .expect("vizflyt starts");
        let stdout = child.stdout.take().expect("stdout is piped");
        let (sender, lines) = mpsc::channel();
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Self { child, lines, seen: Vec::new(), load: Load::start() }
    }

    /// Waits until a line contains `text` and returns it.
    ///
    /// # Panics
    /// If no line does within `limit`, or the program ends first.
    pub fn wait_for(&mut self, text: &str, limit: Duration) -> String {
        let deadline = Instant::now() + limit;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.lines.recv_timeout(left) {
                Ok(line) => {
                    self.seen.push(line.clone());
                    if line.contains(text) {
                        return line;
                    }
                }
                Err(error) => panic!("no line with '{text}' ({error}); seen: {:#?}", self.seen),
            }
        }
    }

    /// Waits for the end; returns the exit code, or `None` after a signal.
    ///
    /// # Panics
    /// If the program has not ended within `limit`.
    pub fn wait(&mut self, limit: Duration) -> Option<i32> {
        let deadline = Instant::now() + limit;
        loop {
            self.seen.extend(self.lines.try_iter());
            if let Some(status) = self.child.try_wait().expect("the child is ours") {
                self.seen.extend(self.lines.iter());
                return status.code();
            }
            assert!(Instant::now() < deadline, "still running after {limit:?}: {:#?}", self.seen);
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Returns the process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the pids of descendants whose command line contains `text`.
    pub fn descendants(&self, text: &str) -> Vec<u32> {
        descendants(self.pid())
            .into_iter()
            .filter(|pid| {
                std::fs::read(format!("/proc/{pid}/cmdline")).is_ok_and(|line| {
                    String::from_utf8_lossy(&line).replace('\0', " ").contains(text)
                })
            })
            .collect()
    }
}

impl Drop for Demo {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns the pids of all living descendants of `root`.
pub fn descendants(root: u32) -> Vec<u32> {
    let Ok(entries) = std::fs::read_dir("/proc") else { return Vec::new() };
    let parents: Vec<(u32, u32)> = entries
        .filter_map(|entry| {
            let pid: u32 = entry.ok()?.file_name().to_str()?.parse().ok()?;
            let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
            let parent = status.lines().find_map(|line| line.strip_prefix("PPid:"))?;
            Some((pid, parent.trim().parse().ok()?))
        })
        .collect();
    let mut family = vec![root];
    let mut next = 0;
    while next < family.len() {
        let parent = family[next];
        family.extend(parents.iter().filter(|&&(_, p)| p == parent).map(|&(pid, _)| pid));
        next += 1;
    }
    family.split_off(1)
}

/// Returns whether a process runs (not for a zombie).
pub fn alive(pid: u32) -> bool {
    std::fs::read_to_string(format!("/proc/{pid}/stat"))
        .is_ok_and(|stat| !stat.rsplit(')').next().unwrap_or("").trim_start().starts_with('Z'))
}
