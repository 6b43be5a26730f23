//! Partner on a UDP port that waits for an autopilot: the address to reply to. Sans-IO: input is datagrams and `now`.
//!
//! The partner is the first sender of a valid heartbeat of the wanted autopilot; with signing, of a signed heartbeat.
//! Before that, all datagrams are ignored. If the partner sends no heartbeat for 3 s, the next sender of one replaces
//! it, because a restarted bridge sends from a new port. Every other sender is an intruder: counted, reported at
//! growing intervals, and ignored.

use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use vizflyt_protocol::mavlink::dialect::{HEARTBEAT_DATA, MavMessage};
use vizflyt_protocol::mavlink::{
    HeartbeatSender, MavHeader, SigningFault, SigningKey, SigningTime, StreamDecoder, Verifier,
    heartbeat_sender, heartbeat_sender_name,
};

/// Signing parameters for one run of the link.
#[derive(Clone, Debug)]
pub struct LinkSigning {
    /// Secret key.
    pub key: SigningKey,
    /// Signing time at which the link was created.
    pub start: SigningTime,
    /// Whether unsigned packets are accepted, too. Only for the transfer of a key, because USB is not signed.
    pub accepts_unsigned: bool,
}

/// Autopilot to connect to.
#[derive(Clone, Debug, Default)]
pub struct Wanted {
    /// System id; `None` accepts any.
    pub system: Option<u8>,
    /// Signing of its heartbeats, if required.
    pub signing: Option<LinkSigning>,
}

/// Reason why a datagram is ignored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IntruderFault {
    /// Not MAVLink, or not from an autopilot.
    #[error("they contain no heartbeat of an autopilot")]
    NoHeartbeat,
    /// Heartbeat of a vehicle that is no multirotor.
    #[error("they are from {name} (system {system}), not from a multirotor")]
    NoMultirotor {
        /// System id in the heartbeat.
        system: u8,
        /// Name of the vehicle type, with its article.
        name: &'static str,
    },
    /// Heartbeat of another vehicle.
    #[error("they contain heartbeats of system {found}, expected {wanted}")]
    OtherSystem {
        /// System id in the heartbeat.
        found: u8,
        /// Wanted system id.
        wanted: u8,
    },
    /// Signature missing or invalid, while signing is on.
    #[error("{0}")]
    NotSigned(SigningFault),
    /// Heartbeat of a second sender, while there is a partner.
    #[error("the autopilot is at {0}")]
    Second(SocketAddr),
    /// Heartbeat of a second autopilot, while there is a partner.
    #[error(
        "they are from a second autopilot, system {found}; the first, system {system}, is at {partner}; select one \
         with `system` of [vehicle] in jetson.toml"
    )]
    SecondAutopilot {
        /// System id of the second autopilot.
        found: u8,
        /// System id of the partner.
        system: u8,
        /// Address of the partner.
        partner: SocketAddr,
    },
}

/// Sender whose datagrams are ignored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Intruder {
    /// Address of the sender; `None` for all senders beyond the table's capacity.
    pub address: Option<IpAddr>,
    /// Number of datagrams up to this report.
    pub datagrams: u64,
    /// Reason for the newest one.
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

/// Address to reply to: a fixed one, or that of the wanted autopilot.
#[derive(Debug)]
pub(super) struct Partner {
    fixed: bool,
    wanted: Wanted,
    verifier: Option<Verifier>,
    made_at: Instant,
    current: Option<(SocketAddr, Instant)>,
    /// System id of the partner.
    system: u8,
    /// Number of changes of the address.
    changes: u32,
    /// Decoders per sender, newest last. A sender may cut packets anywhere, as a bridge of a serial line does.
    streams: Vec<Stream>,
    intruders: Vec<Remembered>,
}

/// Decoder for the bytes of one sender.
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
    /// Number of datagrams in the last report.
    reported: u64,
    /// Earliest time of the next report.
    due_at: Instant,
    /// Pause after the next report.
    pause: Duration,
}

impl Partner {
    /// Returns a partner that is found by heartbeats of the wanted autopilot.
    pub(super) fn waited_for(wanted: Wanted, now: Instant) -> Self {
        let signing = wanted.signing.as_ref().filter(|signing| !signing.accepts_unsigned);
        let verifier = signing.map(|signing| Verifier::new(signing.key.clone()));
        Self {
            fixed: false,
            wanted,
            verifier,
            made_at: now,
            current: None,
            system: 0,
            changes: 0,
            streams: Vec::new(),
            intruders: Vec::new(),
        }
    }

