//! Counters of a bridge. They wrap; readers use differences.

use crate::packet::CutStats;

/// Why a packet was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Reason {
    /// The autopilot's port was overloaded: more data than its baud rate carries.
    UartFull,
    /// A setpoint or pose waited longer than a period, and a newer one of the same sender arrived.
    Superseded,
    /// A client, or its Wi-Fi, was too slow.
    ClientSlow,
    /// No client is connected.
    NoClient,
    /// The maximum number of clients is reached.
    TooManyClients,
    /// Network or port refused it: no route, no link, or a line fault.
    NotSent,
}

/// Names of all reasons, as shown by `vizflyt bridge stats` and the web page.
pub const REASONS: [(Reason, &str); 6] = [
    (Reason::UartFull, "uart_full"),
    (Reason::Superseded, "superseded"),
    (Reason::ClientSlow, "client_slow"),
    (Reason::NoClient, "no_client"),
    (Reason::TooManyClients, "too_many_clients"),
    (Reason::NotSent, "not_sent"),
];

/// Counters of one side.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Side {
    /// Received bytes.
    pub bytes_in: u32,
    /// Sent bytes.
    pub bytes_out: u32,
    /// Sent packets.
    pub packets_out: u32,
    /// Gaps in the senders' sequence numbers: packets lost before they reached the bridge.
    pub lost: u32,
    /// Received packets, and bytes outside of packets.
    pub cut: CutStats,
}

/// All counters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    /// The autopilot's port.
    pub uart: Side,
    /// All clients.
    pub net: Side,
    /// Packets dropped, by [`Reason`].
    pub drops: [u32; REASONS.len()],
    /// Newest round trip to the autopilot, measured by TIMESYNC; 0 before the first [us].
    pub round_trip_us: u32,
    /// Number of LAND requests because of a silent companion.
    pub landings: u32,
    /// Refused changes of the configuration: wrong key, no key, vehicle armed.
    pub refused: u32,
    /// Connections closed because they accepted no data for too long.
    pub stalled: u32,
    /// Overruns of the port's own buffer: bytes lost before the bridge read them.
    pub overruns: u32,
    /// Cause of the chip's last start.
    pub restart_cause: RestartCause,
}

/// Cause of a chip's start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum RestartCause {
    /// Unknown.
    #[default]
    Unknown = 0,
    /// Power on.
    Power = 1,
    /// Requested restart.
    Asked = 2,
    /// Panic of the program.
    Panic = 3,
    /// The program hung, and the watchdog restarted it.
    Watchdog = 4,
    /// Brownout: the supply voltage was too low.
    Brownout = 5,
}

impl RestartCause {
    /// Returns a status text of at most 50 characters for an abnormal cause.
    pub fn message(self) -> Option<&'static str> {
        match self {
            Self::Unknown | Self::Power | Self::Asked => None,
            Self::Panic => Some("bridge: has restarted after a panic"),
            Self::Watchdog => Some("bridge: has restarted, its watchdog found it hung"),
            Self::Brownout => Some("bridge: has restarted, its voltage fell"),
        }
    }
}

impl Side {
    const NONE: Self =
        Self { bytes_in: 0, bytes_out: 0, packets_out: 0, lost: 0, cut: CutStats::NONE };
}

impl Stats {
    /// All zero: the default as a `const`.
    pub(crate) const NONE: Self = Self {
        uart: Side::NONE,
        net: Side::NONE,
        drops: [0; REASONS.len()],
        round_trip_us: 0,
        landings: 0,
        refused: 0,
        stalled: 0,
        overruns: 0,
        restart_cause: RestartCause::Unknown,
    };

    /// Counts packets dropped for `reason`.
    pub(crate) fn drop(&mut self, reason: Reason, packets: u32) {
        let counter = &mut self.drops[reason as usize];
        *counter = counter.wrapping_add(packets);
    }

    /// Returns all counters in the order of [`REPORT`].
    pub fn report(&self, uptime_s: u32) -> [u32; REPORT.len()] {
        let (uart, net) = (&self.uart, &self.net);
        let [full, superseded, slow, nobody, many, not_sent] = self.drops;
        [
            uptime_s,
            uart.bytes_in,
            uart.bytes_out,
            uart.cut.packets,
            uart.packets_out,
            uart.lost,
            uart.cut.bad_checksum,
            uart.cut.dropped_bytes,
            net.bytes_in,
            net.bytes_out,
            net.cut.packets,
            net.packets_out,
            net.lost,
            net.cut.dropped_bytes,
            full,
            superseded,
            slow,
            nobody,
            many,
            not_sent,
            self.round_trip_us,
            self.landings,
            self.stalled,
            self.overruns,
            self.restart_cause as u32,
        ]
    }

