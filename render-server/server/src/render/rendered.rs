//! Rendered ticks: from the render thread to the encode thread, then to the previews.
//!
//! ```text
//! render --publish--> ready --take--> encode --pass_on--> spent --take_spent--> previews
//!            \--- ticks not taken, if a page watches- ------^                      |
//!   ^---------------------------- buffers, reused -----------------------<---------/
//! ```
//! Both mailboxes are newest-wins. The previews use ticks that the encoder has finished or had no room for:
//! they never take a tick from it, and it never waits for them.

use std::sync::Arc;
use std::time::Duration;

use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::RgbdImage;

use crate::mailbox::Mailbox;
use crate::render::cameras::CameraSet;

/// Images rendered in one tick, and those of replaced ticks that were not taken; reused from tick to tick.
#[derive(Debug, Default)]
pub struct RenderedTick {
    /// Slots by camera, vehicle by vehicle.
    pub slots: Vec<RenderedImage>,
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

/// Ticks in transit between the threads.
#[derive(Debug, Default)]
pub struct RenderQueue {
    ready: Mailbox<RenderedTick>,
    spent: Mailbox<RenderedTick>,
}

impl RenderQueue {
    /// Returns an empty tick to fill.
    pub fn spare(&self) -> RenderedTick {
        self.ready.spare()
    }

    /// Publishes a rendered tick. An unread older one goes to the previews if a page has them `watched`.
    /// Returns whether it replaced one.
    pub fn publish(&self, tick: RenderedTick, watched: bool) -> bool {
        let replaced = self.ready.put_over(tick, RenderedTick::inherit);
        replaced.map(|old| self.pass_on(old, watched)).is_some()
    }

    /// Waits at most `timeout` for a tick to encode.
    pub fn take(&self, timeout: Duration) -> Option<RenderedTick> {
        self.ready.take(timeout)
    }

    /// Passes a tick that the encoder has finished to the previews, if a page has them `watched`.
    pub fn pass_on(&self, tick: RenderedTick, watched: bool) {
        if !watched {
            return self.ready.recycle(tick);
        }
        if let Some(old) = self.spent.put_over(tick, RenderedTick::inherit) {
            self.ready.recycle(old);
        }
    }

    /// Waits at most `timeout` for a tick for previews.
    pub fn take_spent(&self, timeout: Duration) -> Option<RenderedTick> {
        self.spent.take(timeout)
    }

    /// Returns a tick to be filled again.
    pub fn recycle(&self, tick: RenderedTick) {
        self.ready.recycle(tick);
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
        let mut old = RenderedTick { slots: vec![slot(7, true), slot(7, true), slot(3, false)] };
        let mut new = RenderedTick { slots: vec![slot(8, true), slot(1, false), slot(2, false)] };
        new.inherit(&mut old);
        assert_eq!(found(&new), [(8, true), (7, true), (2, false)]);
    }

    /// Renders `count` ticks, of which the encoder takes every `nth`. Returns the ticks taken, and the number
    /// of ticks allocated.
    fn fly(ticks: &RenderQueue, count: u64, nth: u64, watched: bool) -> (Vec<u64>, usize) {
        let (mut taken, mut made) = (Vec::new(), 0);
        for seq in 1..=count {
            let mut tick = ticks.spare();
            made += usize::from(tick.slots.is_empty());
            tick.slots.resize_with(1, Default::default);
            (tick.slots[0].fresh, tick.slots[0].seq) = (true, seq);
            ticks.publish(tick, watched);
            if seq.is_multiple_of(nth) {
                let tick = ticks.take(Duration::ZERO).unwrap();
                taken.push(tick.slots[0].seq);
                ticks.pass_on(tick, watched);
            }
        }
        (taken, made)
    }

    #[test]
    fn stalled_previews_cost_the_encoder_no_tick_and_no_memory() {
        for nth in [1, 3] {
            let expected: Vec<_> = (1..=99).filter(|seq| seq % nth == 0).collect();
            let ticks = RenderQueue::default();
            let unwatched = fly(&ticks, 99, nth, false);
            assert_eq!(unwatched.0, expected);
            assert!(ticks.take_spent(Duration::ZERO).is_none(), "nobody watches");
            // The preview thread is blocked on one tick, and a second one waits for it.
            let ticks = RenderQueue::default();
            fly(&ticks, 1, 1, true);
            let stuck = ticks.take_spent(Duration::ZERO).unwrap();
            let watched = fly(&ticks, 99, nth, true);
            assert_eq!(watched.0, expected);
            assert!(watched.1 <= 4, "{} ticks made", watched.1);
            // The waiting tick is the newest.
            ticks.recycle(stuck);
            assert_eq!(ticks.take_spent(Duration::ZERO).unwrap().slots[0].seq, 99);
        }
    }

    #[test]
    fn previews_get_ticks_that_no_runtime_takes() {
        let ticks = RenderQueue::default();
        fly(&ticks, 5, u64::MAX, true);
        assert_eq!(ticks.take_spent(Duration::ZERO).unwrap().slots[0].seq, 4);
    }
}
