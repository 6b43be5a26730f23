//! MAVLink 2 signing like ArduPilot. SETUP_SIGNING sets a key, which is stored over reboots. From then on, all sent
//! packets are signed, and packets without a valid signature are ignored. Exceptions: the first link, which stands for
//! USB, and RADIO_STATUS, because a bridge has no key.

use vizflyt_protocol::mavlink::dialect::{MavMessage, SETUP_SIGNING_DATA};
use vizflyt_protocol::mavlink::{MAX_PACKET, Signer, SigningKey, SigningTime, Verifier};
use vizflyt_protocol::time::AutopilotTime;

/// Link that needs no signatures: ArduPilot trusts its USB port.
pub(super) const USB_LINK: usize = 0;

/// Signs and verifies packets after a key was set.
#[derive(Clone, Debug)]
pub(super) struct Signing {
    key: SigningKey,
    signer: Signer,
    verifier: Verifier,
    given_at: AutopilotTime,
    start: SigningTime,
    refused: u64,
}

impl Signing {
    fn new(now: AutopilotTime, key: SigningKey, start: SigningTime) -> Self {
        Self {
            signer: Signer::new(key.clone(), 0),
            verifier: Verifier::new(key.clone()),
            key,
            given_at: now,
            start,
            refused: 0,
        }
    }

    /// Handles SETUP_SIGNING: sets the key; a key and a time stamp of zeros end signing.
    pub(super) fn set_up(now: AutopilotTime, message: &SETUP_SIGNING_DATA) -> Option<Self> {
        let wanted = message.initial_timestamp != 0 || message.secret_key != [0; 32];
        wanted.then(|| {
            let start = SigningTime::from_units(message.initial_timestamp);
            Self::new(now, SigningKey::new(message.secret_key), start)
        })
    }

    /// Returns the state that is stored over a reboot at `now`. The autopilot has no real-time clock: its time stamps
    /// continue from the last ones.
    pub(super) fn rebooted(&self, now: AutopilotTime) -> Self {
        Self::new(AutopilotTime::ZERO, self.key.clone(), self.time(now))
    }

    /// Signs the packet in `buffer`. Returns its new length.
    pub(super) fn sign(
        &mut self,
        now: AutopilotTime,
        buffer: &mut [u8; MAX_PACKET],
        len: usize,
    ) -> usize {
        let time = self.time(now);
        self.signer.sign(time, buffer, len)
    }

    /// Whether a packet from a link is accepted.
    pub(super) fn accepts(
        &mut self,
        now: AutopilotTime,
        link: usize,
        bytes: &[u8],
        message: &MavMessage,
    ) -> bool {
        if link == USB_LINK || matches!(message, MavMessage::RADIO_STATUS(_)) {
            return true;
        }
        let time = self.time(now);
        let accepted = self.verifier.check(time, bytes).is_ok();
        self.refused += u64::from(!accepted);
        accepted
    }

    /// Returns the number of refused packets.
    pub(super) fn refused(&self) -> u64 {
        self.refused
    }

    fn time(&self, now: AutopilotTime) -> SigningTime {
        self.start.plus_us((now.seconds_since(self.given_at).max(0.0) * 1e6) as u64)
    }
}
