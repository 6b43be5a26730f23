//! Queue of images from the network to the decoder, piece by piece; newest wins.
//!
//! ```text
//! receiver tasks: open, push, push, ... end ──▶ Mailbox ──▶ decode thread: next, next, ...
//!                 (a piece is the bitstream's header or one slice)
//! ```
//! Decoding overlaps with receiving, and with encoding on the server. Policy, per camera:
//! - One image is decoded at a time. A completely received image is decoded to its end.
//! - An incomplete image is dropped if a newer image is complete: its missing bytes are being
//!   retransmitted, and the newer image is available. It is not dropped only because a newer image
//!   has started: on a lossy link, no image would then be completed.
//! - The next image is the newest complete one, or else the oldest incomplete one, which will be
//!   completed first. Older complete images are dropped.
//! - Among cameras, the earliest tick goes first.
//!
//! Buffers of pieces are reused: in the steady state, nothing is allocated per image. The lock is held
//! only for short updates, not during decoding or network reads.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use vizflyt_process::lock;

use vizflyt_protocol::messages::{Arrivals, MAX_CAMERAS};
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer};
use vizflyt_protocol::time::HostTime;

/// Start of an image, from its first bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arrival {
    /// Number of the connection, from 1. Needed to compare ages: a restarted server counts ticks from 1 again.
    pub session: u64,
    pub header: ImageHeader,
    /// Stamp of the pose on this computer's clock.
    pub pose: HostTime,
    /// Arrival time of the first byte. [host]
    pub first: HostTime,
}

impl Arrival {
    fn age_key(&self) -> (u64, u64) {
        (self.session, self.header.seq.get())
    }
}

/// End of an image, from its last bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Whole {
    pub trailer: ImageTrailer,
    /// Arrival time of the last byte. [host]
    pub received: HostTime,
}

/// Next step of the decoder for a camera.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::large_enum_variant)] // Why: boxing would allocate per image.
pub enum DecodeStep {
    /// Begin an image.
    Begin(Arrival),
    /// Decode the next piece: first the bitstream's header, then slice by slice. Return its buffer with
    /// [`Mailbox::recycle`].
    Piece(Vec<u8>),
    /// End the image: all its pieces have been returned.
    End(Whole),
    /// Drop the image: no further pieces follow.
    Drop,
}

/// Handle of an image opened by a receiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ticket {
    camera: usize,
    id: u64,
}

/// Statistics of a camera's images since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Fates {
    /// Counts of complete images.
    pub arrivals: Arrivals,
    /// Number of images, complete or not, that were replaced by newer ones.
    pub replaced: u64,
    /// Number of truncated, late or invalid images.
    pub lost: u64,
    /// Received size of the bitstreams. [bytes]
    pub bytes: u64,
}

/// Images that wait for the decoder or are being received.
#[derive(Debug, Default)]
pub struct Mailbox {
    inner: Mutex<Inner>,
    changed: Condvar,
    sessions: AtomicU64,
}

#[derive(Debug, Default)]
struct Inner {
    lanes: [Lane; MAX_CAMERAS],
    opened: u64,
    spare_pieces: Vec<Vec<u8>>,
    spare_queues: Vec<VecDeque<Vec<u8>>>,
}

#[derive(Debug, Default)]
struct Lane {
    images: Vec<Image>,
    /// Id of the image that is being decoded.
    decoding: Option<u64>,
    fates: Fates,
}

#[derive(Debug)]
struct Image {
    id: u64,
    arrival: Arrival,
    pieces: VecDeque<Vec<u8>>,
    end: Option<Whole>,
}

