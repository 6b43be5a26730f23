//! Tests with real child processes: the shell, and the example plugin over shared memory.

use std::path::PathBuf;
use std::sync::mpsc::{Receiver, channel};
use std::time::Instant;

use vizflyt_protocol::geometry::{Intrinsics, Volume};
use vizflyt_protocol::messages::{
    ArenaInfo, CameraInfo, Event, EventKind, FlightPhase, FromPlugin, Limits, Setpoint, ToPlugin,
    bounded,
};
use vizflyt_protocol::time::ServerTime;
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::ipc::{PluginSocket, RuntimeEnd};
use vizflyt_sdk::{ImageStamps, ObservationWriter};

use super::*;
use nix::unistd::geteuid;

mod walls;

/// Timeout of all waits, far above what a loaded machine needs.
const WAIT: Duration = Duration::from_mins(1);

fn start(command: &[&str]) -> (Supervisor, Receiver<PluginEvent>) {
    start_with(&PluginLimits::default(), command)
}

fn start_with(limits: &PluginLimits, command: &[&str]) -> (Supervisor, Receiver<PluginEvent>) {
    start_connected(limits, command, None)
}

fn start_connected(
    limits: &PluginLimits,
    command: &[&str],
    socket: Option<PluginSocket>,
) -> (Supervisor, Receiver<PluginEvent>) {
    let (sender, receiver) = channel();
    let command: Vec<OsString> = command.iter().map(OsString::from).collect();
    let handle = move |event| {
        let _ = sender.send(event);
    };
    let confinement = Confinement::prepare(limits, &command);
    (Supervisor::start(&command, &confinement, socket, handle).unwrap(), receiver)
}

/// Returns the lines of a child that ends by itself, and the sentence about its end.
fn to_the_end(command: &[&str]) -> (Vec<(Stream, String)>, String) {
    to_the_end_with(&PluginLimits::default(), command)
}

fn to_the_end_with(limits: &PluginLimits, command: &[&str]) -> (Vec<(Stream, String)>, String) {
    let (_supervisor, receiver) = start_with(limits, command);
    let (mut lines, mut sentence) = (Vec::new(), String::new());
    // Ends when all threads of the supervisor have dropped their sender.
    while let Ok(event) = receiver.recv_timeout(WAIT) {
        match event {
            PluginEvent::Line(stream, line) => lines.push((stream, line)),
            PluginEvent::Exited(how) => sentence = how,
            PluginEvent::Note(_) => {}
        }
    }
    (lines, sentence)
}

#[test]
fn passes_only_the_plugins_own_map() {
    let look = |limits: &PluginLimits| {
        let (lines, _) = to_the_end_with(limits, &["sh", "-c", "echo \"map: $VIZFLYT_MAP\""]);
        lines.into_iter().map(|(_, line)| line).collect::<Vec<_>>()
    };
    let text = r#"[{"sphere":{"center_m":[1,2,3],"radius_m":0.5}}]"#;
    let mut limits = PluginLimits::default();
    assert_eq!(look(&limits), ["map: "]);
    limits.hand_map(text).unwrap();
    assert_eq!(look(&limits), [format!("map: {text}")]);
}

fn check_sentence(script: &str, expected: &str) {
    let (_, sentence) = to_the_end(&["sh", "-c", script]);
    assert!(sentence.starts_with(expected), "{script}: {sentence}");
}

#[test]
fn reports_each_kind_of_exit() {
    check_sentence("exit 0", "the plugin ended by itself (exit status 0)");
    check_sentence("exit 7", "the plugin ended with exit status 7");
    check_sentence("kill -SEGV $$", "the plugin was killed by SIGSEGV: it touched memory");
    check_sentence("kill -ABRT $$", "the plugin was killed by SIGABRT: it aborted");
    check_sentence("kill -KILL $$", "the plugin was killed by SIGKILL: by a user");
    check_sentence("kill -TERM $$", "the plugin was killed by SIGTERM");
}

