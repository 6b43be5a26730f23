//! Rendered ticks: from the render thread to the encode thread, then to the previews.
//!
//! ```text
//! render --publish--> ready --take--> encode --pass_on--> spent --take_spent--> previews
//!            \--- what no one took, if a page watches ------^                      |
//!   ^---------------------------- buffers, reused -----------------------<---------/
//! ```
//! Both places are newest-wins. The previews live on what the encoder has done with or had no room
//! for: they never take a tick from it, and it never waits for them.

use std::sync::Arc;
use std::time::Duration;

use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::RgbdImage;

use crate::mailbox::Mailbox;
use crate::render::cameras::CameraSet;

/// The images rendered in one tick, and those of replaced ticks that nobody took; reused from tick to
/// tick.
#[derive(Debug, Default)]
pub struct RenderedTick {
    /// One per camera, vehicle by vehicle.
    pub slots: Vec<RenderedImage>,
}

/// The newest image of one camera.
#[derive(Debug, Default)]
pub struct RenderedImage {
    /// Whether there is one; everything else counts only then.
    pub fresh: bool,
    /// Whether a runtime flew when it was rendered, so that it counts.
    pub counted: bool,
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Index into the vehicle's cameras.
    pub camera: usize,
    /// Its tick, counted from 1.
    pub seq: u64,
    /// When the newest pose behind it was measured.
    pub pose: ServerTime,
    /// The instant it shows.
    pub shown: ServerTime,
    /// The pose rendered from: that of the instant.
    pub world_from_body: Option<Pose<World, Body>>,
    /// The vehicle's cameras that it was rendered with.
    pub set: Option<Arc<CameraSet>>,
    /// Rendering of the tick began.
    pub render_start: ServerTime,
    /// Rendering of the tick ended.
    pub render_end: ServerTime,
    /// The image.
    pub image: RgbdImage,
}

impl RenderedTick {
    /// Takes over the images of `old`, which it replaces unread, of cameras that were not due
    /// again: else a slow camera's images would be lost to a busy reader.
    pub fn inherit(&mut self, old: &mut Self) {
        for (mine, theirs) in self.slots.iter_mut().zip(&mut old.slots) {
            if theirs.fresh && !(mine.fresh && mine.seq >= theirs.seq) {
                std::mem::swap(mine, theirs);
            }
        }
    }
}

/// The ticks between the threads.
#[derive(Debug, Default)]
pub struct RenderQueue {
    ready: Mailbox<RenderedTick>,
    spent: Mailbox<RenderedTick>,
}

impl RenderQueue {
    /// Returns a tick to fill.
    pub fn spare(&self) -> RenderedTick {
        self.ready.spare()
    }

    /// Puts a rendered tick in place of one that nobody took, which goes to the previews if someone
    /// has them `watched`; returns whether it replaced one.
    pub fn publish(&self, tick: RenderedTick, watched: bool) -> bool {
        let replaced = self.ready.put_over(tick, RenderedTick::inherit);
        replaced.map(|old| self.pass_on(old, watched)).is_some()
    }

    /// Waits at most `timeout` for a tick to encode.
    pub fn take(&self, timeout: Duration) -> Option<RenderedTick> {
        self.ready.take(timeout)
    }

    /// Gives a tick that the encoder has done with to the previews, if someone has them `watched`.
    pub fn pass_on(&self, tick: RenderedTick, watched: bool) {
        if !watched {
            return self.ready.recycle(tick);
        }
        if let Some(old) = self.spent.put_over(tick, RenderedTick::inherit) {
            self.ready.recycle(old);
        }
    }

    /// Waits at most `timeout` for a tick to make previews of.
    pub fn take_spent(&self, timeout: Duration) -> Option<RenderedTick> {
        self.spent.take(timeout)
    }

    /// Gives a tick back to be filled anew.
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
    fn slow_cameras_image_outlives_its_tick() {
        let mut old = RenderedTick { slots: vec![slot(7, true), slot(7, true), slot(3, false)] };
        let mut new = RenderedTick { slots: vec![slot(8, true), slot(1, false), slot(2, false)] };
        new.inherit(&mut old);
        assert_eq!(found(&new), [(8, true), (7, true), (2, false)]);
    }

    /// Draws `count` ticks, of which the encoder takes every `nth`; returns what it took and the
    /// ticks that were made.
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
    fn previews_that_nobody_makes_cost_the_encoder_no_tick_and_no_memory() {
        for nth in [1, 3] {
            let expected: Vec<_> = (1..=99).filter(|seq| seq % nth == 0).collect();
            let ticks = RenderQueue::default();
            let unwatched = fly(&ticks, 99, nth, false);
            assert_eq!(unwatched.0, expected);
            assert!(ticks.take_spent(Duration::ZERO).is_none(), "nobody watches");
            // The preview thread is stuck on one tick for ever, and a second one waits for it.
            let ticks = RenderQueue::default();
            fly(&ticks, 1, 1, true);
            let stuck = ticks.take_spent(Duration::ZERO).unwrap();
            let watched = fly(&ticks, 99, nth, true);
            assert_eq!(watched.0, expected);
            assert!(watched.1 <= 4, "{} ticks made", watched.1);
            // What waits for it is the newest.
            ticks.recycle(stuck);
            assert_eq!(ticks.take_spent(Duration::ZERO).unwrap().slots[0].seq, 99);
        }
    }

    #[test]
    fn previews_have_what_no_runtime_takes() {
        let ticks = RenderQueue::default();
        fly(&ticks, 5, u64::MAX, true);
        assert_eq!(ticks.take_spent(Duration::ZERO).unwrap().slots[0].seq, 4);
    }
}
