//! Timing of setpoints: at once when the plugin has replied, otherwise at 50 Hz.
//!
//! At a fixed 50 Hz a reply waited up to 20 ms, 10 ms on average: as long as an image takes from pose to plugin.
//! Therefore a reply is sent at once, but at least 5 ms after the setpoint before it, because two images in a burst
//! cause two setpoints. 200 setpoints a second are 13 kB/s, which a serial link of 230 400 baud carries in addition to
//! the poses; the usual 60 images a second cause 4 kB/s. Without replies the guard still sends every 20 ms, as required
//! by its deadlines and ArduCopter's timeout (3 s). The guard uses the measured time between two ticks, so its limits
//! hold at any rate.

use vizflyt_protocol::time::HostTime;

/// Minimum time between two setpoints. [s]
const MIN_PERIOD_S: f64 = 0.005;
/// Maximum time between two setpoints. [s]
const MAX_PERIOD_S: f64 = 0.020;

/// Schedule of setpoints.
#[derive(Clone, Copy, Debug)]
pub struct Steering {
    last: HostTime,
    reply_waits: bool,
}

impl Steering {
    /// Creates a schedule with the first setpoint due at `now`.
    pub fn new(now: HostTime) -> Self {
        Self { last: now.plus_seconds(-MAX_PERIOD_S), reply_waits: false }
    }

    /// Records that the plugin has replied with a setpoint.
    pub fn replied(&mut self) {
        self.reply_waits = true;
    }

    /// Records an urgent event, such as a decision of the referee: the next setpoint is sent without waiting for the
    /// period.
    pub fn hurry(&mut self) {
        self.reply_waits = true;
    }

    /// Returns when the next setpoint is due.
    pub fn due(&self) -> HostTime {
        self.last.plus_seconds(if self.reply_waits { MIN_PERIOD_S } else { MAX_PERIOD_S })
    }

    /// Records that a setpoint was sent at `now`.
    pub fn done(&mut self, now: HostTime) {
        let due = self.due();
        // The delay of a timer does not add up. Setpoints missed during a stall are not sent later.
        let is_rhythm = !self.reply_waits && now.seconds_since(due) < MIN_PERIOD_S;
        self.last = if is_rhythm { due } else { now };
        self.reply_waits = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Simulates one second in which the plugin replies every `replies_us` and a timer is up to `late_us` late. Returns
    /// the number of setpoints and the longest wait of a reply [ms].
    fn run(replies_us: u64, late_us: u64) -> (u32, f64) {
        let start = HostTime::from_ns(5_000_000_000);
        let mut steering = Steering::new(start);
        let (mut sent, mut longest_ms, mut reply) = (0, 0.0_f64, None);
        for us in 0..1_000_000_u64 {
            let now = start.plus_ns(us as i64 * 1000);
            if replies_us > 0 && us % replies_us == replies_us - 1 {
                steering.replied();
                reply.get_or_insert(now);
            }
            let late_ns = (us % (late_us + 1)) as i64 * 1000;
            if now >= steering.due().plus_ns(late_ns) {
                steering.done(now);
                sent += 1;
                let waited_ms = reply.take().map_or(0.0, |at| now.seconds_since(at) * 1e3);
                longest_ms = longest_ms.max(waited_ms);
            }
        }
        (sent, longest_ms)
    }

    #[test]
    fn sends_at_50_hz_without_replies_even_with_late_timers() {
        assert_eq!(run(0, 0), (50, 0.0));
        assert!(run(0, 3000).0 >= 49);
    }

    #[test]
    fn sends_replies_at_once() {
        // 60 Hz: one setpoint for each reply, and none between them.
        let (sent, longest_ms) = run(16_667, 0);
        assert!((60..=61).contains(&sent) && longest_ms == 0.0, "{sent}, {longest_ms} ms");
        // 30 Hz: one more setpoint between two replies, which does not delay them.
        let (sent, longest_ms) = run(33_333, 0);
        assert!((59..=61).contains(&sent) && longest_ms == 0.0, "{sent}, {longest_ms} ms");
    }

    #[test]
    fn sends_at_most_200_hz() {
        let (sent, longest_ms) = run(1_500, 0);
        assert!((195..=201).contains(&sent) && longest_ms < 5.0, "{sent}, {longest_ms} ms");
    }
}
