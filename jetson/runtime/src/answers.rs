//! What the plugin says, from shared memory to the control loop: as it comes, but not more of it
//! than a plugin that answers images can have to say.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use vizflyt_protocol::messages::{FromPlugin, bounded};
use vizflyt_sdk::ipc::{IpcError, RuntimeEnd};

/// Messages taken per second: twice 200 images a second, more than any camera here gives, and a
/// fifth of what would keep the control loop busy.
const PER_SECOND: u32 = 400;
/// The window in which they are counted.
const WINDOW: Duration = Duration::from_millis(250);

/// Counts messages; says once when there are too many, or what comes is no message.
#[derive(Debug)]
struct Valve {
    opened: Instant,
    passed: u32,
    shut: bool,
}

impl Valve {
    fn new(now: Instant) -> Self {
        Self { opened: now, passed: 0, shut: false }
    }

    /// Returns what to pass on for what was received.
    fn take(&mut self, now: Instant, received: Result<FromPlugin, String>) -> Option<FromPlugin> {
        if self.shut {
            return None;
        }
        if now.saturating_duration_since(self.opened) >= WINDOW {
            (self.opened, self.passed) = (now, 0);
        }
        self.passed += 1;
        let most = PER_SECOND * WINDOW.as_millis() as u32 / 1000;
        let fault = match received {
            Ok(message) if self.passed <= most => return Some(message),
            Ok(_) => format!(
                "it sends more than {PER_SECOND} setpoints a second; one for each image is taken"
            ),
            Err(why) => format!(
                "what it sends is no setpoint ({why}); return a Setpoint, and build it against this \
                 version of the SDK"
            ),
        };
        // One is enough: a plugin that does this is not flying, and the loop shall not drown.
        self.shut = true;
        Some(FromPlugin::Failed { reason: bounded(&fault) })
    }
}

/// What the plugins of one offer say, one process after another.
#[derive(Debug)]
pub(crate) struct Answers {
    ipc: Arc<RuntimeEnd>,
    /// Another process begins: what the former one did is forgotten.
    anew: AtomicBool,
    valve: Mutex<Valve>,
}

impl Answers {
    pub(crate) fn new(ipc: Arc<RuntimeEnd>) -> Self {
        Self { ipc, anew: AtomicBool::new(false), valve: Mutex::new(Valve::new(Instant::now())) }
    }

    /// Another process speaks from now on.
    pub(crate) fn begin_anew(&self) {
        self.anew.store(true, Ordering::Relaxed);
    }

    /// Reads until `stop`, and passes messages to `tell`.
    pub(crate) fn read(&self, stop: &AtomicBool, tell: impl Fn(FromPlugin)) {
        while !stop.load(Ordering::Relaxed) {
            if self.ipc.wait(Duration::from_millis(100)).is_err() {
                // No event comes any more; poll instead.
                thread::sleep(Duration::from_millis(1));
            }
            self.drain(&tell);
        }
    }

    /// Passes on what has come. Once it returns, `tell` has been given all that was sent before the call,
    /// by whichever thread: a plugin's last word is not lost to the news of its end.
    pub(crate) fn drain(&self, tell: impl Fn(FromPlugin)) {
        let mut valve = self.valve.lock().unwrap_or_else(PoisonError::into_inner);
        // At most a queue full, so that `stop` is seen whatever the plugin does.
        for _ in 0..256 {
            let received = match self.ipc.receive() {
                Ok(Some(message)) => Ok(message),
                Err(IpcError::Message(error)) => Err(error.to_string()),
                Ok(None) | Err(_) => break,
            };
            if self.anew.swap(false, Ordering::Relaxed) {
                *valve = Valve::new(Instant::now());
            }
            if let Some(message) = valve.take(Instant::now(), received) {
                tell(message);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::messages::Setpoint;
    use vizflyt_protocol::time::HostTime;

    fn answer(seq: u64) -> FromPlugin {
        let (entered, returned) = (HostTime::ZERO, HostTime::ZERO);
        FromPlugin::Answer { seq, entered, returned, setpoint: Some(Setpoint::Hold) }
    }

    /// Returns how many of a second's answers at `hz` pass, and the failure.
    fn second(hz: u32) -> (usize, Option<String>) {
        let start = Instant::now();
        let mut valve = Valve::new(start);
        let (mut passed, mut failure) = (0, None);
        for n in 0..hz {
            let now = start + Duration::from_secs(1) * n / hz;
            match valve.take(now, Ok(answer(n.into()))) {
                Some(FromPlugin::Failed { reason }) => {
                    assert!(failure.replace(reason.as_str().to_owned()).is_none(), "said once");
                }
                Some(_) => passed += 1,
                None => {}
            }
        }
        (passed, failure)
    }

    #[test]
    fn answers_to_images_pass_and_floods_do_not() {
        assert_eq!(second(60), (60, None));
        assert_eq!(second(390), (390, None));
        let (passed, failure) = second(10_000);
        assert_eq!(passed, 100);
        assert!(failure.unwrap().contains("more than 400 setpoints a second"));
    }

    #[test]
    fn what_is_no_message_is_a_failure_told_once() {
        let now = Instant::now();
        let mut valve = Valve::new(now);
        let Some(FromPlugin::Failed { reason }) = valve.take(now, Err("cut short".into())) else {
            panic!("nothing is told")
        };
        assert!(reason.contains("no setpoint (cut short)"), "{reason}");
        assert_eq!(valve.take(now, Err("cut short".into())), None);
        assert_eq!(valve.take(now, Ok(answer(1))), None);
    }
}