    /// As [`Self::waited_for`], for a partner that another process has found since `made_at`.
    pub(super) fn known(found: Option<SocketAddr>, wanted: Wanted, made_at: Instant) -> Self {
        let current = found.map(|address| (address, Instant::now()));
        Self { current, ..Self::waited_for(wanted, made_at) }
    }

    /// Returns a partner with a fixed address; other senders are ignored.
    pub(super) fn fixed(to: SocketAddr, now: Instant) -> Self {
        Self { fixed: true, current: Some((to, now)), ..Self::waited_for(Wanted::default(), now) }
    }

    /// Records a datagram. Returns whether it is the partner's.
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
            (Some((partner, _)), Ok(system)) if partner == from => {
                (self.current, self.system) = (Some((from, now)), system);
                true
            }
            // Other packets of the partner. Only heartbeats keep its place.
            (Some((partner, _)), Err(_)) if partner == from => true,
            (Some((partner, at)), Ok(found)) if now.duration_since(at) < PARTNER_KEPT => {
                let system = self.system;
                let fault = if found == system {
                    IntruderFault::Second(partner)
                } else {
                    IntruderFault::SecondAutopilot { found, system, partner }
                };
                self.note(from, fault, now);
                false
            }
            (_, Ok(system)) => {
                (self.current, self.system) = (Some((from, now)), system);
                self.changes = self.changes.wrapping_add(1);
                true
            }
            // Not the partner, so nothing is sent to it, but the link reports what it is.
            (None, Err(IntruderFault::NoMultirotor { .. })) => true,
            (_, Err(fault)) => {
                self.note(from, fault, now);
                false
            }
        }
    }

    /// Returns the address to send to.
    pub(super) fn address(&self) -> Option<SocketAddr> {
        self.current.map(|(address, _)| address)
    }

    /// Returns the number of changes of the address.
    pub(super) fn changes(&self) -> u32 {
        self.changes
    }

    /// Returns an intruder that is due to be reported at `now`: the first datagram at once, later ones at growing
    /// intervals.
    pub(super) fn poll_intruder(&mut self, now: Instant) -> Option<Intruder> {
        let is_due =
            |one: &&mut Remembered| one.intruder.datagrams > one.reported && now >= one.due_at;
        let due = self.intruders.iter_mut().find(is_due)?;
        due.reported = due.intruder.datagrams;
        due.due_at = now + due.pause;
        due.pause = (due.pause * 2).min(LONGEST_PAUSE);
        Some(due.intruder)
    }

    /// Returns the system id of the wanted autopilot if one of its heartbeats ends in these bytes.
    fn heartbeat(
        &mut self,
        from: SocketAddr,
        bytes: &[u8],
        now: Instant,
    ) -> Result<u8, IntruderFault> {
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
            let sender = sender_of(packet.header, heartbeat);
            if found.is_ok() || sender == HeartbeatSender::Device {
                return;
            }
            // As in the link: system ids above 255 are invalid.
            let system = u8::try_from(packet.header.system_id).unwrap_or_default();
            if let Some(wanted) = wanted.system
                && wanted != system
            {
                found = Err(IntruderFault::OtherSystem { found: system, wanted });
                return;
            }
            let verdict = match (&wanted.signing, verifier.as_mut()) {
                (Some(signing), Some(verifier)) => {
                    verifier.check(signing.start.plus_us(elapsed_us), bytes)
                }
                _ => Ok(()),
            };
            found = match (verdict, sender) {
                (Err(fault), _) => Err(IntruderFault::NotSigned(fault)),
                (Ok(()), HeartbeatSender::Multirotor { .. }) => Ok(system),
                (Ok(()), _) => {
                    let component = packet.header.component_id;
                    let name = heartbeat_sender_name(component, heartbeat.mavtype);
                    Err(IntruderFault::NoMultirotor { system, name })
                }
            };
        });
        // Evict the sender that has been silent longest, but never the partner.
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

/// Returns the sender of a heartbeat.
pub(crate) fn sender_of(header: MavHeader, heartbeat: &HEARTBEAT_DATA) -> HeartbeatSender {
    heartbeat_sender(header.component_id, heartbeat.mavtype as u8, heartbeat.autopilot as u8)
}