    /// Returns the number of packets dropped for `reason`.
    pub fn dropped(&self, reason: Reason) -> u32 {
        self.drops[reason as usize]
    }
}

/// Names of the counters in `vizflyt bridge stats`, on the web page and on the wire.
pub const REPORT: [&str; 25] = [
    "uptime_s",
    "uart_bytes_in",
    "uart_bytes_out",
    "uart_packets_in",
    "uart_packets_out",
    "uart_lost",
    "uart_bad_checksum",
    "uart_dropped_bytes",
    "net_bytes_in",
    "net_bytes_out",
    "net_packets_in",
    "net_packets_out",
    "net_lost",
    "net_dropped_bytes",
    "drop_uart_full",
    "drop_superseded",
    "drop_client_slow",
    "drop_no_client",
    "drop_too_many_clients",
    "drop_not_sent",
    "round_trip_us",
    "landings",
    "stalled_clients",
    "uart_overruns",
    "restart_cause",
];

/// Counts gaps in the sequence numbers of a few senders.
#[derive(Clone, Debug)]
pub(crate) struct Sequences<const N: usize> {
    senders: [Option<Sender>; N],
    oldest: usize,
}

#[derive(Clone, Copy, Debug)]
struct Sender {
    source: (u8, u8),
    last: u8,
}

/// A jump of at least this size counts as a restart or a reordered packet, because a loss of half the counter's range
/// looks the same.
const MAX_LOST: u8 = 128;

impl<const N: usize> Sequences<N> {
    pub(crate) const fn new() -> Self {
        Self { senders: [None; N], oldest: 0 }
    }

    /// Records a packet. Returns the number of packets lost before it.
    pub(crate) fn note(&mut self, source: (u8, u8), sequence: u8) -> u32 {
        let known = self.senders.iter_mut().flatten().find(|sender| sender.source == source);
        if let Some(sender) = known {
            let missing = sequence.wrapping_sub(sender.last).wrapping_sub(1);
            if missing < MAX_LOST {
                sender.last = sequence;
                return missing.into();
            }
            // Reordered: 255 repeats the last number, 254 is the one before. A restart jumps further.
            if missing < 240 {
                sender.last = sequence;
            }
            return 0;
        }
        let sender = Some(Sender { source, last: sequence });
        if let Some(place) = self.senders.iter_mut().find(|place| place.is_none()) {
            *place = sender;
        } else {
            self.senders[self.oldest] = sender;
            self.oldest = (self.oldest + 1) % N;
        }
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(numbers: &[u8], expected: u32) {
        let mut sequences = Sequences::<2>::new();
        let lost: u32 = numbers.iter().map(|&number| sequences.note((1, 1), number)).sum();
        assert_eq!(lost, expected, "{numbers:?}");
    }

    #[test]
    fn counts_gaps_across_the_wrap() {
        check(&[0, 1, 2, 3], 0);
        check(&[7], 0);
        check(&[0, 2], 1);
        check(&[254, 255, 0, 1], 0);
        check(&[254, 1], 2);
        check(&[255, 0], 0);
        // A duplicate and a swap are not losses.
        check(&[5, 5, 6], 0);
        check(&[5, 7, 6, 8], 1);
        // Restarted.
        check(&[100, 0, 1, 2], 0);
    }

    #[test]
    fn counts_senders_separately_and_replaces_the_oldest() {
        let mut sequences = Sequences::<2>::new();
        assert_eq!(sequences.note((1, 1), 0), 0);
        assert_eq!(sequences.note((255, 191), 9), 0);
        assert_eq!(sequences.note((1, 1), 2), 1);
        assert_eq!(sequences.note((3, 3), 0), 0);
        assert_eq!(sequences.note((255, 191), 11), 1);
        assert_eq!(sequences.note((3, 3), 1), 0);
    }

    #[test]
    fn every_reason_has_its_own_counter() {
        let mut stats = Stats::default();
        for (reason, name) in REASONS {
            stats.drop(reason, 1 + reason as u32);
            let place =
                REPORT.iter().position(|counter| counter.strip_prefix("drop_") == Some(name));
            assert_eq!(stats.report(0)[place.unwrap()], 1 + reason as u32, "{name}");
        }
        for (place, (reason, _)) in REASONS.iter().enumerate() {
            assert_eq!(*reason as usize, place);
        }
    }
}