impl Mailbox {
    /// Returns a number for a new connection.
    pub fn session(&self) -> u64 {
        self.sessions.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Opens an image. Returns `None` if the camera's index is invalid, if a newer image is complete
    /// already, or if too many are being received.
    pub fn open(&self, arrival: &Arrival) -> Option<Ticket> {
        let mut inner = self.lock();
        let inner = &mut *inner;
        let camera = usize::from(arrival.header.camera);
        let lane = inner.lanes.get_mut(camera)?;
        let newer_is_whole =
            |image: &Image| image.end.is_some() && image.arrival.age_key() >= arrival.age_key();
        if lane.images.iter().any(newer_is_whole) {
            lane.fates.replaced += 1;
            return None;
        }
        if lane.images.len() >= MAX_UNDER_WAY {
            lane.fates.lost += 1;
            return None;
        }
        inner.opened += 1;
        let (id, pieces) = (inner.opened, inner.spare_queues.pop().unwrap_or_default());
        lane.images.push(Image { id, arrival: *arrival, pieces, end: None });
        self.changed.notify_one();
        Some(Ticket { camera, id })
    }

    /// Appends a piece to an image and replaces it by an empty buffer. Returns `false` if the image was
    /// dropped.
    pub fn push(&self, ticket: Ticket, piece: &mut Vec<u8>) -> bool {
        let mut inner = self.lock();
        let inner = &mut *inner;
        let lane = &mut inner.lanes[ticket.camera];
        let Some(image) = lane.images.iter_mut().find(|image| image.id == ticket.id) else {
            return false;
        };
        lane.fates.bytes += piece.len() as u64;
        let mut spare = inner.spare_pieces.pop().unwrap_or_default();
        spare.clear();
        image.pieces.push_back(std::mem::replace(piece, spare));
        self.changed.notify_one();
        true
    }

    /// Ends an image: complete with its trailer, or lost if `whole` is `None`.
    pub fn end(&self, ticket: Ticket, whole: Option<Whole>) {
        let mut inner = self.lock();
        let inner = &mut *inner;
        let lane = &mut inner.lanes[ticket.camera];
        let Some(at) = lane.images.iter().position(|image| image.id == ticket.id) else { return };
        if whole.is_some() {
            lane.images[at].end = whole;
            lane.fates.arrivals.arrived += 1;
        } else {
            lane.fates.lost += 1;
            let image = lane.images.swap_remove(at);
            keep(&mut inner.spare_pieces, &mut inner.spare_queues, image.pieces);
        }
        self.changed.notify_one();
    }

    /// Waits for the next step and returns it with its camera; `None` after `timeout`. An incomplete
    /// image is begun only if `may_begin` returns true.
    pub fn next(
        &self,
        timeout: Duration,
        may_begin: impl Fn(&ImageHeader) -> bool,
    ) -> Option<(usize, DecodeStep)> {
        let deadline = Instant::now() + timeout;
        let mut inner = self.lock();
        loop {
            if let Some(found) = inner.step(&may_begin) {
                return Some(found);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return None;
            }
            inner =
                self.changed.wait_timeout(inner, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Discards the image of a camera that is being decoded.
    pub fn give_up(&self, camera: usize) {
        let mut inner = self.lock();
        let inner = &mut *inner;
        let Some(lane) = inner.lanes.get_mut(camera) else { return };
        let decoding = lane.decoding.take();
        if let Some(at) = lane.images.iter().position(|image| Some(image.id) == decoding) {
            let image = lane.images.swap_remove(at);
            keep(&mut inner.spare_pieces, &mut inner.spare_queues, image.pieces);
        }
    }

    /// Stores the buffer of a piece for reuse.
    pub fn recycle(&self, piece: Vec<u8>) {
        let mut inner = self.lock();
        if inner.spare_pieces.len() < MAX_SPARES {
            inner.spare_pieces.push(piece);
        }
    }

    /// Removes and returns a spare buffer.
    #[cfg(test)]
    pub(crate) fn spare(&self) -> Option<Vec<u8>> {
        self.lock().spare_pieces.pop()
    }

    /// Updates the counts of a camera's complete images.
    pub fn note(&self, camera: usize, count: impl FnOnce(&mut Arrivals)) {
        if let Some(lane) = self.lock().lanes.get_mut(camera) {
            count(&mut lane.fates.arrivals);
        }
    }

    /// Returns the counts of complete images before shared memory, by camera.
    pub fn arrivals(&self) -> [Arrivals; MAX_CAMERAS] {
        self.fates().map(|fates| fates.arrivals)
    }

    /// Returns the number of images of all cameras that were replaced by newer ones.
    pub fn replaced(&self) -> u64 {
        self.lock().lanes.iter().map(|lane| lane.fates.replaced).sum()
    }

    /// Returns the statistics of each camera.
    pub fn fates(&self) -> [Fates; MAX_CAMERAS] {
        let inner = self.lock();
        std::array::from_fn(|camera| inner.lanes[camera].fates)
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // Why: nothing panics while the lock is held.
        lock(&self.inner)
    }
}

impl Inner {
    fn step(&mut self, may_begin: &impl Fn(&ImageHeader) -> bool) -> Option<(usize, DecodeStep)> {
        let Self { lanes, spare_pieces, spare_queues, .. } = self;
        for (camera, lane) in lanes.iter_mut().enumerate() {
            let dropped = lane.supersede(|pieces| keep(spare_pieces, spare_queues, pieces));
            if dropped {
                return Some((camera, DecodeStep::Drop));
            }
        }
        let (_, camera, at) = lanes
            .iter()
            .enumerate()
            .filter_map(|(camera, lane)| {
                let at = lane.due(may_begin)?;
                Some((lane.images[at].arrival.age_key(), camera, at))
            })
            .min()?;
        let lane = &mut lanes[camera];
        let image = &mut lane.images[at];
        if lane.decoding.is_none() {
            lane.decoding = Some(image.id);
            return Some((camera, DecodeStep::Begin(image.arrival)));
        }
        if let Some(piece) = image.pieces.pop_front() {
            return Some((camera, DecodeStep::Piece(piece)));
        }
        // `due` returns only images with a piece or an end.
        let whole = image.end?;
        lane.decoding = None;
        let image = lane.images.swap_remove(at);
        keep(spare_pieces, spare_queues, image.pieces);
        Some((camera, DecodeStep::End(whole)))
    }
}

impl Lane {
    /// Drops images that are older than the newest complete one. Returns whether the image that was being
    /// decoded is gone, either dropped here or lost.
    fn supersede(&mut self, mut keep: impl FnMut(VecDeque<Vec<u8>>)) -> bool {
        let whole = self.images.iter().filter(|image| image.end.is_some());
        if let Some(newest) = whole.map(|image| image.arrival.age_key()).max() {
            let mut at = 0;
            while at < self.images.len() {
                let image = &self.images[at];
                let finishing = image.end.is_some() && self.decoding == Some(image.id);
                // An incomplete image that waits is dropped too: the newest is decoded before it.
                if image.arrival.age_key() < newest && !finishing {
                    self.fates.replaced += 1;
                    self.fates.arrivals.superseded += u64::from(image.end.is_some());
                    keep(self.images.swap_remove(at).pieces);
                } else {
                    at += 1;
                }
            }
        }
        let gone = |id: u64| !self.images.iter().any(|image| image.id == id);
        self.decoding.take_if(|id| gone(*id)).is_some()
    }

    /// Returns the index of the image with a possible next step.
    fn due(&self, may_begin: &impl Fn(&ImageHeader) -> bool) -> Option<usize> {
        if let Some(id) = self.decoding {
            let at = self.images.iter().position(|image| image.id == id)?;
            let image = &self.images[at];
            return (!image.pieces.is_empty() || image.end.is_some()).then_some(at);
        }
        let oldest = |at: &usize| self.images[*at].arrival.age_key();
        let candidate = |at: &usize| {
            let image = &self.images[*at];
            image.end.is_some() || may_begin(&image.arrival.header)
        };
        (0..self.images.len()).filter(candidate).min_by_key(oldest)
    }
}

fn keep(
    spare_pieces: &mut Vec<Vec<u8>>,
    spare_queues: &mut Vec<VecDeque<Vec<u8>>>,
    mut pieces: VecDeque<Vec<u8>>,
) {
    let room = MAX_SPARES.saturating_sub(spare_pieces.len());
    spare_pieces.extend(pieces.drain(..).take(room));
    if spare_queues.len() < MAX_UNDER_WAY * MAX_CAMERAS {
        spare_queues.push(pieces);
    }
}

/// Maximum number of open images per camera. The server has at most 8 in flight; more is a faulty peer.
const MAX_UNDER_WAY: usize = 8;
/// Maximum number of spare buffers: a few images of each camera with the usual four slices.
const MAX_SPARES: usize = 128;

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_protocol::time::ServerTime;

    fn arrival(camera: u8, seq: u64) -> Arrival {
        let k = Intrinsics::from_horizontal_fov(32, 24, 1.5);
        let body_from_cam = Pose::IDENTITY;
        let pose = ServerTime::ZERO;
        Arrival {
            session: 1,
            header: ImageHeader::new(seq, camera, pose, &k, &body_from_cam, &Pose::IDENTITY),
            pose: HostTime::ZERO,
            first: HostTime::ZERO,
        }
    }

    fn whole() -> Whole {
        let trailer = ImageTrailer::new(0, ServerTime::ZERO, ServerTime::ZERO);
        Whole { trailer, received: HostTime::ZERO }
    }

    /// Runs all steps that are possible without waiting: camera, then `B7` begin, `2` piece, `E` end, `D` drop.
    fn steps(mailbox: &Mailbox) -> String {
        let mut found = Vec::new();
        while let Some((camera, step)) = mailbox.next(Duration::ZERO, |_| true) {
            found.push(match step {
                DecodeStep::Begin(arrival) => format!("{camera}B{}", arrival.header.seq),
                DecodeStep::Piece(piece) => format!("{camera}{}", piece[0]),
                DecodeStep::End(_) => format!("{camera}E"),
                DecodeStep::Drop => format!("{camera}D"),
            });
        }
        found.join(" ")
    }

    fn push(mailbox: &Mailbox, ticket: Ticket, piece: u8) -> bool {
        mailbox.push(ticket, &mut vec![piece])
    }

    #[test]
    fn decodes_an_image_while_it_arrives() {
        let mailbox = Mailbox::default();
        let image = mailbox.open(&arrival(0, 7)).unwrap();
        assert_eq!(steps(&mailbox), "0B7");
        assert!(push(&mailbox, image, 1));
        assert_eq!(steps(&mailbox), "01");
        assert!(push(&mailbox, image, 2) && push(&mailbox, image, 3));
        mailbox.end(image, Some(whole()));
        assert_eq!(steps(&mailbox), "02 03 0E");
        assert!(!push(&mailbox, image, 4), "the image has ended");
        let arrivals = Arrivals { arrived: 1, ..Arrivals::default() };
        assert_eq!(mailbox.fates()[0], Fates { arrivals, bytes: 3, ..Fates::default() });
    }

    #[test]
    fn newer_image_replaces_an_older_one_only_when_complete() {
        let mailbox = Mailbox::default();
        let old = mailbox.open(&arrival(0, 7)).unwrap();
        push(&mailbox, old, 1);
        assert_eq!(steps(&mailbox), "0B7 01");
        let new = mailbox.open(&arrival(0, 8)).unwrap();
        push(&mailbox, new, 2);
        assert_eq!(steps(&mailbox), "", "the older image continues");
        mailbox.end(new, Some(whole()));
        assert_eq!(steps(&mailbox), "0D 0B8 02 0E");
        assert!(!push(&mailbox, old, 3), "the receiver gets `false`");
        assert_eq!(mailbox.replaced(), 1);
        assert!(mailbox.open(&arrival(0, 8)).is_some(), "the mailbox is empty");
    }

    #[test]
    fn decodes_a_complete_image_to_its_end() {
        let mailbox = Mailbox::default();
        let old = mailbox.open(&arrival(0, 7)).unwrap();
        push(&mailbox, old, 1);
        mailbox.end(old, Some(whole()));
        assert!(matches!(mailbox.next(Duration::ZERO, |_| true), Some((0, DecodeStep::Begin(_)))));
        for seq in 8..11 {
            let new = mailbox.open(&arrival(0, seq)).unwrap();
            push(&mailbox, new, seq as u8);
            mailbox.end(new, Some(whole()));
        }
        assert!(mailbox.open(&arrival(0, 9)).is_none(), "10 is complete");
        assert_eq!(steps(&mailbox), "01 0E 0B10 010 0E");
        assert_eq!(mailbox.replaced(), 3);
        let arrivals = mailbox.arrivals()[0];
        assert_eq!((arrivals.arrived, arrivals.superseded), (4, 2));
    }

    #[test]
    fn drops_a_truncated_image() {
        let mailbox = Mailbox::default();
        let old = mailbox.open(&arrival(0, 7)).unwrap();
        push(&mailbox, old, 1);
        assert_eq!(steps(&mailbox), "0B7 01");
        let new = mailbox.open(&arrival(0, 8)).unwrap();
        mailbox.end(old, None);
        assert_eq!(steps(&mailbox), "0D 0B8");
        mailbox.give_up(0);
        assert!(!push(&mailbox, new, 1));
        assert_eq!(mailbox.fates()[0].lost, 1);
        assert_eq!(steps(&mailbox), "");
    }

    #[test]
    fn cameras_are_independent_and_the_earliest_tick_goes_first() {
        let mailbox = Mailbox::default();
        let tickets: Vec<_> =
            [(0, 3), (1, 2)].map(|(c, seq)| mailbox.open(&arrival(c, seq)).unwrap()).into();
        push(&mailbox, tickets[0], 5);
        assert_eq!(steps(&mailbox), "1B2 0B3 05", "camera 1 stalls, camera 0 does not");
        assert!(mailbox.open(&arrival(200, 1)).is_none(), "invalid camera");
        // An image that may not begin early is begun when it is complete.
        mailbox.end(tickets[0], Some(whole()));
        let next = mailbox.open(&arrival(0, 4)).unwrap();
        assert!(matches!(mailbox.next(Duration::ZERO, |_| false), Some((0, DecodeStep::End(_)))));
        assert_eq!(mailbox.next(Duration::ZERO, |_| false), None);
        mailbox.end(next, Some(whole()));
        assert!(matches!(mailbox.next(Duration::ZERO, |_| false), Some((0, DecodeStep::Begin(_)))));
    }

    #[test]
    fn images_of_a_restarted_server_are_newer_and_their_number_is_bounded() {
        let mailbox = Mailbox::default();
        assert_eq!((mailbox.session(), mailbox.session()), (1, 2));
        let old = mailbox.open(&arrival(0, 1000)).unwrap();
        mailbox.end(old, Some(whole()));
        let restarted = Arrival { session: 2, ..arrival(0, 1) };
        let new = mailbox.open(&restarted).unwrap();
        mailbox.end(new, Some(whole()));
        assert_eq!(steps(&mailbox), "0B1 0E");
        let opened = (0..50).filter(|seq| mailbox.open(&arrival(0, 2000 + seq)).is_some());
        assert_eq!(opened.count(), MAX_UNDER_WAY);
    }
}