#[test]
fn fails_if_the_program_is_missing() {
    let command = [OsString::from("/nonexistent/plugin")];
    let confinement = Confinement::prepare(&PluginLimits::default(), &command);
    let error = Supervisor::start(&command, &confinement, None, |_| {}).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::NotFound);
    assert!(Supervisor::start(&[], &confinement, None, |_| {}).is_err());
}

#[test]
fn splits_output_into_lines_and_cuts_long_ones() {
    let (lines, _) = to_the_end(&[
        "sh",
        "-c",
        "echo one; echo two >&2; printf '%5000s\\nlast' x; printf '\\377\\n' >&2",
    ]);
    let of = |stream| -> Vec<&str> {
        lines.iter().filter(|(s, _)| *s == stream).map(|(_, line)| line.as_str()).collect()
    };
    let out = of(Stream::Stdout);
    assert_eq!((out[0], out[1].len(), out[2]), ("one", LINE_BYTES, "last"));
    assert_eq!(of(Stream::Stderr), ["two", "\u{fffd}"]);
}

#[test]
fn drops_and_counts_excess_output() {
    let (lines, _) = to_the_end(&["sh", "-c", "yes | head -n 100000"]);
    assert!(lines.len() < 20_000, "{}", lines.len());
    assert!(lines.iter().any(|(_, line)| line.contains("more lines in that second")));
}

#[test]
fn kills_a_plugin_that_does_not_end_with_its_descendants() {
    let script = "trap '' TERM; sleep 1000.0625 & echo up; while :; do wait; done";
    let (supervisor, receiver) = start(&["sh", "-c", script]);
    let Ok(PluginEvent::Line(..)) = receiver.recv_timeout(WAIT) else { panic!() };
    let until = Instant::now() + WAIT;
    while !runs("1000.0625") {
        assert!(supervisor.is_running() && Instant::now() < until, "it starts");
        thread::yield_now();
    }
    supervisor.end();
    assert!(!supervisor.is_running());
    until_gone("1000.0625");
}

/// Whether a process with `argument` runs. In a cell, its process id differs, so it is found by its argument.
fn runs(argument: &str) -> bool {
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    processes.filter(|entry| entry.file_name() != *std::process::id().to_string()).any(|entry| {
        let line = std::fs::read(entry.path().join("cmdline")).unwrap_or_default();
        line.split(|&byte| byte == 0).any(|part| part == argument.as_bytes())
    })
}

fn until_gone(argument: &str) {
    let until = Instant::now() + WAIT;
    while runs(argument) {
        assert!(Instant::now() < until, "a process with {argument} lives on");
        thread::yield_now();
    }
}

#[test]
fn child_ends_with_the_thread_that_started_it() {
    let (sender, receiver) = channel();
    let starter = thread::spawn(move || {
        let command = ["sh", "-c", "echo up; sleep 1000"].map(OsString::from);
        let handle = move |event| {
            let _ = sender.send(event);
        };
        // `forget`: a killed runtime does not drop its supervisor either.
        let confinement = Confinement::prepare(&PluginLimits::default(), &command);
        std::mem::forget(Supervisor::start(&command, &confinement, None, handle).unwrap());
    });
    starter.join().unwrap();
    let end = std::iter::from_fn(|| receiver.recv_timeout(WAIT).ok())
        .find(|event| matches!(event, PluginEvent::Exited(_)));
    let Some(PluginEvent::Exited(sentence)) = end else { panic!("it lives on") };
    assert!(sentence.contains("SIGKILL"), "{sentence}");
}

// ---- confinement ----

/// Runs a Python program; returns its output and the sentence about its end.
fn python(limits: &PluginLimits, program: &str) -> (String, String) {
    let (mut lines, sentence) = to_the_end_with(limits, &["python3", "-c", program]);
    // The order between the two pipes is random.
    lines.sort_by_key(|(stream, _)| *stream != Stream::Stdout);
    let lines: Vec<_> = lines.into_iter().map(|(_, line)| line).collect();
    (lines.join("\n"), sentence)
}

