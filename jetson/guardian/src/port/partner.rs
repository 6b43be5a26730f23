//! Whom to answer on a UDP port that waits for an autopilot: sans-IO, datagrams and `now` in.
//!
//! The partner is the sender of a valid heartbeat of the wanted autopilot; with signing on, of a signed one. Until
//! there is one nobody is listened to. It keeps its place by its heartbeats: 3 s without one, and the next sender of
//! one takes it, as a restarted bridge comes from a new port. Everybody else is an intruder: counted, named at growing
//! intervals, and ignored.

use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use vizflyt_protocol::mavlink::dialect::{MavAutopilot, MavMessage};
use vizflyt_protocol::mavlink::{SigningFault, SigningKey, SigningTime, StreamDecoder, Verifier};

/// Signing for one run of the link.
#[derive(Clone, Debug)]
pub struct LinkSigning {
    /// The secret.
    pub key: SigningKey,
    /// The stamp of the moment at which the link is made.
    pub start: SigningTime,
    /// Accepts unsigned packets too: only where a key is handed over, as USB is not signed.
    pub accepts_unsigned: bool,
}

/// Which autopilot is waited for.
#[derive(Clone, Debug, Default)]
pub struct Wanted {
    /// Its system id; `None` takes any.
    pub system: Option<u8>,
    /// Its heartbeats must be signed with this.
    pub signing: Option<LinkSigning>,
}

/// Why a datagram is ignored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IntruderFault {
    /// It is no MAVLink, or of no autopilot.
    #[error("no heartbeat of an autopilot is in them")]
    NoHeartbeat,
    /// Another vehicle's.
    #[error("their heartbeats are of system {found}, not of {wanted}")]
    OtherSystem {
        /// Whose they are.
        found: u8,
        /// Whose are wanted.
        wanted: u8,
    },
    /// Signing is on.
    #[error("{0}")]
    NotSigned(SigningFault),
    /// There is a partner already.
    #[error("the autopilot is at {0}")]
    Second(SocketAddr),
}

/// Somebody whose datagrams are ignored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Intruder {
    /// Where they come from; `None` stands for all for whom there was no room.
    pub address: Option<IpAddr>,
    /// How many came so far.
    pub datagrams: u64,
    /// What was wrong with the newest.
    pub fault: IntruderFault,
}

impl fmt::Display for Intruder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { datagrams, fault, .. } = self;
        write!(f, "datagrams from ")?;
        match self.address {
            Some(address) => write!(f, "{address}")?,
            None => write!(f, "others")?,
        }
        write!(f, " to the autopilot's port are ignored ({datagrams} so far): {fault}")
    }
}

/// The address to answer: a fixed one, or that of the wanted autopilot.
#[derive(Debug)]
pub(super) struct Partner {
    fixed: bool,
    wanted: Wanted,
    verifier: Option<Verifier>,
    made_at: Instant,
    current: Option<(SocketAddr, Instant)>,
    /// Bytes of senders that may cut packets anywhere, as a bridge of a serial line does; newest last.
    streams: Vec<Stream>,
    intruders: Vec<Remembered>,
}

/// The bytes of one sender.
struct Stream {
    from: SocketAddr,
    decoder: StreamDecoder,
}

impl fmt::Debug for Stream {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Stream").field("from", &self.from).finish_non_exhaustive()
    }
}

#[derive(Clone, Copy, Debug)]
struct Remembered {
    intruder: Intruder,
    /// So many were reported.
    reported: u64,
    /// When others may be.
    due_at: Instant,
    /// From that report to the next.
    pause: Duration,
}

impl Partner {
    /// Whoever is the wanted autopilot.
    pub(super) fn waited_for(wanted: Wanted, now: Instant) -> Self {
        let signing = wanted.signing.as_ref().filter(|signing| !signing.accepts_unsigned);
        let verifier = signing.map(|signing| Verifier::new(signing.key.clone()));
        Self {
            fixed: false,
            wanted,
            verifier,
            made_at: now,
            current: None,
            streams: Vec::new(),
            intruders: Vec::new(),
        }
    }

    /// This one, whoever else sends.
    pub(super) fn fixed(to: SocketAddr, now: Instant) -> Self {
        Self { fixed: true, current: Some((to, now)), ..Self::waited_for(Wanted::default(), now) }
    }

