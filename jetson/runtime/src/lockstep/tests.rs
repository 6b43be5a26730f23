//! Real plugin processes that are waited for: the example `misbehave`.

use std::ffi::OsString;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use vizflyt_protocol::flight_end::PluginFault;
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_protocol::messages::ToPlugin;

use super::*;
use crate::supervisor::{PluginLimits, Stream};

const NO_LINES: fn(Stream, &str) = |_, _| {};

fn misbehave(how: &str) -> Vec<OsString> {
    let test = std::env::current_exe().unwrap();
    let program = test.ancestors().nth(2).unwrap().join("examples/misbehave");
    assert!(program.exists(), "run `cargo build --release --examples` first (tests/run does)");
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

/// Asks a plugin once; `meanwhile` is called when it has the image.
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
    let plugin = Pid::from_raw(process.id().cast_signed());
    let beside = std::thread::spawn(move || meanwhile(plugin));
    let result = process.ask(1, memory, &mut { NO_LINES });
    beside.join().unwrap();
    process.stop(&mut { NO_LINES });
    result
}

/// Less than the example's `sleep`, and than it is stopped for.
const SHORT: Duration = Duration::from_secs(1);

#[test]
fn a_plugin_that_takes_too_long_of_its_own_time_has_failed() {
    for how in ["hang", "spin", "sleep"] {
        let error = asked(how, SHORT, |_| ()).unwrap_err();
        let ProcessError::Failed(fault) = error else { panic!("{how}: {error}") };
        let expected = PluginFault::NoAnswer { image: 1, silent_s: SHORT.as_secs_f64() };
        assert_eq!(*fault, expected, "{how}");
    }
    assert!(asked("sleep", Duration::from_mins(1), |_| ()).is_ok());
}

#[test]
fn a_plugin_that_somebody_stops_has_not_failed() {
    let stop = |plugin| {
        kill(plugin, Signal::SIGSTOP).unwrap();
        std::thread::sleep(4 * SHORT);
        kill(plugin, Signal::SIGCONT).unwrap();
    };
    let answer = asked("slow", SHORT, stop).unwrap();
    assert!(matches!(answer, Some(Setpoint::Velocity { .. })), "{answer:?}");
}

#[test]
fn a_plugin_that_somebody_kills_is_lost_and_one_that_ends_has_failed() {
    let error = asked("hang", SHORT, |plugin| kill(plugin, Signal::SIGKILL).unwrap());
    assert!(matches!(error, Err(ProcessError::Lost(_))), "{error:?}");
    for how in ["exit", "panic", "segfault", "abort"] {
        let error = asked(how, Duration::from_mins(1), |_| ());
        assert!(matches!(error, Err(ProcessError::Failed(_))), "{how}: {error:?}");
    }
}
