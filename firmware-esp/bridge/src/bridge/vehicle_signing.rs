//! Signs what we send where the autopilot takes signed packets alone, with the vehicle's key.
//!
//! A chip has no calendar, and a stamp must be newer than a minute ago. So the stamps of others are
//! listened to, the autopilot's and the companion's: one a second is verified, and time goes on from
//! the newest. Where nobody signs, nothing is.

use vizflyt_protocol::mavlink::{MAX_PACKET, SIGNATURE, Signer, SigningKey, SigningTime};
use vizflyt_protocol::time::HostTime;

use crate::access::is_signed_by;
use crate::packet::Raw;
use crate::settings::Key;

/// Distinguishes our signatures from those of whoever has our numbers on another link.
const LINK: u8 = 240;
/// Verifying takes a chip a third of a millisecond: not each packet. [s]
const LOOK_S: f64 = 0.1;

/// A signer, and what it knows of the time.
#[derive(Clone, Debug)]
pub(super) struct VehicleSigning {
    signer: Option<Signer>,
    /// The newest stamp heard, and when.
    heard: Option<(HostTime, SigningTime)>,
    look_at: HostTime,
    /// The autopilot's packets are signed.
    is_required: bool,
}

impl VehicleSigning {
    /// One without a key; `const`, for a chip's static memory.
    pub(super) const fn new() -> Self {
        Self { signer: None, heard: None, look_at: HostTime::ZERO, is_required: false }
    }

    /// Takes the key of the settings.
    pub(super) fn set_key(&mut self, key: Option<&Key>) {
        self.signer = key.map(|key| Signer::new(SigningKey::new(*key), LINK));
    }

    /// Whether the autopilot signs, so that it takes only what is signed.
    pub(super) fn is_required(&self) -> bool {
        self.is_required
    }

    /// Takes note of the autopilot's heartbeat.
    pub(super) fn note_heartbeat(&mut self, packet: Raw<'_>) {
        self.is_required = packet.is_signed();
    }

    /// Takes note of a packet of either side, for its stamp.
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

    /// Signs our packet, the first `len` bytes, if that is needed and can be done; returns its length.
    pub(super) fn sign(&mut self, now: HostTime, out: &mut [u8; MAX_PACKET], len: usize) -> usize {
        match (self.time(now), &mut self.signer) {
            (Some(time), Some(signer)) if self.is_required => signer.sign(time, out, len),
            _ => len,
        }
    }

    /// Returns how many bytes longer [`Self::sign`] makes a packet.
    pub(super) fn added_bytes(&self, now: HostTime) -> usize {
        let signs = self.is_required && self.signer.is_some() && self.time(now).is_some();
        if signs { SIGNATURE } else { 0 }
    }

    fn time(&self, now: HostTime) -> Option<SigningTime> {
        self.heard.map(|(at, stamp)| stamp.plus_us((now.seconds_since(at) * 1e6) as u64))
    }
}