#[test]
fn network_needs_permission_and_system_calls_are_blocked() {
    let program = "
import socket, ctypes, os
for family in (socket.AF_INET, socket.AF_INET6):
    try:
        socket.socket(family, socket.SOCK_DGRAM); print('open')
    except OSError as error:
        print(error.strerror)
try:
    socket.socket(socket.AF_UNIX); print('unix')
except OSError as error:
    print(error.strerror)
socket.socketpair(); print('pair')
libc = ctypes.CDLL(None, use_errno=True)
print('unshare', libc.unshare(0x10000000), os.strerror(ctypes.get_errno()))
print('ptrace', libc.ptrace(16, os.getppid(), 0, 0), os.strerror(ctypes.get_errno()))
socket.create_connection(('192.0.2.1', 80), timeout=1)
";
    let (output, sentence) = python(&PluginLimits::default(), program);
    let expected = "Network is unreachable\nNetwork is unreachable\nNetwork is unreachable\npair\n\
                    unshare -1 Operation not permitted\nptrace -1 Operation not permitted";
    assert!(output.starts_with(expected), "{output}");
    assert!(sentence.contains("no network unless [plugin] sets network = true"), "{sentence}");
    let allowed = PluginLimits { network: true, ..PluginLimits::default() };
    let (output, _) = python(&allowed, "import socket; socket.socket(); print('open')");
    assert_eq!(output, "open");
}

#[test]
fn plugin_writes_in_its_own_folders_only_and_sends_no_signals() {
    let folder = tempfile::Builder::new().prefix("vizflyt-test-").tempdir_in("/var/tmp").unwrap();
    let mode = std::os::unix::fs::PermissionsExt::from_mode(0o777);
    std::fs::set_permissions(folder.path(), mode).unwrap();
    let file = folder.path().join("x");
    let program = format!(
        "import os, tempfile
tempfile.TemporaryFile().write(b'x'); print('scratch')
try:
    os.kill(os.getppid(), 0); print('signalled')
except PermissionError:
    print('no signal')
open({file:?}, 'w').write('x'); print('written')"
    );
    let (output, sentence) = python(&PluginLimits::default(), &program);
    // Without Landlock, a separate user may still prevent the access.
    if !Confinement::prepare(&PluginLimits::default(), &[]).is_partial() {
        assert!(output.contains("scratch\nno signal"), "{output}");
        assert!(!file.exists(), "{output}");
        assert!(sentence.contains("a plugin sees its own folder"), "{sentence}");
    }
    let limits = PluginLimits { read: vec![folder.path().to_owned()], ..PluginLimits::default() };
    let (output, sentence) = python(&limits, &program);
    if !Confinement::prepare(&limits, &[]).is_partial() {
        assert!(!file.exists(), "{output}");
        assert!(sentence.contains("Read-only file system"), "{sentence}");
    }
    let limits = PluginLimits { write: vec![folder.path().to_owned()], ..PluginLimits::default() };
    let (output, _) = python(&limits, &program);
    assert!(output.contains("written") && file.exists(), "{output}");
}

#[test]
fn plugin_cannot_read_hidden_folders() {
    let folder = tempfile::Builder::new().prefix("vizflyt-test-").tempdir_in("/var/tmp").unwrap();
    let mode = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    std::fs::set_permissions(folder.path(), mode).unwrap();
    let (secret, open) = (folder.path().join("secret"), folder.path().join("open"));
    for folder in [&secret, &open] {
        std::fs::create_dir(folder).unwrap();
        std::fs::write(folder.join("x"), "read").unwrap();
    }
    let program = format!(
        "print(open('{0}/x').read()); print(open('{1}/x').read())",
        open.display(),
        secret.display()
    );
    let read = vec![folder.path().to_owned()];
    let limits = PluginLimits { hide: vec![secret], read, ..PluginLimits::default() };
    let (output, sentence) = python(&limits, &program);
    if Confinement::prepare(&limits, &[]).is_partial() {
        assert_eq!(
            output, "read\nread",
            "without Landlock only the user's rights count: {sentence}"
        );
    } else {
        assert!(output.starts_with("read\n") && output.contains("PermissionError"), "{output}");
    }
}

