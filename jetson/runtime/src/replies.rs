//! The plugin's messages, from shared memory to the control loop, rate-limited: a plugin that replies to
//! images has no more to send but, with each reply, its own estimate of where it is.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;
use vizflyt_process::lock;

use vizflyt_protocol::messages::{FromPlugin, bounded};
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::host_now;
use vizflyt_sdk::ipc::{IpcError, RuntimeEnd};

/// Maximum messages per second: twice 200 images a second, more than any camera here gives, and a
/// fifth of what would keep the control loop busy.
const MAX_PER_SECOND: u32 = 400;
/// The window in which they are counted. [ms]
const WINDOW_MS: u32 = 250;

/// Limits the rate of messages; reports once when there are too many, or one cannot be decoded.
#[derive(Debug)]
pub struct RateLimiter {
    window_start: HostTime,
    count: u32,
    /// Of estimates, which are dropped beyond the limit.
    odometry: u32,
    /// A fault was reported; the process's further messages are dropped.
    has_failed: bool,
}

impl RateLimiter {
    /// Makes one for a process that starts at `now`.
    pub fn new(now: HostTime) -> Self {
        Self { window_start: now, count: 0, odometry: 0, has_failed: false }
    }

    /// Returns the message to pass on for what was received.
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
                "it sends more than {MAX_PER_SECOND} setpoints a second; one for each image is taken"
            ),
            Err(why) => format!(
                "what it sends is no setpoint ({why}); return a Setpoint, and build it against this \
                 version of the SDK"
            ),
        };
        // One is enough: a plugin that does this is not flying, and must not flood the control loop.
        self.has_failed = true;
        Some(FromPlugin::Failed { reason: bounded(&fault) })
    }
}

/// Replies and other messages of a plugin, one process after another, through one shared-memory service.
#[derive(Debug)]
pub(crate) struct PluginReplies {
    ipc: Arc<RuntimeEnd>,
    /// Another process begins: the limiter starts afresh.
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

    /// Starts afresh: the next message is another process's.
    pub(crate) fn restart(&self) {
        self.restarted.store(true, Ordering::Relaxed);
    }

    /// Reads until `stop`, and passes messages to `handle`.
    pub(crate) fn read(&self, stop: &AtomicBool, handle: impl Fn(FromPlugin)) {
        while !stop.load(Ordering::Relaxed) {
            if self.ipc.wait(Duration::from_millis(100)).is_err() {
                // No event comes any more; poll instead.
                thread::sleep(Duration::from_millis(1));
            }
            self.drain(&handle);
        }
    }

    /// Passes on what has arrived. When it returns, `handle` has been given all that was sent before the
    /// call, by whichever thread: a plugin's last message is handled before its exit.
    pub(crate) fn drain(&self, handle: impl Fn(FromPlugin)) {
        let mut limiter = lock(&self.limiter);
        // At most a queue full, so that `stop` is seen whatever the plugin does.
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

    /// Returns how many of a second's replies at `hz` pass, and the failure.
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
    fn estimates_beyond_the_limit_are_dropped_and_replies_go_on() {
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
        assert!(reason.contains("no setpoint (cut short)"), "{reason}");
        assert_eq!(limiter.take(now, Err("cut short".into())), None);
        assert_eq!(limiter.take(now, Ok(reply(1))), None);
    }
}
