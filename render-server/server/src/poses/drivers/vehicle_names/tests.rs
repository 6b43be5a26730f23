//! Restarted senders are followed within three poses; old frames between new ones are ignored.

use proptest::prelude::*;
use vizflyt_protocol::time::ServerTime;

use super::{FrameOrder, VehicleNames};
use crate::poses::settings::{Driver, LocalizationConfig};

fn names() -> VehicleNames {
    VehicleNames::new(&LocalizationConfig::new(Driver::Vicon), 0, &["v"])
}

/// Returns the arrival time of a frame.
fn at(index: u32, rate_hz: f64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000).plus_seconds(f64::from(index) / rate_hz)
}

proptest! {
    #[test]
    fn a_restarted_sender_is_followed_within_three_frames(
        before in 5u32..3000, first in 0u32..3, rate_hz in 10.0..300.0f64, silent_s in prop_oneof![Just(0.0), 0.0..3.0f64]
    ) {
        let mut names = names();
        for frame in 0..before {
            prop_assert_eq!(names.is_next(0, 1000 + frame, at(frame, rate_hz)), FrameOrder::Next);
        }
        let orders: Vec<_> = (0..6)
            .map(|frame| names.is_next(0, first + frame, at(before + frame, rate_hz).plus_seconds(silent_s)))
            .collect();
        let taken = orders.iter().position(|order| *order == FrameOrder::Restarted);
        prop_assert!(taken.is_some_and(|taken| taken < 3), "{:?}", orders);
        let taken = taken.unwrap();
        prop_assert!(orders[taken + 1..].iter().all(|order| *order == FrameOrder::Next), "{:?}", orders);
        let warning = names.next_warning().unwrap();
        prop_assert!(warning.contains("the sender of 'v' was restarted"), "{}", warning);
        prop_assert_eq!(names.next_warning(), None);
    }

    /// Reordered frames, up to ten in a row, between new ones.
    #[test]
    fn ignores_reordered_frames(late in prop::collection::vec(0u32..10, 40), rate_hz in 10.0..300.0f64) {
        let (mut names, mut frame) = (names(), 0);
        for (index, late) in late.into_iter().enumerate() {
            let now = at(10 * index as u32, rate_hz * 10.0);
            frame += 11;
            prop_assert_eq!(names.is_next(0, frame, now), FrameOrder::Next);
            for back in (1..=late).rev() {
                prop_assert_eq!(names.is_next(0, frame - back, now.plus_ns(100_000)), FrameOrder::Old);
            }
        }
        prop_assert_eq!(names.next_warning(), None);
    }

    /// A recording that is replayed next to its live source, up to three times as fast, is never accepted.
    #[test]
    fn ignores_a_replay_next_to_the_live_source(frames in 20u32..400, rate_hz in 10.0..300.0f64, faster in 1u32..4) {
        let mut names = names();
        for frame in 0..frames {
            let now = at(frame, rate_hz);
            prop_assert_eq!(names.is_next(0, 50_000 + frame, now), FrameOrder::Next);
            for replayed in 0..faster {
                let later = now.plus_seconds(f64::from(replayed + 1) * 0.2 / rate_hz);
                prop_assert_eq!(names.is_next(0, frame * faster + replayed, later), FrameOrder::Old);
            }
        }
        prop_assert_eq!(names.next_warning(), None);
    }
}
