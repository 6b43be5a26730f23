//! The pose feed: a vehicle's poses as sealed datagrams, from the server to the guardian on the vehicle's computer.
//! It outlives the QUIC connection of the runtime, of whose keys both ends derive the feed's
//! ([`FEED_LABEL`]).
//!
//! ```text
//! guardian ── Subscribe, twice a second ──▶ server
//!          ◀── Pose, at most 50 a second ──
//! ```
//! Each datagram is a postcard body and the first 16 bytes of its HMAC-SHA256. A body counts or carries a
//! stamp: what is not newer than the newest is a replay.

use hmac::{Hmac, Mac};
use serde::{Deserialize, Serialize};
use sha2::Sha256;

use crate::messages::PoseSample;

/// The label under which both ends of a flight's connection export the feed's key (RFC 8446, 7.5).
pub const FEED_LABEL: &[u8] = b"EXPERIMENTAL vizflyt pose feed";
/// The largest datagram. [bytes]
pub const MAX_FEED: usize = 256;
/// Bytes of a seal.
const SEAL: usize = 16;

/// Secret of one flight's feed.
pub type FeedKey = [u8; 32];

/// A datagram of the feed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum FeedMessage {
    /// The guardian wants poses; the number grows with each. Answered for 2 s.
    Subscribe(u64),
    /// The newest pose.
    Pose(PoseSample),
}

/// Writes a sealed datagram into `buffer`; returns its bytes.
///
/// # Panics
/// Never: the widest message is bounded below [`MAX_FEED`] (tested).
pub fn seal<'a>(key: &FeedKey, message: &FeedMessage, buffer: &'a mut [u8; MAX_FEED]) -> &'a [u8] {
    let body = postcard::to_slice(message, &mut buffer[..MAX_FEED - SEAL])
        .expect("feed messages are bounded below MAX_FEED")
        .len();
    let seal = mac(key, &buffer[..body]).finalize().into_bytes();
    buffer[body..body + SEAL].copy_from_slice(&seal[..SEAL]);
    &buffer[..body + SEAL]
}

/// Returns the message of a datagram; `None` if it was not sealed with `key`, or is none.
pub fn open(key: &FeedKey, datagram: &[u8]) -> Option<FeedMessage> {
    let (body, seal) = datagram.split_at_checked(datagram.len().checked_sub(SEAL)?)?;
    mac(key, body).verify_truncated_left(seal).ok()?;
    postcard::from_bytes(body).ok()
}

fn mac(key: &FeedKey, body: &[u8]) -> Hmac<Sha256> {
    let mut mac = Hmac::<Sha256>::new_from_slice(key).expect("HMAC takes keys of any length");
    mac.update(body);
    mac
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::time::ServerTime;
    use glam::{DQuat, DVec3, Vec3};
    use proptest::prelude::*;

    fn widest() -> FeedMessage {
        let mut sample = PoseSample::still(
            ServerTime::from_ns(u64::MAX),
            Pose::new(DVec3::MAX, DQuat::from_xyzw(f64::MAX, 1e9, -1.0, 1.0)),
        );
        sample.resets = u8::MAX;
        sample.position_sigma_m = Vec3::MAX;
        FeedMessage::Pose(sample)
    }

    #[test]
    fn what_is_sealed_opens_with_its_key_alone() {
        let mut buffer = [0; MAX_FEED];
        for message in [widest(), FeedMessage::Subscribe(u64::MAX)] {
            let bytes = seal(&[7; 32], &message, &mut buffer);
            assert_eq!(open(&[7; 32], bytes), Some(message));
            assert_eq!(open(&[8; 32], bytes), None);
        }
    }

    proptest! {
        #[test]
        fn any_change_is_noticed(at in 0..200usize, flip in 1..=255u8, cut in 0..200usize) {
            let mut buffer = [0; MAX_FEED];
            let len = seal(&[7; 32], &widest(), &mut buffer).len();
            prop_assert_eq!(open(&[7; 32], &buffer[..cut.min(len - 1)]), None);
            buffer[at % len] ^= flip;
            prop_assert_eq!(open(&[7; 32], &buffer[..len]), None);
        }

        #[test]
        fn noise_opens_nothing(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert_eq!(open(&[7; 32], &bytes), None);
        }
    }
}
