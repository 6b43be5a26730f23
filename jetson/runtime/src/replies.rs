//! Passes the plugin's messages from its socket to the control loop, with a rate limit. A correct plugin sends
//! one reply for each image, and optionally one odometry estimate.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;
use vizflyt_process::lock;

use vizflyt_protocol::messages::{FromPlugin, bounded};
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::host_now;
use vizflyt_sdk::ipc::{IpcError, RuntimeEnd};

/// Maximum rate of messages: twice 200 images a second, which no camera exceeds, and a fifth of the rate that
/// would saturate the control loop. [1/s]
const MAX_PER_SECOND: u32 = 400;
/// Window in which messages are counted. [ms]
const WINDOW_MS: u32 = 250;

/// Limits the rate of messages. Reports a failure once if there are too many, or if one cannot be decoded.
#[derive(Debug)]
pub struct RateLimiter {
    window_start: HostTime,
    count: u32,
    /// Number of odometry estimates in the window; further ones are dropped without a failure.
    odometry: u32,
    /// Whether a failure was reported; all further messages of the process are dropped.
    has_failed: bool,
}

impl RateLimiter {
    /// Makes a limiter for a process that starts at `now`.
    pub fn new(now: HostTime) -> Self {
        Self { window_start: now, count: 0, odometry: 0, has_failed: false }
    }

    /// Returns the message to pass on: the received one, a failure, or none.
    pub fn take(
        &mut self,
        now: HostTime,
        received: Result<FromPlugin, String>,
    ) -> Option<FromPlugin> {
        if self.has_failed {
            return None;
        }
        if now.seconds_since(self.window_start) * 1e3 >= f64::from(WINDOW_MS) {
            (self.window_start, self.count, self.odometry) = (now, 0, 0);
        }
        let max = MAX_PER_SECOND * WINDOW_MS / 1000;
        if let Ok(FromPlugin::Odometry(_)) = received {
            self.odometry += 1;
            return received.ok().filter(|_| self.odometry <= max);
        }
        self.count += 1;
        let fault = match received {
            Ok(message) if self.count <= max => return Some(message),
            Ok(_) => format!(
                "it sends more than {MAX_PER_SECOND} setpoints a second; send one for each image"
            ),
            Err(why) => format!(
                "it sends an invalid message ({why}); return a Setpoint, and build it against this \
                 version of the SDK"
            ),
        };
        // Only one failure is reported, so that the plugin cannot flood the control loop.
        self.has_failed = true;
        Some(FromPlugin::Failed { reason: bounded(&fault) })
    }
}

/// Replies and other messages of a plugin's consecutive processes.
#[derive(Debug)]
pub(crate) struct PluginReplies {
    ipc: Arc<RuntimeEnd>,
    /// Whether a new process has started, for which the limiter must be reset.
    restarted: AtomicBool,
    limiter: Mutex<RateLimiter>,
}

impl PluginReplies {
    pub(crate) fn new(ipc: Arc<RuntimeEnd>) -> Self {
        Self {
            ipc,
            restarted: AtomicBool::new(false),
            limiter: Mutex::new(RateLimiter::new(host_now())),
        }
    }

    /// Resets the limiter for the next process.
    pub(crate) fn restart(&self) {
        self.restarted.store(true, Ordering::Relaxed);
    }

    /// Reads until `stop`, and passes messages to `handle`.
    pub(crate) fn read(&self, stop: &AtomicBool, handle: impl Fn(FromPlugin)) {
        while !stop.load(Ordering::Relaxed) {
            if self.ipc.wait(Duration::from_millis(100)).is_err() {
                // Waiting fails at once, so poll instead.
                thread::sleep(Duration::from_millis(1));
            }
            self.drain(&handle);
        }
    }

    /// Passes on all received messages. After it returns, all messages sent before the call have been handled,
    /// on this or another thread, so that a plugin's last message is handled before its exit.
    pub(crate) fn drain(&self, handle: impl Fn(FromPlugin)) {
        let mut limiter = lock(&self.limiter);
        // At most one full queue, so that a flood of messages does not delay `stop`.
        for _ in 0..256 {
            let received = match self.ipc.receive() {
                Ok(Some(message)) => Ok(message),
                Err(IpcError::Message(error)) => Err(error.to_string()),
                Ok(None) | Err(_) => break,
            };
            if self.restarted.swap(false, Ordering::Relaxed) {
                *limiter = RateLimiter::new(host_now());
            }
            if let Some(message) = limiter.take(host_now(), received) {
                handle(message);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::messages::{Odometry, Setpoint};

    fn reply(seq: u64) -> FromPlugin {
        let (entered, returned) = (HostTime::ZERO, HostTime::ZERO);
        FromPlugin::Reply { seq, entered, returned, setpoint: Some(Setpoint::Hold) }
    }

    /// Sends replies at `hz` for a second; returns the number that passed, and the failure.
    fn second(hz: u32) -> (usize, Option<String>) {
        let start = host_now();
        let mut limiter = RateLimiter::new(start);
        let (mut passed, mut failure) = (0, None);
        for n in 0..hz {
            let now = start.plus_seconds(f64::from(n) / f64::from(hz));
            match limiter.take(now, Ok(reply(n.into()))) {
                Some(FromPlugin::Failed { reason }) => {
                    assert!(failure.replace(reason.as_str().to_owned()).is_none(), "reported once");
                }
                Some(_) => passed += 1,
                None => {}
            }
        }
        (passed, failure)
    }

    #[test]
    fn limits_the_rate_of_replies() {
        assert_eq!(second(60), (60, None));
        assert_eq!(second(390), (390, None));
        let (passed, failure) = second(10_000);
        assert_eq!(passed, 100);
        assert!(failure.unwrap().contains("more than 400 setpoints a second"));
    }

    #[test]
    fn drops_estimates_beyond_the_limit_and_keeps_replies() {
        let now = host_now();
        let mut limiter = RateLimiter::new(now);
        let estimate = Odometry { stamp: HostTime::ZERO, odom_from_body: Pose::IDENTITY };
        let taken = (0..5000)
            .filter(|_| limiter.take(now, Ok(FromPlugin::Odometry(estimate))).is_some())
            .count();
        assert_eq!(taken, 100);
        assert_eq!(limiter.take(now, Ok(reply(1))), Some(reply(1)));
    }

    #[test]
    fn reports_an_undecodable_message_once() {
        let now = host_now();
        let mut limiter = RateLimiter::new(now);
        let Some(FromPlugin::Failed { reason }) = limiter.take(now, Err("cut short".into())) else {
            panic!("nothing is reported")
        };
        assert!(reason.contains("an invalid message (cut short)"), "{reason}");
        assert_eq!(limiter.take(now, Err("cut short".into())), None);
        assert_eq!(limiter.take(now, Ok(reply(1))), None);
    }
}
