//! Selects the images of a reduced log by a token bucket of bytes.
//!
//! Each write takes from the bucket, and time refills it. An image is written completely if the level is
//! not negative. Kept images are therefore evenly spaced and bit-exact, and all other records are kept.

use vizflyt_protocol::time::HostTime;

/// Refill rate: 57 MB a minute, so that each minute stays within 60 MB including a full bucket and the
/// last image. [bytes/s]
const BYTES_PER_S: f64 = 0.95e6;
/// Capacity and initial level of the bucket, so that the log has the first images of a plugin that fails
/// at once. [bytes]
const MAX_SAVED: f64 = BYTES_PER_S;
/// Overhead of MCAP per message: head of the record (31 bytes) and entry in the chunk's index (16)
/// (MCAP specification, "Message", "Message Index"). [bytes]
const OVERHEAD: usize = 47;

/// Token bucket of bytes that a log may still write.
#[derive(Debug)]
pub(super) struct Budget {
    /// Level; negative if overdrawn. [bytes]
    left: f64,
    earned_until: Option<HostTime>,
}

impl Default for Budget {
    fn default() -> Self {
        Self { left: MAX_SAVED, earned_until: None }
    }
}

impl Budget {
    /// Takes a written message of length `len` from the bucket.
    pub(super) fn spend(&mut self, len: usize) {
        self.left -= (len + OVERHEAD) as f64;
    }

    /// Returns whether to write an image that arrived at `at`.
    pub(super) fn allows_image(&mut self, at: HostTime) -> bool {
        let since_s = self.earned_until.map_or(0.0, |until| at.seconds_since(until)).max(0.0);
        self.earned_until = self.earned_until.max(Some(at));
        self.left = (self.left + since_s * BYTES_PER_S).min(MAX_SAVED);
        self.left >= 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Simulates `seconds` at 60 Hz with images of `image` bytes and `rest` other bytes each. Returns the
    /// ticks of the written images and the total size.
    fn fly(seconds: u64, image: usize, rest: usize) -> (Vec<u64>, usize) {
        let mut budget = Budget::default();
        let (mut kept, mut bytes) = (Vec::new(), 0);
        for tick in 0..seconds * 60 {
            budget.spend(rest);
            bytes += rest + OVERHEAD;
            if budget.allows_image(HostTime::from_ns(tick * 1_000_000_000 / 60)) {
                budget.spend(image);
                bytes += image + OVERHEAD;
                kept.push(tick);
            }
        }
        (kept, bytes)
    }

    #[test]
    fn keeps_images_evenly_and_within_60_mb_a_minute() {
        let (kept, bytes) = fly(60, 79_000, 6_000);
        assert!(bytes < 60_000_000, "{bytes}");
        assert!((400..600).contains(&kept.len()), "{}", kept.len());
        assert_eq!(kept[..10], [0, 1, 2, 3, 4, 5, 6, 7, 8, 9], "initial level");
        let gaps: Vec<u64> = kept[20..].windows(2).map(|pair| pair[1] - pair[0]).collect();
        let (least, most) = (gaps.iter().min().unwrap(), gaps.iter().max().unwrap());
        assert!(most - least <= 1, "{least} to {most} ticks apart");
    }

    #[test]
    fn keeps_all_small_images() {
        assert_eq!(fly(10, 8_000, 4_000).0.len(), 600);
    }

    #[test]
    fn saves_at_most_one_second_and_ignores_backward_clock_jumps() {
        let mut budget = Budget::default();
        assert!(budget.allows_image(HostTime::from_ns(1_000_000_000)));
        assert!(budget.allows_image(HostTime::from_ns(60_000_000_000)));
        budget.spend(MAX_SAVED as usize);
        assert!(!budget.allows_image(HostTime::from_ns(5)));
        assert!(!budget.allows_image(HostTime::from_ns(60_000_000_000)), "nothing is earned twice");
        assert!(budget.allows_image(HostTime::from_ns(60_001_000_000)));
    }

    proptest! {
        /// For any size of images, a minute is within 60 MB and one image.
        #[test]
        fn keeps_any_image_size_within_60_mb_a_minute(image in 0_usize..4_000_000, rest in 0_usize..10_000) {
            let (kept, bytes) = fly(60, image, rest);
            prop_assert!(bytes <= 60_000_000 + image, "{}", bytes);
            prop_assert!(!kept.is_empty());
        }
    }
}