#[test]
fn plugin_is_not_root_and_has_no_capabilities() {
    let program = "
import os
status = open('/proc/self/status').read()
print(os.geteuid() == 0, [line.split()[1] for line in status.splitlines() if 'CapEff' in line])";
    for user in [None, Some("root".to_owned()), Some("nobody".to_owned())] {
        let limits = PluginLimits { user: user.clone(), ..PluginLimits::default() };
        let (output, _) = python(&limits, program);
        assert!(output.contains("0000000000000000"), "{user:?}: {output}");
        // The plugin stays root if requested, or if no other user can read its files.
        let command = ["python3", "-c", program].map(OsString::from);
        let changes = Confinement::prepare(&limits, &command).user_id().is_some();
        assert_eq!(
            output.starts_with("False"),
            changes || !geteuid().is_root(),
            "{user:?}: {output}"
        );
    }
}

#[test]
fn kills_and_reports_a_plugin_above_its_memory_limit() {
    let limits = PluginLimits { memory_mb: 200, ..PluginLimits::default() };
    let program = "
held = []
while True: held.append(bytearray(5_000_000))";
    let (_, sentence) = python(&limits, program);
    assert!(sentence.contains("more than its 200 MB of memory"), "{sentence}");
    // Without a control group, the interpreter's allocation fails, and it reports this.
    assert_eq!(hint("MemoryError"), " (memory_mb in [plugin] allows no more)");
}

#[test]
fn stops_a_fork_bomb_with_all_its_processes() {
    let limits = PluginLimits { processes: 30, ..PluginLimits::default() };
    let program = "
import os
while True:
    try: os.fork()
    except OSError: pass";
    let (_, sentence) = python(&limits, program);
    assert!(sentence.contains("more than its 30 processes"), "{sentence}");
}

// ---- the example plugin over real shared memory ----

fn cameras() -> Vec<CameraInfo> {
    vec![CameraInfo::forward("front", Intrinsics::from_horizontal_fov(64, 48, 1.5))]
}

fn arena() -> ArenaInfo {
    let hall = Volume::aabb(DVec3::splat(-9.0), DVec3::splat(9.0));
    ArenaInfo {
        cameras: cameras().into_iter().collect(),
        ..ArenaInfo::new("test", hall, Limits::new(3.0, 4.0))
    }
}

/// Returns the path of the example, which `cargo test` builds.
fn example() -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    tests.parent().unwrap().parent().unwrap().join("examples/misbehave")
}

struct Rig {
    ipc: RuntimeEnd,
    supervisor: Supervisor,
    events: Receiver<PluginEvent>,
    seq: u64,
}

impl Rig {
    fn start(how: &str) -> Self {
        let ipc = RuntimeEnd::new(ObservationWriter::len_for(&cameras()));
        let socket = Some(ipc.connect().unwrap());
        let program = example();
        let command = [program.to_str().unwrap(), how];
        let (supervisor, events) = start_connected(&PluginLimits::default(), &command, socket);
        let mut rig = Self { ipc, supervisor, events, seq: 0 };
        rig.until(|rig| rig.ipc.plugin_attached());
        rig.ipc.send(&ToPlugin::Start(arena())).unwrap();
        assert!(matches!(rig.next(), Some(FromPlugin::Ready { name }) if name == "Misbehave"));
        rig
    }

    fn until(&mut self, done: impl Fn(&Self) -> bool) {
        let until = Instant::now() + WAIT;
        while !done(self) {
            assert!(Instant::now() < until, "nothing came");
            thread::yield_now();
        }
    }

    /// Returns the plugin's next message; `None` if the plugin ends instead.
    fn next(&mut self) -> Option<FromPlugin> {
        loop {
            // Checked first: messages that a plugin sent before it ended are still read.
            let running = self.supervisor.is_running();
            if let Some(message) = self.ipc.receive().unwrap() {
                return Some(message);
            }
            if !running {
                return None;
            }
            self.ipc.wait(Duration::from_millis(20)).unwrap();
        }
    }