    /// Takes note of a datagram; returns whether it is the partner's.
    pub(super) fn accept(&mut self, from: SocketAddr, bytes: &[u8], now: Instant) -> bool {
        let current = self.current;
        if self.fixed {
            let to = current.map(|(to, _)| to);
            if to == Some(from) {
                return true;
            }
            let fault = to.map_or(IntruderFault::NoHeartbeat, IntruderFault::Second);
            self.note(from, fault, now);
            return false;
        }
        let heartbeat = self.heartbeat(from, bytes, now);
        match (current, heartbeat) {
            (Some((partner, _)), Ok(())) if partner == from => {
                self.current = Some((from, now));
                true
            }
            // Its other packets; it keeps its place only by heartbeats.
            (Some((partner, _)), Err(_)) if partner == from => true,
            (Some((partner, at)), Ok(())) if now.duration_since(at) < PARTNER_KEPT => {
                self.note(from, IntruderFault::Second(partner), now);
                false
            }
            (_, Ok(())) => {
                self.current = Some((from, now));
                true
            }
            (_, Err(fault)) => {
                self.note(from, fault, now);
                false
            }
        }
    }

    /// Returns where to send.
    pub(super) fn address(&self) -> Option<SocketAddr> {
        self.current.map(|(address, _)| address)
    }

    /// Returns an intruder that is to be reported at `now`: each at once, then at growing intervals, and only if
    /// more has come of it.
    pub(super) fn poll_intruder(&mut self, now: Instant) -> Option<Intruder> {
        let is_due =
            |one: &&mut Remembered| one.intruder.datagrams > one.reported && now >= one.due_at;
        let due = self.intruders.iter_mut().find(is_due)?;
        due.reported = due.intruder.datagrams;
        due.due_at = now + due.pause;
        due.pause = (due.pause * 2).min(LONGEST_PAUSE);
        Some(due.intruder)
    }

    /// Whether a heartbeat of the wanted autopilot ends in these bytes.
    fn heartbeat(
        &mut self,
        from: SocketAddr,
        bytes: &[u8],
        now: Instant,
    ) -> Result<(), IntruderFault> {
        let mut found = Err(IntruderFault::NoHeartbeat);
        let (wanted, verifier) = (&self.wanted, &mut self.verifier);
        let elapsed_us = now.duration_since(self.made_at).as_micros() as u64;
        let at = self.streams.iter().position(|stream| stream.from == from);
        let mut stream = match at {
            Some(at) => self.streams.remove(at),
            None => Stream { from, decoder: StreamDecoder::default() },
        };
        stream.decoder.push_whole(bytes, |bytes, packet| {
            let MavMessage::HEARTBEAT(heartbeat) = &packet.message else { return };
            if found.is_ok() || !is_flown(heartbeat.autopilot) {
                return;
            }
            // As the link itself numbers systems: ids beyond a byte are nobody's.
            let system = u8::try_from(packet.header.system_id).unwrap_or_default();
            if let Some(wanted) = wanted.system
                && wanted != system
            {
                found = Err(IntruderFault::OtherSystem { found: system, wanted });
                return;
            }
            found = match (&wanted.signing, verifier.as_mut()) {
                (Some(signing), Some(verifier)) => verifier
                    .check(signing.start.plus_us(elapsed_us), bytes)
                    .map_err(IntruderFault::NotSigned),
                _ => Ok(()),
            };
        });
        // The one that has been silent longest makes room, never the partner.
        if self.streams.len() >= STREAMS {
            let partner = self.address();
            let oldest = self.streams.iter().position(|stream| Some(stream.from) != partner);
            self.streams.remove(oldest.unwrap_or(0));
        }
        self.streams.push(stream);
        found
    }

    fn note(&mut self, from: SocketAddr, fault: IntruderFault, now: Instant) {
        let address = Some(from.ip().to_canonical());
        let is_known = |one: &Remembered| one.intruder.address == address;
        let address = if self.intruders.iter().any(is_known) || self.intruders.len() < INTRUDERS {
            address
        } else {
            None
        };
        let known = self.intruders.iter_mut().find(|one| one.intruder.address == address);
        if let Some(known) = known {
            known.intruder.datagrams = known.intruder.datagrams.saturating_add(1);
            known.intruder.fault = fault;
        } else {
            let intruder = Intruder { address, datagrams: 1, fault };
            let pause = FIRST_PAUSE;
            self.intruders.push(Remembered { intruder, reported: 0, due_at: now, pause });
        }
    }
}