/// Time without a heartbeat after which another sender may replace the partner.
const PARTNER_KEPT: Duration = Duration::from_secs(3);
/// Maximum number of senders with a decoder.
const STREAMS: usize = 8;
/// Maximum number of addresses reported separately; further senders are counted together.
const INTRUDERS: usize = 8;
/// Pause between the first and second report. Each further pause is twice as long.
const FIRST_PAUSE: Duration = Duration::from_secs(10);
const LONGEST_PAUSE: Duration = Duration::from_hours(1);

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;
    use vizflyt_protocol::mavlink::dialect::{MavAutopilot, MavType, RADIO_STATUS_DATA};
    use vizflyt_protocol::mavlink::{MAX_PACKET, Signer, encode};

    const SECOND: Duration = Duration::from_secs(1);

    /// Returns a heartbeat of ArduPilot, signed if there is a signer.
    pub(crate) fn heartbeat(system: u8, signer: Option<(&mut Signer, SigningTime)>) -> Vec<u8> {
        packet(system, &beat(MavType::MAV_TYPE_QUADROTOR), signer)
    }

    fn beat(mavtype: MavType) -> MavMessage {
        let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
        MavMessage::HEARTBEAT(HEARTBEAT_DATA { mavtype, autopilot, ..Default::default() })
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
    fn accepts_the_autopilot_after_other_datagrams() {
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
    fn only_heartbeats_keep_the_partner() {
        let (start, a, b) = (Instant::now(), from(5, 1), from(5, 2));
        let beat = heartbeat(1, None);
        let radio = packet(1, &MavMessage::RADIO_STATUS(RADIO_STATUS_DATA::default()), None);
        let mut partner = Partner::waited_for(Wanted::default(), start);
        assert!(!partner.accept(a, &radio, start), "no heartbeat yet");
        assert!(partner.accept(a, &beat, start) && partner.accept(a, &radio, start + SECOND));
        assert!(
            !partner.accept(b, &beat, start + 2 * SECOND),
            "the first partner sends heartbeats"
        );
        assert!(partner.accept(a, &radio, start + 3 * SECOND), "other packets of the partner");
        assert!(!partner.accept(b, &radio, start + 4 * SECOND) && partner.address() == Some(a));
        assert!(partner.accept(b, &beat, start + 4 * SECOND) && partner.address() == Some(b));
        let mut fixed = Partner::fixed(a, start);
        assert!(!fixed.accept(b, &beat, start + 9 * SECOND) && fixed.address() == Some(a));
        assert!(fixed.accept(a, b"x", start));
    }

    #[test]
    fn ignores_other_systems_and_ground_stations() {
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
    fn a_rover_is_reported_but_gets_no_reply() {
        let (start, rover, copter) = (Instant::now(), from(1, 1), from(2, 1));
        let beat = packet(7, &beat(MavType::MAV_TYPE_GROUND_ROVER), None);
        let mut partner = Partner::waited_for(Wanted::default(), start);
        assert!(partner.accept(rover, &beat, start), "the link reports it");
        assert_eq!(partner.address(), None);
        assert!(partner.accept(copter, &heartbeat(1, None), start));
        assert!(!partner.accept(rover, &beat, start));
        assert_eq!(partner.address(), Some(copter));
        let named = partner.poll_intruder(start).unwrap().to_string();
        assert!(named.contains("a rover (system 7), not from a multirotor"), "{named}");
        assert!(!partner.accept(from(3, 1), &heartbeat(2, None), start));
        let named = partner.poll_intruder(start).unwrap().to_string();
        assert!(named.contains("a second autopilot, system 2; the first, system 1"), "{named}");
    }

    #[test]
    fn rejects_unsigned_forged_and_replayed_heartbeats() {
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
        assert!(!partner.accept(from(3, 1), &good, later), "replayed heartbeat");
        assert_eq!(partner.address(), Some(from(2, 1)));
    }

    #[test]
    fn accepts_a_heartbeat_in_parts() {
        let (now, bytes) = (Instant::now(), heartbeat(1, None));
        let mut partner = Partner::waited_for(Wanted::default(), now);
        for byte in &bytes[..bytes.len() - 1] {
            assert!(!partner.accept(from(1, 1), &[*byte], now));
        }
        assert!(partner.accept(from(1, 1), &bytes[bytes.len() - 1..], now));
    }

    #[test]
    fn reports_intruders_at_growing_intervals_and_bounds_their_number() {
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
        /// Bytes without a heartbeat never select a partner, for any datagram boundaries and senders.
        #[test]
        fn noise_does_not_select_a_partner(datagrams in prop::collection::vec((0u8..20, prop::collection::vec(any::<u8>(), 0..300)), 0..50)) {
            let start = Instant::now();
            let mut partner = Partner::waited_for(Wanted::default(), start);
            for (last, bytes) in &datagrams {
                prop_assert!(!partner.accept(from(*last, 1), bytes, start));
            }
            prop_assert_eq!(partner.address(), None);
            prop_assert!(partner.accept(from(100, 1), &heartbeat(1, None), start));
        }

        /// Datagrams of other senders never replace the partner.
        #[test]
        fn noise_does_not_replace_the_partner(datagrams in prop::collection::vec((0u8..20, prop::collection::vec(any::<u8>(), 0..300)), 0..50)) {
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
