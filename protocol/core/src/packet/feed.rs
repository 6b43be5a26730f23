//! Pose feed: the vehicle's poses as authenticated datagrams, from the server to the guardian on the vehicle's
//! computer. It outlives the runtime's QUIC connection, from whose keys both ends derive the feed's key
//! ([`FEED_LABEL`]).
//!
//! ```text
//! guardian ── Subscribe, twice a second ──▶ server
//!          ◀── Pose, at most 50 a second ──
//! ```
//! Each datagram is a postcard body and the first 16 bytes of its HMAC-SHA256. Each body has a counter or a stamp; a
//! datagram that is not newer than the newest is a replay.

use hmac::{Hmac, Mac};
use serde::{Deserialize, Serialize};
use sha2::Sha256;

use crate::messages::PoseSample;

/// Label for exporting the feed's key from the TLS connection of a flight, at both ends (RFC 8446, 7.5).
pub const FEED_LABEL: &[u8] = b"EXPERIMENTAL vizflyt pose feed";
/// Maximum datagram size. [bytes]
pub const MAX_FEED: usize = 256;
/// Number of bytes of the authentication tag.
const SEAL: usize = 16;

/// Secret key of one flight's feed.
pub type FeedKey = [u8; 32];

/// Datagram of the feed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum FeedMessage {
    /// Request for poses, valid for 2 s. The number increases with each request.
    Subscribe(u64),
    /// Newest pose.
    Pose(PoseSample),
}

/// Writes an authenticated datagram into `buffer`. Returns its bytes.
///
/// # Panics
/// Never: the largest message is smaller than [`MAX_FEED`] (tested).
pub fn seal<'a>(key: &FeedKey, message: &FeedMessage, buffer: &'a mut [u8; MAX_FEED]) -> &'a [u8] {
    let body = postcard::to_slice(message, &mut buffer[..MAX_FEED - SEAL])
        .expect("feed messages are bounded below MAX_FEED")
        .len();
    let seal = mac(key, &buffer[..body]).finalize().into_bytes();
    buffer[body..body + SEAL].copy_from_slice(&seal[..SEAL]);
    &buffer[..body + SEAL]
}

/// Returns the message of a datagram; `None` if its tag does not match `key` or it is invalid.
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
    fn opens_only_with_the_same_key() {
        let mut buffer = [0; MAX_FEED];
        for message in [widest(), FeedMessage::Subscribe(u64::MAX)] {
            let bytes = seal(&[7; 32], &message, &mut buffer);
            assert_eq!(open(&[7; 32], bytes), Some(message));
            assert_eq!(open(&[8; 32], bytes), None);
        }
    }

    proptest! {
        #[test]
        fn detects_any_change(at in 0..200usize, flip in 1..=255u8, cut in 0..200usize) {
            let mut buffer = [0; MAX_FEED];
            let len = seal(&[7; 32], &widest(), &mut buffer).len();
            prop_assert_eq!(open(&[7; 32], &buffer[..cut.min(len - 1)]), None);
            buffer[at % len] ^= flip;
            prop_assert_eq!(open(&[7; 32], &buffer[..len]), None);
        }

        #[test]
        fn rejects_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert_eq!(open(&[7; 32], &bytes), None);
        }
    }
}
