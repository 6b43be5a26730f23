//! Main loop of a plugin: waits for the runtime, calls the plugin, sends its replies.

use std::any::type_name;
use std::ffi::OsString;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use vizflyt_protocol::messages::{FromPlugin, Name, ToPlugin, bounded};
use vizflyt_protocol::time::HostTime;

use crate::autonomy::Autonomy;
use crate::clock::host_now;
use crate::ipc::{IpcError, PluginEnd, SERVICE_OPTION, offers};
use crate::observation::Observation;
use crate::odometry::take_odometry;

/// Runs a plugin until the end of the flight. Call it from `main`.
///
/// The runtime passes `--vizflyt-service fd:N` on the command line. A plugin started by hand (`cargo run`, a debugger)
/// attaches to the user's only runtime that waits for a plugin (`vizflyt fly --attach`). Other arguments are left to
/// the plugin.
///
/// Returns 0 after a flight, 1 if the runtime ended unexpectedly, 2 if there was no runtime to attach to, 101 after a
/// panic in the plugin (which is reported to the runtime).
pub fn run<A: Autonomy>(plugin: A) -> ExitCode {
    let given = service_argument(std::env::args_os());
    let program = std::env::args().next().unwrap_or_default();
    match given.map_or_else(|| the_one_that_waits(&offers(), &program), Ok) {
        Ok(service) => attach(plugin, &service),
        Err(sentence) => {
            eprintln!("plugin: {sentence}");
            ExitCode::from(NOT_ATTACHED)
        }
    }
}

/// Returns the service of the only waiting runtime, or an error message with the next step for the user.
fn the_one_that_waits(waiting: &[String], program: &str) -> Result<String, String> {
    match waiting {
        [service] => Ok(service.clone()),
        [] => Err(format!(
            "no runtime waits for a plugin; start one with `vizflyt fly --attach` in another \
             terminal, or fly with `vizflyt fly {program}`"
        )),
        several => Err(format!(
            "{} runtimes wait for a plugin: choose one with {SERVICE_OPTION} X, X being one of {}",
            several.len(),
            several.join(", ")
        )),
    }
}

/// As [`run`], for a given service.
pub fn attach<A: Autonomy>(mut plugin: A, service: &str) -> ExitCode {
    let end = match PluginEnd::open(service) {
        Ok(end) => end,
        Err(error) => {
            eprintln!("plugin: {error}");
            return ExitCode::from(NOT_ATTACHED);
        }
    };
    let panic_message = record_panics();
    match catch_unwind(AssertUnwindSafe(|| serve(&mut plugin, &end))) {
        Ok(Ok(End::Stopped)) => ExitCode::SUCCESS,
        Ok(Ok(End::RuntimeGone)) => {
            eprintln!("plugin: the runtime is gone; ending");
            ExitCode::FAILURE
        }
        Ok(Err(error)) => {
            eprintln!("plugin: {error}");
            ExitCode::FAILURE
        }
        Err(_) => {
            let message = panic_message.lock().unwrap_or_else(PoisonError::into_inner).take();
            let reason = message.unwrap_or_else(|| "the plugin panicked".to_owned());
            // If this fails too, the runtime still sees the exit status.
            let _ = end.send(&FromPlugin::Failed { reason: bounded(&reason) });
            ExitCode::from(PANICKED)
        }
    }
}

/// Exit status: no runtime to attach to.
const NOT_ATTACHED: u8 = 2;
/// Exit status after a panic, the same as Rust's.
const PANICKED: u8 = 101;
/// Maximum wait between polls; any message or observation ends the wait earlier.
const A_WHILE: Duration = Duration::from_secs(10);

/// Why the loop ended.
enum End {
    Stopped,
    RuntimeGone,
}

