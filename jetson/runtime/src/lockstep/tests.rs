//! Tests with real plugin processes (the example `misbehave`), and with the log of their observations.

use std::ffi::OsString;
use std::fs::{self, File};
use std::path::Path;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use vizflyt_protocol::flight_end::PluginFault;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_protocol::messages::{Event, EventKind, FlightPhase, Limits, ToPlugin, bounded};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;
use vizflyt_sdk::ImageStamps;

use super::*;
use crate::log::read::{LogReader, RecordedFlight};
use crate::log::{LoggedImages, VirtualLog};
use crate::replay::{ReplayOptions, ReplayPlan, replay};
use crate::supervisor::{PluginLimits, Stream};

const NO_LINES: fn(Stream, &str) = |_, _| {};

fn misbehave(how: &str) -> Vec<OsString> {
    let test = std::env::current_exe().unwrap();
    let program = test.ancestors().nth(2).unwrap().join("examples/misbehave");
    assert!(program.exists(), "run `cargo build --examples` first (tests/run does)");
    vec![program.into(), how.into()]
}

fn camera() -> CameraInfo {
    CameraInfo::forward("front", Intrinsics::from_horizontal_fov(32, 24, 1.5))
}

fn arena() -> ArenaInfo {
    let mut arena = crate::flight::tests::arena();
    arena.cameras.clear();
    let _ = arena.cameras.push(camera());
    arena
}

fn at(ms: u64) -> HostTime {
    HostTime::from_ns(10_000_000_000 + ms * 1_000_000)
}

/// Returns the innermost descendant of a process: within a cell, the plugin.
fn innermost(id: u32) -> Pid {
    let children = std::fs::read_to_string(format!("/proc/{id}/task/{id}/children"));
    let child = children.unwrap_or_default();
    match child.split(' ').next().and_then(|child| child.parse().ok()) {
        Some(child) => innermost(child),
        None => Pid::from_raw(id.cast_signed()),
    }
}

/// Sends one observation to a plugin; calls `meanwhile` when it has the image.
fn asked(
    how: &str,
    within: Duration,
    meanwhile: impl FnOnce(Pid) + Send + 'static,
) -> Result<Option<Setpoint>, ProcessError> {
    let limits = PluginLimits::default();
    let mut process = PluginProcess::start(&misbehave(how), &limits, within)?;
    process.begin(&ToPlugin::Start(arena()), &mut { NO_LINES })?;
    let cameras = [camera()];
    let mut memory = process.loan(ObservationWriter::len_for(&cameras))?;
    ObservationWriter::new(memory.memory(), 1, &cameras)?;
    let plugin = innermost(process.id());
    let beside = std::thread::spawn(move || meanwhile(plugin));
    let result = process.ask(1, memory, &mut { NO_LINES });
    beside.join().unwrap();
    process.stop(&mut { NO_LINES });
    result
}

/// Shorter than the example's `sleep`, and than the time for which it is stopped.
const SHORT: Duration = Duration::from_secs(1);

#[test]
fn fails_a_plugin_that_exceeds_its_own_time() {
    for how in ["hang", "spin", "sleep"] {
        let error = asked(how, SHORT, |_| ()).unwrap_err();
        let ProcessError::Failed(fault) = error else { panic!("{how}: {error}") };
        let expected = PluginFault::NoAnswer { image: 1, silent_s: SHORT.as_secs_f64() };
        assert_eq!(*fault, expected, "{how}");
    }
    assert!(asked("sleep", Duration::from_mins(1), |_| ()).is_ok());
}

#[test]
fn does_not_fail_a_plugin_that_is_stopped_from_outside() {
    let stop = |plugin| {
        kill(plugin, Signal::SIGSTOP).unwrap();
        std::thread::sleep(4 * SHORT);
        kill(plugin, Signal::SIGCONT).unwrap();
    };
    let answer = asked("slow", SHORT, stop).unwrap();
    assert!(matches!(answer, Some(Setpoint::Velocity { .. })), "{answer:?}");
}

#[test]
fn a_killed_plugin_is_lost_and_an_ended_plugin_has_failed() {
    let error = asked("hang", SHORT, |plugin| kill(plugin, Signal::SIGKILL).unwrap());
    assert!(matches!(error, Err(ProcessError::Lost(_))), "{error:?}");
    for how in ["exit", "panic", "segfault", "abort"] {
        let error = asked(how, Duration::from_mins(1), |_| ());
        assert!(matches!(error, Err(ProcessError::Failed(_))), "{how}: {error:?}");
    }
}

