//! The previews of the last seconds, kept for crash cards.

use std::collections::VecDeque;
use std::sync::Arc;

use vizflyt_protocol::time::ServerTime;

/// Two small pictures for the page.
#[derive(Debug, Default)]
pub struct Preview {
    /// JPEG of the colour image.
    pub colour: Vec<u8>,
    /// JPEG of the depth image, coloured by distance.
    pub depth: Vec<u8>,
    /// JPEG of which object is seen where, coloured by id; empty where none was seen yet.
    pub ids: Vec<u8>,
    /// What is ahead: [`vizflyt_arena::crash::ahead_m`]. [m, cam]
    pub ahead_m: Option<f64>,
}

/// The newest previews of a vehicle, by camera.
#[derive(Debug, Default)]
pub struct RecentPreviews(Vec<VecDeque<TimedPreview>>);

/// A preview, and the instant that it shows.
#[derive(Clone, Debug)]
pub struct TimedPreview {
    pub(super) shown: ServerTime,
    pub(super) preview: Arc<Preview>,
}

impl RecentPreviews {
    /// Makes room for all that this many cameras will ever keep.
    pub fn of(cameras: usize) -> Self {
        Self((0..cameras).map(|_| VecDeque::with_capacity(MAX_PREVIEWS)).collect())
    }

    /// Adds a camera's preview, in place of the oldest where there is no room.
    pub fn add(&mut self, camera: usize, shown: ServerTime, preview: Arc<Preview>) {
        let Some(kept) = self.0.get_mut(camera) else { return };
        if kept.len() == MAX_PREVIEWS {
            kept.pop_front();
        }
        kept.push_back(TimedPreview { shown, preview });
    }

    /// Returns what each camera showed in the last [`SHOWN_S`] until `at`, oldest first.
    pub(super) fn until(&self, at: ServerTime) -> Vec<Vec<TimedPreview>> {
        let is_shown =
            |shot: &&TimedPreview| (0.0..=SHOWN_S).contains(&at.seconds_since(shot.shown));
        self.0.iter().map(|kept| kept.iter().filter(is_shown).cloned().collect()).collect()
    }
}

/// Images are shown over so long. [s]
const SHOWN_S: f64 = 2.0;
/// Previews kept of a camera: [`SHOWN_S`] and the delay until a card is made, at 15 Hz.
const MAX_PREVIEWS: usize = 36;

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(s: f64) -> ServerTime {
        ServerTime::ZERO.plus_seconds(s)
    }

    #[test]
    fn two_seconds_of_previews_are_kept_and_no_more_memory_is_taken() {
        let mut shots = RecentPreviews::of(2);
        let room = shots.0[1].capacity();
        for k in 0..200_u32 {
            let preview = Arc::new(Preview { colour: vec![k as u8], ..Preview::default() });
            shots.add(1, shown(f64::from(k) / 15.0), preview.clone());
            // A camera that is not there is nobody's.
            shots.add(7, shown(f64::from(k) / 15.0), preview);
        }
        assert_eq!((shots.0[1].len(), shots.0[1].capacity()), (MAX_PREVIEWS, room));
        // The end was 0.3 s ago: what came after it is not shown, what came in time is.
        let end = shown(199.0 / 15.0 - 0.3);
        let found = shots.until(end);
        let times: Vec<f64> = found[1].iter().map(|shot| end.seconds_since(shot.shown)).collect();
        assert!(found[0].is_empty() && (29..=31).contains(&times.len()), "{times:?}");
        assert!(times[0] > 1.9 && times.iter().all(|s| (0.0..=SHOWN_S).contains(s)), "{times:?}");
    }
}
