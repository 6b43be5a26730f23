//! Previews of the last seconds, stored for crash cards.

use std::collections::VecDeque;
use std::sync::Arc;

use vizflyt_protocol::time::ServerTime;

/// Small images for the page.
#[derive(Debug, Default)]
pub struct Preview {
    /// JPEG of the colour image.
    pub colour: Vec<u8>,
    /// JPEG of the depth image, coloured by distance.
    pub depth: Vec<u8>,
    /// JPEG of the object ids, as colours; empty before any object was seen.
    pub ids: Vec<u8>,
    /// Clearance ahead: [`vizflyt_arena::crash::ahead_m`]. [m, cam]
    pub ahead_m: Option<f64>,
}

/// Newest previews of a vehicle, by camera.
#[derive(Debug, Default)]
pub struct RecentPreviews(Vec<VecDeque<TimedPreview>>);

/// Preview with the time that it shows.
#[derive(Clone, Debug)]
pub struct TimedPreview {
    pub(super) shown: ServerTime,
    pub(super) preview: Arc<Preview>,
}

impl RecentPreviews {
    /// Allocates the memory for all previews of this many cameras.
    pub fn of(cameras: usize) -> Self {
        Self((0..cameras).map(|_| VecDeque::with_capacity(MAX_PREVIEWS)).collect())
    }

    /// Adds a camera's preview; drops the oldest if the buffer is full.
    pub fn add(&mut self, camera: usize, shown: ServerTime, preview: Arc<Preview>) {
        let Some(kept) = self.0.get_mut(camera) else { return };
        if kept.len() == MAX_PREVIEWS {
            kept.pop_front();
        }
        kept.push_back(TimedPreview { shown, preview });
    }

    /// Returns the previews of each camera in the last [`SHOWN_S`] until `at`, oldest first.
    pub(super) fn until(&self, at: ServerTime) -> Vec<Vec<TimedPreview>> {
        let is_shown =
            |shot: &&TimedPreview| (0.0..=SHOWN_S).contains(&at.seconds_since(shot.shown));
        self.0.iter().map(|kept| kept.iter().filter(is_shown).cloned().collect()).collect()
    }
}

/// Time span of the images on a card. [s]
const SHOWN_S: f64 = 2.0;
/// Maximum previews per camera: [`SHOWN_S`] and the delay until a card is made, at 15 Hz.
const MAX_PREVIEWS: usize = 36;

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(s: f64) -> ServerTime {
        ServerTime::ZERO.plus_seconds(s)
    }

    #[test]
    fn keeps_two_seconds_of_previews_in_bounded_memory() {
        let mut shots = RecentPreviews::of(2);
        let room = shots.0[1].capacity();
        for k in 0..200_u32 {
            let preview = Arc::new(Preview { colour: vec![k as u8], ..Preview::default() });
            shots.add(1, shown(f64::from(k) / 15.0), preview.clone());
            // Previews of a camera that does not exist are ignored.
            shots.add(7, shown(f64::from(k) / 15.0), preview);
        }
        assert_eq!((shots.0[1].len(), shots.0[1].capacity()), (MAX_PREVIEWS, room));
        // The end was 0.3 s ago: later previews are not shown, earlier ones are.
        let end = shown(199.0 / 15.0 - 0.3);
        let found = shots.until(end);
        let times: Vec<f64> = found[1].iter().map(|shot| end.seconds_since(shot.shown)).collect();
        assert!(found[0].is_empty() && (29..=31).contains(&times.len()), "{times:?}");
        assert!(times[0] > 1.9 && times.iter().all(|s| (0.0..=SHOWN_S).contains(s)), "{times:?}");
    }
}