/// Shows twenty images to a plugin in lock-step, and logs them.
fn logged(path: &Path, images: LoggedImages) {
    let command = misbehave("forward");
    let process =
        PluginProcess::start(&command, &PluginLimits::default(), Duration::from_mins(1)).unwrap();
    let settings = FlightSettings {
        ready_within_s: 60.0,
        time_limit_s: 0.0,
        limits: Limits::NONE,
        slip_seed: 7,
        cameras: Vec::new(),
    };
    let mut lockstep = Lockstep::new(at(0), &arena(), settings, Some(process), 10_000_000);
    let file = File::create(path).unwrap();
    let plugin = &"misbehave".into();
    lockstep.set_log(VirtualLog::new(file, images, plugin, false, at(0)).unwrap());
    lockstep.begin(at(0), &mut { NO_LINES }).unwrap();
    let cameras = [camera()];
    for seq in 1..=20 {
        let now = at(seq * 33);
        let (rgb, depth_mm) = (vec![seq as u8; 32 * 24 * 3], vec![seq as u16 * 100; 32 * 24]);
        let stamp = ServerTime::from_ns(now.as_ns());
        if seq == 7 {
            let kind = EventKind::Phase(FlightPhase::Flying);
            let event = Event { stamp, kind, text: bounded("the plugin flies") };
            lockstep.companion.handle_event(now, &event);
        }
        let (mount, body) = (&cameras[0].body_from_cam, Pose::IDENTITY);
        let header = ImageHeader::new(seq, 0, stamp, &cameras[0].intrinsics, mount, &body);
        let (pose, name) = (now, "front");
        let image = GivenImage { header: &header, name, pose, rgb: &rgb, depth_mm: &depth_mm };
        let stamps = ImageStamps { seq, pose: now, ahead_ns: 0, ready: now };
        let write = |writer: &mut ObservationWriter<'_>| {
            let planes = writer.planes(0, &cameras[0]).unwrap();
            planes.rgb.copy_from_slice(&rgb);
            planes.depth_mm.copy_from_slice(&depth_mm);
            writer.image_ready(0, &cameras[0], stamps);
        };
        let reply = lockstep.show(now, seq, &cameras, write, &[image], &mut { NO_LINES }).unwrap();
        assert!(reply.unwrap().setpoint.is_some());
        lockstep.handle_timeout(now.plus_ns(20_000_000));
    }
    lockstep.stop(&mut { NO_LINES });
    lockstep.take_log().unwrap().finish().unwrap();
}

#[test]
fn logs_on_the_virtual_clock_are_reproducible_and_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("one.mcap");
    logged(&path, LoggedImages::Full);
    let again = folder.path().join("again.mcap");
    logged(&again, LoggedImages::Full);
    assert!(
        fs::read(&path).unwrap() == fs::read(&again).unwrap(),
        "the log contains no wall clock"
    );
    let plan = ReplayPlan::read(RecordedFlight::new(LogReader::open(&path).unwrap(), false));
    let plan = plan.unwrap();
    assert_eq!(plan.flown.as_ref().unwrap().plugin, "misbehave");
    let options = ReplayOptions {
        command: misbehave("forward"),
        limits: PluginLimits::default(),
        is_realtime: false,
        all: false,
        answer_within: Duration::from_mins(1),
        answers: folder.path().join("answers.jsonl"),
    };
    let mut lines = Vec::new();
    let line = &mut |_: Stream, text: &str| lines.push(text.to_owned());
    let report = replay(&path, plan, &options, line).unwrap();
    assert_eq!((report.images_fed, report.compared, report.differ), (20, 20, 0), "{report:?}");
    assert_eq!((report.images_missing, report.log_is_cut), (0, false));
    assert!(lines.contains(&"stopped after 20 images".to_owned()), "{lines:?}");
    // Viewers find each image as JPEG.
    let mut reader = LogReader::open(&path).unwrap();
    let mut shown = 0;
    while let Some(entry) = reader.next().unwrap() {
        let crate::log::read::Entry::Message(message) = entry else { continue };
        shown += u64::from(&*message.topic == "/camera/front/image");
    }
    assert_eq!(shown, 20);
}
