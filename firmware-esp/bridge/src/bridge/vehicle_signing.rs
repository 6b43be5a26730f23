//! Signs the bridge's own packets with the vehicle's key, if the autopilot accepts only signed packets.
//!
//! A chip has no calendar, and a time stamp must be at most a minute old. The bridge therefore takes the time from
//! signed packets of autopilot and companion: it verifies at most one every [`LOOK_S`] and counts on from the newest
//! stamp. Without signed packets, it does not sign.

use vizflyt_protocol::mavlink::{MAX_PACKET, SIGNATURE, Signer, SigningKey, SigningTime};
use vizflyt_protocol::time::HostTime;

use crate::access::is_signed_by;
use crate::packet::Raw;
use crate::settings::Key;

/// Link ID that distinguishes the bridge's signatures from senders with the same IDs on other links.
const LINK: u8 = 240;
/// Interval of verifications [s]: one takes a chip a third of a millisecond, too long for every packet.
const LOOK_S: f64 = 0.1;

/// Signer, and the time that it derives from received packets.
#[derive(Clone, Debug)]
pub(super) struct VehicleSigning {
    signer: Option<Signer>,
    /// Newest received time stamp, and when it was received.
    heard: Option<(HostTime, SigningTime)>,
    look_at: HostTime,
    /// Whether the autopilot's packets are signed.
    is_required: bool,
}

impl VehicleSigning {
    /// Returns an instance without a key; `const`, for a chip's static memory.
    pub(super) const fn new() -> Self {
        Self { signer: None, heard: None, look_at: HostTime::ZERO, is_required: false }
    }

    /// Sets the vehicle's key.
    pub(super) fn set_key(&mut self, key: Option<&Key>) {
        self.signer = key.map(|key| Signer::new(SigningKey::new(*key), LINK));
    }

    /// Whether the autopilot signs its packets, and so accepts only signed ones.
    pub(super) fn is_required(&self) -> bool {
        self.is_required
    }

    /// Records whether the autopilot's heartbeat is signed.
    pub(super) fn note_heartbeat(&mut self, packet: Raw<'_>) {
        self.is_required = packet.is_signed();
    }

    /// Records the time stamp of a packet from either side.
    pub(super) fn note(&mut self, now: HostTime, packet: Raw<'_>, key: Option<&Key>) {
        let Some(key) = key else { return };
        if now < self.look_at || !packet.is_signed() {
            return;
        }
        self.look_at = now.plus_seconds(LOOK_S);
        if !is_signed_by(key, packet) {
            return;
        }
        let stamp = SigningTime::from_units(packet.signed_at());
        if self.time(now).is_none_or(|known| stamp > known) {
            self.heard = Some((now, stamp));
        }
    }

    /// Signs the packet in the first `len` bytes if necessary and possible. Returns its length.
    pub(super) fn sign(&mut self, now: HostTime, out: &mut [u8; MAX_PACKET], len: usize) -> usize {
        match (self.time(now), &mut self.signer) {
            (Some(time), Some(signer)) if self.is_required => signer.sign(time, out, len),
            _ => len,
        }
    }

    /// Returns the number of bytes that [`Self::sign`] adds.
    pub(super) fn added_bytes(&self, now: HostTime) -> usize {
        let signs = self.is_required && self.signer.is_some() && self.time(now).is_some();
        if signs { SIGNATURE } else { 0 }
    }

    fn time(&self, now: HostTime) -> Option<SigningTime> {
        self.heard.map(|(at, stamp)| stamp.plus_us((now.seconds_since(at) * 1e6) as u64))
    }
}
