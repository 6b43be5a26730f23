//! Newest wins: at most one image per camera waits for decoding.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

use vizflyt_protocol::messages::{Arrivals, MAX_CAMERAS};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::HostTime;

/// An image as received.
#[derive(Clone, Debug)]
pub struct ReceivedImage {
    /// Who, when, from where.
    pub header: ImageHeader,
    /// The RGB-D bitstream.
    pub payload: Vec<u8>,
    /// The pose's stamp on this computer's clock.
    pub pose: HostTime,
    /// When the first byte had come.
    pub first: HostTime,
    /// When the last byte had come.
    pub received: HostTime,
}

/// The images that wait.
#[derive(Debug, Default)]
pub struct Mailbox {
    slots: Mutex<[Option<ReceivedImage>; MAX_CAMERAS]>,
    filled: Condvar,
    replaced: AtomicU64,
    /// What became of images so far, by camera.
    arrivals: Mutex<[Arrivals; MAX_CAMERAS]>,
}

impl Mailbox {
    /// Puts an image in place of an older one of its camera. One older than what waits is
    /// dropped: streams may overtake each other.
    pub fn offer(&self, image: ReceivedImage) {
        let mut slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(slot) = slots.get_mut(usize::from(image.header.camera)) else { return };
        let camera = usize::from(image.header.camera);
        self.note(camera, |counts| counts.arrived += 1);
        match slot {
            // By pose too: a server that restarted counts from the start again.
            Some(waiting)
                if waiting.header.seq.get() >= image.header.seq.get()
                    && waiting.pose >= image.pose =>
            {
                self.note(camera, |counts| counts.stale += 1);
                self.replaced.fetch_add(1, Ordering::Relaxed);
            }
            slot => {
                if slot.replace(image).is_some() {
                    self.note(camera, |counts| counts.superseded += 1);
                    self.replaced.fetch_add(1, Ordering::Relaxed);
                }
                self.filled.notify_one();
            }
        }
    }

    /// Takes the waiting image of the earliest tick; `None` if none comes within `timeout`.
    pub fn take(&self, timeout: Duration) -> Option<ReceivedImage> {
        let slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut slots, _) = self
            .filled
            .wait_timeout_while(slots, timeout, |slots| slots.iter().all(Option::is_none))
            .unwrap_or_else(PoisonError::into_inner);
        slots
            .iter_mut()
            .filter(|slot| slot.is_some())
            .min_by_key(|slot| slot.as_ref().map(|image| image.header.seq.get()))?
            .take()
    }

    /// Counts what became of an image of a camera.
    pub fn note(&self, camera: usize, count: impl FnOnce(&mut Arrivals)) {
        let mut arrivals = self.arrivals.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(counts) = arrivals.get_mut(camera) {
            count(counts);
        }
    }

    /// Returns what became of images before they reached shared memory, by camera.
    pub fn arrivals(&self) -> [Arrivals; MAX_CAMERAS] {
        *self.arrivals.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns how many images gave way to newer ones.
    pub fn replaced(&self) -> u64 {
        self.replaced.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_protocol::time::ServerTime;

    fn image(camera: u8, seq: u64) -> ReceivedImage {
        let k = Intrinsics::from_horizontal_fov(32, 24, 1.5);
        ReceivedImage {
            header: ImageHeader::new(
                seq,
                camera,
                ServerTime::ZERO,
                &k,
                &Pose::IDENTITY,
                &Pose::IDENTITY,
            ),
            payload: Vec::new(),
            pose: HostTime::ZERO,
            first: HostTime::ZERO,
            received: HostTime::ZERO,
        }
    }

    #[test]
    fn the_newest_of_each_camera_waits_and_the_earliest_tick_goes_first() {
        let mailbox = Mailbox::default();
        assert!(mailbox.take(Duration::ZERO).is_none());
        for (camera, seq) in [(0, 1), (1, 1), (0, 3), (0, 2), (1, 2)] {
            mailbox.offer(image(camera, seq));
        }
        let taken: Vec<_> = std::iter::from_fn(|| mailbox.take(Duration::ZERO))
            .map(|image| (image.header.camera, image.header.seq.get()))
            .collect();
        assert_eq!(taken, [(1, 2), (0, 3)]);
        assert_eq!(mailbox.replaced(), 3);
        let [front, rear, ..] = mailbox.arrivals();
        assert_eq!((front.arrived, front.stale, front.superseded), (3, 1, 1));
        assert_eq!((rear.arrived, rear.stale, rear.superseded), (2, 0, 1));
        mailbox.offer(image(200, 1));
        assert!(mailbox.take(Duration::ZERO).is_none(), "there is no camera 200");
    }
}