/// Whether it is an autopilot that we fly.
pub(crate) fn is_flown(autopilot: MavAutopilot) -> bool {
    matches!(autopilot, MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA | MavAutopilot::MAV_AUTOPILOT_PX4)
}

/// A partner without a heartbeat for this long may be replaced by another sender of one.
const PARTNER_KEPT: Duration = Duration::from_secs(3);
/// Senders whose packets may come in parts.
const STREAMS: usize = 8;
/// Addresses named; the rest is counted together.
const INTRUDERS: usize = 8;
/// From the first report to the second; each further pause is twice as long.
const FIRST_PAUSE: Duration = Duration::from_secs(10);
const LONGEST_PAUSE: Duration = Duration::from_hours(1);

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;
    use vizflyt_protocol::mavlink::dialect::{HEARTBEAT_DATA, RADIO_STATUS_DATA};
    use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, Signer, encode};

    const SECOND: Duration = Duration::from_secs(1);

    /// Returns a heartbeat of ArduPilot; signed, if there is a signer.
    pub(crate) fn heartbeat(system: u8, signer: Option<(&mut Signer, SigningTime)>) -> Vec<u8> {
        let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
        let message = MavMessage::HEARTBEAT(HEARTBEAT_DATA { autopilot, ..Default::default() });
        packet(system, &message, signer)
    }

    fn packet(
        system: u8,
        message: &MavMessage,
        signer: Option<(&mut Signer, SigningTime)>,
    ) -> Vec<u8> {
        let header = MavHeader { system_id: system.into(), component_id: 1, sequence: 0 };
        let mut bytes = [0; MAX_PACKET];
        let mut len = encode(header, message, &mut bytes).len();
        if let Some((signer, time)) = signer {
            len = signer.sign(time, &mut bytes, len);
        }
        bytes[..len].to_vec()
    }

    fn from(last: u8, port: u16) -> SocketAddr {
        ([192, 168, 1, last], port).into()
    }

    #[test]
    fn a_byte_that_comes_first_keeps_no_autopilot_out() {
        let (start, intruder, autopilot) = (Instant::now(), from(9, 999), from(5, 14550));
        let mut partner = Partner::waited_for(Wanted::default(), start);
        for half_seconds in 0..20 {
            let now = start + SECOND * half_seconds / 2;
            assert!(!partner.accept(intruder, b"x", now));
            assert_eq!(partner.address(), (half_seconds > 4).then_some(autopilot));
            if half_seconds == 4 {
                assert!(partner.accept(autopilot, &heartbeat(1, None), now));
            }
        }
        let named = partner.poll_intruder(start).unwrap().to_string();
        for part in ["192.168.1.9", "20 so far", "no heartbeat of an autopilot"] {
            assert!(named.contains(part), "{named}");
        }
    }

    #[test]
    fn the_partner_keeps_its_place_by_heartbeats_alone() {
        let (start, a, b) = (Instant::now(), from(5, 1), from(5, 2));
        let beat = heartbeat(1, None);
        let radio = packet(1, &MavMessage::RADIO_STATUS(RADIO_STATUS_DATA::default()), None);
        let mut partner = Partner::waited_for(Wanted::default(), start);
        assert!(!partner.accept(a, &radio, start), "no heartbeat yet");
        assert!(partner.accept(a, &beat, start) && partner.accept(a, &radio, start + SECOND));
        assert!(!partner.accept(b, &beat, start + 2 * SECOND), "the first one speaks");
        assert!(partner.accept(a, &radio, start + 3 * SECOND), "other packets of it");
        assert!(!partner.accept(b, &radio, start + 4 * SECOND) && partner.address() == Some(a));
        assert!(partner.accept(b, &beat, start + 4 * SECOND) && partner.address() == Some(b));
        let mut fixed = Partner::fixed(a, start);
        assert!(!fixed.accept(b, &beat, start + 9 * SECOND) && fixed.address() == Some(a));
        assert!(fixed.accept(a, b"x", start));
    }

    #[test]
    fn another_system_and_a_ground_station_are_no_partner() {
        let start = Instant::now();
        let wanted = Wanted { system: Some(3), signing: None };
        let mut partner = Partner::waited_for(wanted, start);
        let station = MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
            ..Default::default()
        });
        assert!(!partner.accept(from(1, 1), &packet(3, &station, None), start));
        assert!(!partner.accept(from(2, 1), &heartbeat(7, None), start));
        let faults: Vec<_> = std::iter::from_fn(|| partner.poll_intruder(start))
            .map(|intruder| intruder.fault)
            .collect();
        let other = IntruderFault::OtherSystem { found: 7, wanted: 3 };
        assert_eq!(faults, [IntruderFault::NoHeartbeat, other]);
        assert!(partner.accept(from(3, 1), &heartbeat(3, None), start));
    }

    #[test]
    fn with_signing_on_only_a_signed_heartbeat_counts_and_only_once() {
        let (now, key) = (Instant::now(), SigningKey::new([7; 32]));
        let time = SigningTime::from_units(1_000_000);
        let signing = LinkSigning { key: key.clone(), start: time, accepts_unsigned: false };
        let mut partner = Partner::waited_for(Wanted { system: None, signing: Some(signing) }, now);
        assert!(!partner.accept(from(1, 1), &heartbeat(1, None), now));
        let named = partner.poll_intruder(now).unwrap().to_string();
        assert!(named.contains("not signed"), "{named}");
        let mut forger = Signer::new(SigningKey::new([8; 32]), 0);
        assert!(!partner.accept(from(1, 1), &heartbeat(1, Some((&mut forger, time))), now));
        let good = heartbeat(1, Some((&mut Signer::new(key, 0), time)));
        assert!(partner.accept(from(2, 1), &good, now));
        let later = now + 4 * SECOND;
        assert!(!partner.accept(from(3, 1), &good, later), "recorded and sent again");
        assert_eq!(partner.address(), Some(from(2, 1)));
    }

    #[test]
    fn a_heartbeat_may_come_in_parts() {
        let (now, bytes) = (Instant::now(), heartbeat(1, None));
        let mut partner = Partner::waited_for(Wanted::default(), now);
        for byte in &bytes[..bytes.len() - 1] {
            assert!(!partner.accept(from(1, 1), &[*byte], now));
        }
        assert!(partner.accept(from(1, 1), &bytes[bytes.len() - 1..], now));
    }

    #[test]
    fn intruders_are_named_at_growing_intervals_and_their_number_is_bounded() {
        let start = Instant::now();
        let mut partner = Partner::waited_for(Wanted::default(), start);
        let mut named = Vec::new();
        for second in 0..200_u32 {
            let now = start + SECOND * second;
            partner.accept(from(9, 1), b"x", now);
            named.extend(partner.poll_intruder(now).map(|intruder| intruder.datagrams));
        }
        assert_eq!(named, [1, 11, 31, 71, 151]);
        for last in 0..=255 {
            partner.accept(from(last, 1), b"x", start);
        }
        assert_eq!(partner.intruders.len(), INTRUDERS + 1);
        let others = partner.intruders.last().unwrap().intruder;
        assert!(others.to_string().starts_with("datagrams from others"), "{others}");
        assert!(partner.streams.len() <= STREAMS);
    }

    proptest! {
        /// Bytes that are no heartbeat make nobody a partner, however they are cut and from how many places.
        #[test]
        fn noise_is_no_partner(datagrams in prop::collection::vec((0u8..20, prop::collection::vec(any::<u8>(), 0..300)), 0..50)) {
            let start = Instant::now();
            let mut partner = Partner::waited_for(Wanted::default(), start);
            for (last, bytes) in &datagrams {
                prop_assert!(!partner.accept(from(*last, 1), bytes, start));
            }
            prop_assert_eq!(partner.address(), None);
            prop_assert!(partner.accept(from(100, 1), &heartbeat(1, None), start));
        }

        /// The partner is not put out by whatever others send.
        #[test]
        fn noise_puts_out_no_partner(datagrams in prop::collection::vec((0u8..20, prop::collection::vec(any::<u8>(), 0..300)), 0..50)) {
            let start = Instant::now();
            let mut partner = Partner::waited_for(Wanted::default(), start);
            prop_assert!(partner.accept(from(100, 1), &heartbeat(1, None), start));
            for (last, bytes) in &datagrams {
                prop_assert!(!partner.accept(from(*last, 1), bytes, start + 9 * SECOND));
            }
            prop_assert_eq!(partner.address(), Some(from(100, 1)));
        }
    }
}