fn serve<A: Autonomy>(plugin: &mut A, end: &PluginEnd) -> Result<End, IpcError> {
    // `None` until the runtime has sent the arena.
    let mut names: Option<Vec<Name>> = None;
    let mut imu_had = HostTime::ZERO;
    loop {
        end.wait(A_WHILE)?;
        loop {
            let message = match end.receive() {
                Ok(Some(message)) => message,
                Ok(None) => break,
                Err(IpcError::Gone(_)) => {
                    plugin.on_stop();
                    return Ok(End::RuntimeGone);
                }
                Err(error) => return Err(error),
            };
            match message {
                ToPlugin::Start(info) => {
                    plugin.on_start(&info);
                    names = Some(info.cameras.iter().map(|camera| camera.name.clone()).collect());
                    end.send(&FromPlugin::Ready { name: bounded(short_name::<A>()) })?;
                }
                ToPlugin::Event(event) => plugin.on_event(&event),
                ToPlugin::Stop => {
                    plugin.on_stop();
                    return Ok(End::Stopped);
                }
            }
        }
        let Some(names) = &names else { continue };
        let Some(sample) = end.observation()? else { continue };
        // The runtime does not validate observations. An invalid one is a bug of the runtime and is skipped.
        let Ok(observation) = Observation::from_bytes(sample.bytes(), names) else { continue };
        let entered = host_now();
        let setpoint = plugin.on_image(&observation.with_imu_after(imu_had));
        imu_had = observation.newest_imu().unwrap_or(imu_had);
        for odometry in take_odometry() {
            end.send(&FromPlugin::Odometry(odometry))?;
        }
        let seq = observation.seq();
        end.send(&FromPlugin::Reply { seq, entered, returned: host_now(), setpoint })?;
    }
}

/// Returns the name of the type without its path.
fn short_name<A>() -> &'static str {
    let full = type_name::<A>();
    full.split('<').next().and_then(|path| path.rsplit("::").next()).unwrap_or(full)
}

/// Stores the message of a panic on this thread, in addition to the usual print.
fn record_panics() -> Arc<Mutex<Option<String>>> {
    let slot = Arc::new(Mutex::new(None));
    let (kept, plugin_thread) = (Arc::clone(&slot), thread::current().id());
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if thread::current().id() == plugin_thread {
            let message = info.payload_as_str().unwrap_or("a panic without a message");
            let place = info.location().map(|at| format!(" at {}:{}", at.file(), at.line()));
            let text = format!("panicked{}: {message}", place.unwrap_or_default());
            *kept.lock().unwrap_or_else(PoisonError::into_inner) = Some(text);
        }
        print(info);
    }));
    slot
}

/// Returns the value of `--vizflyt-service`, given as `--vizflyt-service X` or `--vizflyt-service=X`.
fn service_argument(arguments: impl Iterator<Item = OsString>) -> Option<String> {
    let mut arguments = arguments.filter_map(|argument| argument.into_string().ok());
    while let Some(argument) = arguments.next() {
        if argument == SERVICE_OPTION {
            return arguments.next();
        }
        if let Some(value) = argument.strip_prefix(SERVICE_OPTION).and_then(|v| v.strip_prefix('='))
        {
            return Some(value.to_owned());
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(arguments: &[&str], expected: Option<&str>) {
        let found = service_argument(arguments.iter().map(OsString::from));
        assert_eq!(found.as_deref(), expected);
    }

    #[test]
    fn finds_the_service_among_other_arguments() {
        check(&["me", "--vizflyt-service", "a/b"], Some("a/b"));
        check(&["me", "avoid", "--gain=2", "--vizflyt-service=a/b"], Some("a/b"));
        check(&["me", "--vizflyt-service"], None);
        check(&["me", "--vizflyt-services=x"], None);
        check(&["me"], None);
    }

    #[test]
    fn attaches_to_the_only_waiting_runtime_when_started_by_hand() {
        let waiting = ["a".to_owned(), "b".to_owned()];
        assert_eq!(the_one_that_waits(&waiting[..1], "me"), Ok("a".to_owned()));
        let none = the_one_that_waits(&[], "me").unwrap_err();
        assert!(none.contains("`vizflyt fly me`"), "{none}");
        let several = the_one_that_waits(&waiting, "me").unwrap_err();
        assert!(several.contains("choose one with --vizflyt-service X"), "{several}");
        assert!(several.ends_with("a, b"), "{several}");
    }

    #[test]
    fn plugin_name_has_no_path_and_no_type_arguments() {
        struct Avoid<T>(T);
        assert_eq!(short_name::<Avoid<String>>(), "Avoid");
    }
}
