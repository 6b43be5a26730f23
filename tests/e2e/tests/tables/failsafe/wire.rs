//! Links on the virtual clock: items arrive in order, after a seeded delay.

use std::collections::VecDeque;

use vizflyt_protocol::random::SplitMix64;
use vizflyt_protocol::time::HostTime;

/// One direction of a link.
#[derive(Clone, Debug)]
pub(crate) struct Wire<T> {
    random: SplitMix64,
    /// Minimum and maximum delay. [us]
    delay_us: (u64, u64),
    on_their_way: VecDeque<(HostTime, T)>,
    /// Arrival of the newest item: items do not overtake each other.
    newest: HostTime,
    /// Drops all items.
    pub(crate) is_cut: bool,
}

impl<T> Wire<T> {
    /// Creates link number `stream` of the links with this seed.
    pub(crate) fn new(seed: u64, stream: u64, delay_us: (u64, u64)) -> Self {
        Self {
            random: SplitMix64::new(seed.wrapping_mul(0xD1B5_4A32_D192_ED03) ^ stream << 32),
            delay_us,
            on_their_way: VecDeque::new(),
            newest: HostTime::ZERO,
            is_cut: false,
        }
    }

    /// Sends an item, which arrives after a delay.
    pub(crate) fn send(&mut self, now: HostTime, item: T) {
        let (least, most) = self.delay_us;
        let delay_us = least + self.random.bits() % (most - least + 1);
        self.send_for(now.plus_ns(1000 * delay_us.cast_signed()), item);
    }

    /// Sends an item, which arrives at `at` or after earlier items.
    pub(crate) fn send_for(&mut self, at: HostTime, item: T) {
        if !self.is_cut {
            self.newest = self.newest.max(at);
            self.on_their_way.push_back((self.newest, item));
        }
    }

    /// Returns the next item that has arrived.
    pub(crate) fn receive(&mut self, now: HostTime) -> Option<T> {
        self.receive_stamped(now).map(|(_, item)| item)
    }

    /// Returns the next item that has arrived, and its arrival time.
    pub(crate) fn receive_stamped(&mut self, now: HostTime) -> Option<(HostTime, T)> {
        self.on_their_way.pop_front_if(|(at, _)| *at <= now)
    }

    /// Returns the arrival time of the next item.
    pub(crate) fn due(&self) -> Option<HostTime> {
        self.on_their_way.front().map(|(at, _)| *at)
    }

    /// Drops all items in transit.
    pub(crate) fn clear(&mut self) {
        self.on_their_way.clear();
    }
}

/// Time of one byte on a serial line of 921600 baud. [ns]
const BYTE_NS: i64 = 10_000_000_000 / 921_600;
/// Backlog above which bytes are dropped: the line's buffer is full. [s]
const BACKLOG_S: f64 = 0.1;

impl Wire<Vec<u8>> {
    /// Sends over a serial line; the time depends on the number of bytes.
    pub(crate) fn send_serially(&mut self, now: HostTime, bytes: &[u8]) {
        let free_at = self.free_at(now);
        if free_at.seconds_since(now) < BACKLOG_S {
            let took_ns = BYTE_NS * i64::try_from(bytes.len()).expect("a packet is short");
            self.send_for(free_at.plus_ns(took_ns), bytes.to_vec());
        }
    }

    /// Returns the time at which a serial line has sent everything.
    pub(crate) fn free_at(&self, now: HostTime) -> HostTime {
        self.newest.max(now)
    }
}