    fn publish(&mut self) {
        self.seq += 1;
        let cameras = cameras();
        let mut loan = self.ipc.loan(ObservationWriter::len_for(&cameras)).unwrap();
        let mut writer = ObservationWriter::new(loan.memory(), self.seq, &cameras).unwrap();
        writer.planes(0, &cameras[0]).unwrap().depth_mm.fill(1500);
        writer.image_ready(0, &cameras[0], ImageStamps::default());
        self.ipc.publish(loan).unwrap();
    }

    fn end(&self) -> String {
        let exited =
            std::iter::from_fn(|| self.events.recv_timeout(WAIT).ok()).find_map(
                |event| match event {
                    PluginEvent::Exited(sentence) => Some(sentence),
                    PluginEvent::Line(..) | PluginEvent::Note(_) => None,
                },
            );
        exited.expect("the plugin ends")
    }
}

#[test]
fn plugin_replies_to_each_image_and_stops_on_request() {
    let mut rig = Rig::start("hover");
    for _ in 0..50 {
        rig.publish();
        let Some(FromPlugin::Reply { seq, entered, returned, setpoint }) = rig.next() else {
            panic!("no answer")
        };
        assert_eq!((seq, setpoint), (rig.seq, Some(Setpoint::Hold)));
        assert!(returned >= entered && vizflyt_sdk::host_now() >= returned);
    }
    rig.ipc.send(&ToPlugin::Stop).unwrap();
    let lines: Vec<_> = std::iter::from_fn(|| rig.events.recv_timeout(WAIT).ok()).collect();
    let line = |text: &str| PluginEvent::Line(Stream::Stdout, text.into());
    assert!(lines.contains(&line("flying in test as hover")), "{lines:?}");
    assert!(lines.contains(&line("stopped after 50 images")), "{lines:?}");
    let sentence = "the plugin ended by itself (exit status 0)".to_owned();
    assert!(lines.contains(&PluginEvent::Exited(sentence)), "{lines:?}");
}

#[test]
fn panic_is_reported_with_its_message() {
    let mut rig = Rig::start("panic");
    rig.publish();
    let Some(FromPlugin::Failed { reason }) = rig.next() else { panic!("no failure") };
    assert!(reason.contains("misbehave.rs") && reason.contains("index 1 out of range"), "{reason}");
    assert!(rig.end().contains("exit status 101"));
}

#[test]
fn runtime_continues_if_the_plugin_ends_during_an_image() {
    for (how, expected) in
        [("exit", "exit status 0"), ("exit-3", "exit status 3"), ("abort", "SIGABRT")]
    {
        let mut rig = Rig::start(how);
        rig.publish();
        assert_eq!(rig.next(), None, "{how} answers nothing");
        let sentence = rig.end();
        assert!(sentence.contains(expected), "{how}: {sentence}");
        // The ended reader's slot is reclaimed, and publishing continues.
        rig.ipc.clean_up();
        assert!(!rig.ipc.plugin_attached());
        for _ in 0..20 {
            rig.publish();
        }
    }
}

#[test]
fn kills_a_hung_plugin_without_blocking() {
    let mut rig = Rig::start("hang");
    rig.publish();
    for _ in 0..500 {
        rig.publish();
        let event = Event {
            stamp: ServerTime::ZERO,
            kind: EventKind::Phase(FlightPhase::Flying),
            text: bounded("flying"),
        };
        // When the socket is full, sending fails and does not block.
        let _ = rig.ipc.send(&ToPlugin::Event(event));
    }
    rig.supervisor.end();
    assert!(!rig.supervisor.is_running());
    rig.ipc.clean_up();
    assert!(!rig.ipc.plugin_attached());
}

#[test]
fn measures_computing_and_sleeping_time() {
    let looks_until = |script: &str, is_so: fn(&TimeSpent) -> bool| {
        let since = host_now();
        let (supervisor, _events) = start(&["sh", "-c", script]);
        // In addition to the watch thread, which samples at 10 Hz.
        while !supervisor.time_spent(since).is_some_and(|spent| is_so(&spent)) {
            supervisor.shared.look();
        }
    };
    looks_until("while :; do :; done", |spent| {
        spent.computed_s > 0.0 && !spent.to_string().contains("slept")
    });
    looks_until("exec sleep 100", |spent| spent.to_string().contains("slept"));
}
