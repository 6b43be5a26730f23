//! Rendered ticks: from the render thread to the encode thread, then to the previews.
//!
//! ```text
//! render --publish--> encoder --offer_previews--> previews
//!            \--- replaced ticks, if a page watches --^
//! ```
//! In both places the newest tick wins. Previews are made of ticks that the encoder is done with or had no time for:
//! they never take a tick from it, and it never waits for them. Buffers of dropped ticks are used again.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use vizflyt_process::lock;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::RgbdImage;

use crate::mailbox::Mailbox;
use crate::render::cameras::CameraSet;

/// Images rendered in one tick, and those of replaced ticks that were not taken; reused from tick to tick.
#[derive(Debug)]
pub struct RenderedTick {
    /// Slots by camera, vehicle by vehicle.
    pub slots: Vec<RenderedImage>,
    pool: Arc<Pool>,
}

/// The newest image of one camera.
#[derive(Debug, Default)]
pub struct RenderedImage {
    /// Whether the slot contains an image; otherwise the other fields are invalid.
    pub fresh: bool,
    /// Whether a runtime was flying at the time of rendering, so that the image counts.
    pub counted: bool,
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Index into the vehicle's cameras.
    pub camera: usize,
    /// Number of its tick, from 1.
    pub seq: u64,
    /// Time of measurement of the newest pose used.
    pub pose: ServerTime,
    /// Instant that the image shows.
    pub shown: ServerTime,
    /// Pose at that instant, from which it was rendered.
    pub world_from_body: Option<Pose<World, Body>>,
    /// Cameras of the vehicle at the time of rendering.
    pub set: Option<Arc<CameraSet>>,
    /// Start of rendering the tick.
    pub render_start: ServerTime,
    /// End of rendering the tick.
    pub render_end: ServerTime,
    /// The image.
    pub image: RgbdImage,
}

impl RenderedTick {
    /// Takes over unread images of the replaced tick `old`, of cameras that were not due again. Otherwise a
    /// busy reader would lose images of slow cameras.
    pub fn inherit(&mut self, old: &mut Self) {
        for (mine, theirs) in self.slots.iter_mut().zip(&mut old.slots) {
            if theirs.fresh && !(mine.fresh && mine.seq >= theirs.seq) {
                std::mem::swap(mine, theirs);
            }
        }
    }
}

/// Rendered ticks between the threads.
#[derive(Debug, Default)]
pub struct RenderQueue {
    for_encoder: Mailbox<RenderedTick>,
    for_previews: Mailbox<RenderedTick>,
    pool: Arc<Pool>,
}

impl RenderQueue {
    /// Returns a tick to fill, with the buffers of a dropped one if there are any.
    pub fn new_tick(&self) -> RenderedTick {
        RenderedTick {
            slots: lock(&self.pool.0).pop().unwrap_or_default(),
            pool: self.pool.clone(),
        }
    }

    /// Hands a rendered tick to the encoder, in place of an older one, which goes to the previews if they are
    /// `watched`. Returns whether it replaced one.
    pub fn publish(&self, tick: RenderedTick, watched: bool) -> bool {
        let replaced = self.for_encoder.put_over(tick, RenderedTick::inherit);
        let has_replaced = replaced.is_some();
        if let Some(old) = replaced.filter(|_| watched) {
            self.offer_previews(old);
        }
        has_replaced
    }

    /// Waits at most `timeout` for a tick to encode.
    pub fn take(&self, timeout: Duration) -> Option<RenderedTick> {
        self.for_encoder.take(timeout)
    }

    /// Hands a tick that the encoder has finished to the previews.
    pub fn offer_previews(&self, tick: RenderedTick) {
        self.for_previews.put_over(tick, RenderedTick::inherit);
    }

    /// Waits at most `timeout` for a tick for previews.
    pub fn take_for_previews(&self, timeout: Duration) -> Option<RenderedTick> {
        self.for_previews.take(timeout)
    }
}

/// Buffers of dropped ticks. At most five ticks exist at a time, so that none is freed: one each in the renderer, the
/// encoder, the previews and the two mailboxes.
#[derive(Debug, Default)]
struct Pool(Mutex<Vec<Vec<RenderedImage>>>);

impl Drop for RenderedTick {
    fn drop(&mut self) {
        lock(&self.pool.0).push(std::mem::take(&mut self.slots));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slot(seq: u64, fresh: bool) -> RenderedImage {
        RenderedImage { fresh, seq, ..RenderedImage::default() }
    }

    fn found(tick: &RenderedTick) -> Vec<(u64, bool)> {
        tick.slots.iter().map(|slot| (slot.seq, slot.fresh)).collect()
    }

    #[test]
    fn image_of_a_slow_camera_outlives_its_tick() {
        let ticks = RenderQueue::default();
        let (mut old, mut new) = (ticks.new_tick(), ticks.new_tick());
        old.slots = vec![slot(7, true), slot(7, true), slot(3, false)];
        new.slots = vec![slot(8, true), slot(1, false), slot(2, false)];
        new.inherit(&mut old);
        assert_eq!(found(&new), [(8, true), (7, true), (2, false)]);
    }

    /// Renders `count` ticks, of which the encoder takes every `nth`. Returns the ticks taken, and the number
    /// of ticks allocated.
    fn fly(ticks: &RenderQueue, count: u64, nth: u64, watched: bool) -> (Vec<u64>, usize) {
        let (mut taken, mut made) = (Vec::new(), 0);
        for seq in 1..=count {
            let mut tick = ticks.new_tick();
            made += usize::from(tick.slots.is_empty());
            tick.slots.resize_with(1, Default::default);
            (tick.slots[0].fresh, tick.slots[0].seq) = (true, seq);
            ticks.publish(tick, watched);
            if seq.is_multiple_of(nth) {
                let tick = ticks.take(Duration::ZERO).unwrap();
                taken.push(tick.slots[0].seq);
                if watched {
                    ticks.offer_previews(tick);
                }
            }
        }
        (taken, made)
    }

    #[test]
    fn slow_previews_cost_the_encoder_no_tick_and_no_memory() {
        for nth in [1, 3] {
            let expected: Vec<_> = (1..=99).filter(|seq| seq % nth == 0).collect();
            let ticks = RenderQueue::default();
            let unwatched = fly(&ticks, 99, nth, false);
            assert_eq!(unwatched.0, expected);
            assert!(ticks.take_for_previews(Duration::ZERO).is_none());
            // The preview thread is blocked on one tick, and a second one waits for it.
            let ticks = RenderQueue::default();
            fly(&ticks, 1, 1, true);
            let stuck = ticks.take_for_previews(Duration::ZERO).unwrap();
            let watched = fly(&ticks, 99, nth, true);
            assert_eq!(watched.0, expected);
            assert!(watched.1 <= 4, "{} ticks made", watched.1);
            // The waiting tick is the newest.
            drop(stuck);
            assert_eq!(ticks.take_for_previews(Duration::ZERO).unwrap().slots[0].seq, 99);
        }
    }

    #[test]
    fn previews_get_ticks_that_the_encoder_did_not_take() {
        let ticks = RenderQueue::default();
        fly(&ticks, 5, u64::MAX, true);
        assert_eq!(ticks.take_for_previews(Duration::ZERO).unwrap().slots[0].seq, 4);
    }
}
