//! From the threads that fly to the thread that writes: a bounded queue that nobody waits for.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use vizflyt_process::lock;

use vizflyt_protocol::messages::{Odometry, PoseSample};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::HostTime;

use super::{Channel, Level, LoggedSensors};
use crate::stream::Mailbox;

/// Records waiting for the disk at most: some 10 s of flight. Beyond, they are dropped, counted.
const QUEUE: usize = 8192;
/// Bytes of images waiting at most: some 5 s at 640x480 and 60 Hz. Beyond, images are dropped,
/// counted. [bytes]
pub(super) const MAX_IMAGE_BYTES: usize = 64 << 20;

/// Something to be logged.
#[derive(Debug)]
pub(super) enum Record {
    /// A figure of ours, encoded.
    Json { channel: Channel, at: HostTime, json: Vec<u8> },
    /// The vehicle was localized.
    Pose { at: HostTime, stamp: HostTime, sample: PoseSample },
    /// The plugin's own estimate.
    Odometry { at: HostTime, odometry: Odometry },
    /// A line for people.
    Text { channel: Channel, at: HostTime, level: Level, name: String, text: String },
    /// A message to or from the plugin.
    Plugin { at: HostTime, is_to_plugin: bool, body: Vec<u8> },
    /// What the plugin got to see.
    Observation(Box<ObservationRecord>),
    /// Which flight this is: names and values.
    Flight(Vec<(&'static str, String)>),
    /// The flight is over.
    End,
}

/// One observation: its head, and its images as received.
#[derive(Debug)]
pub(super) struct ObservationRecord {
    pub(super) at: HostTime,
    pub(super) seq: u64,
    pub(super) head: Vec<u8>,
    pub(super) images: Vec<LoggedImage>,
    pub(super) sensors: LoggedSensors,
    /// Where the memory of the images goes when they are written.
    pub(super) home: Arc<Mailbox>,
}

impl ObservationRecord {
    pub(super) fn len(&self) -> usize {
        self.images.iter().flat_map(|image| &image.pieces).map(Vec::len).sum()
    }

    /// Gives the memory back to those who receive images.
    pub(super) fn recycle(self) {
        for piece in self.images.into_iter().flat_map(|image| image.pieces) {
            self.home.recycle(piece);
        }
    }
}

/// One image as received, on its way to the log.
#[derive(Debug)]
pub struct LoggedImage {
    /// Index of the camera.
    pub camera: usize,
    /// Its name.
    pub name: String,
    /// What came before the bitstream.
    pub header: ImageHeader,
    /// When the newest pose behind it was measured. [host]
    pub pose: HostTime,
    /// When its last byte had come. [host]
    pub received: HostTime,
    /// The bitstream's header and slices.
    pub pieces: Vec<Vec<u8>>,
}

impl LoggedImage {
    /// Returns the instant that the image shows. [host]
    pub(super) fn shown(&self) -> HostTime {
        shown(&self.header, self.pose)
    }
}

/// Returns the instant that an image shows, the newest pose behind which was measured at `pose`. [host]
pub(super) fn shown(header: &ImageHeader, pose: HostTime) -> HostTime {
    let ahead_ns = header.exposure_ns.get().wrapping_sub(header.pose_ns.get());
    pose.plus_ns(ahead_ns.cast_signed())
}

/// What was dropped so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Observations with their images.
    pub images: u64,
    /// All else.
    pub records: u64,
}

/// The queue, and what its ends share.
#[derive(Debug)]
pub(super) struct Queue {
    records: SyncSender<Record>,
    image_bytes: AtomicUsize,
    dropped_images: AtomicU64,
    dropped_records: AtomicU64,
    trouble: Mutex<Option<String>>,
}

impl Queue {
    pub(super) fn new() -> (Arc<Self>, Receiver<Record>) {
        Self::of(QUEUE)
    }

    pub(super) fn of(len: usize) -> (Arc<Self>, Receiver<Record>) {
        let (records, receiver) = sync_channel(len);
        let queue = Self {
            records,
            image_bytes: AtomicUsize::new(0),
            dropped_images: AtomicU64::new(0),
            dropped_records: AtomicU64::new(0),
            trouble: Mutex::new(None),
        };
        (Arc::new(queue), receiver)
    }

    /// Takes a record, or drops and counts it if there is no room.
    pub(super) fn push(&self, record: Record) {
        let len = match &record {
            Record::Observation(observation) => observation.len(),
            _ => 0,
        };
        let waiting = self.image_bytes.fetch_add(len, Ordering::Relaxed);
        let result = if len > 0 && waiting + len > MAX_IMAGE_BYTES {
            Err(record)
        } else {
            self.records.try_send(record).map_err(|error| match error {
                TrySendError::Full(record) | TrySendError::Disconnected(record) => record,
            })
        };
        match result {
            Ok(()) => {}
            Err(Record::Observation(observation)) => {
                self.image_bytes.fetch_sub(len, Ordering::Relaxed);
                self.dropped_images.fetch_add(1, Ordering::Relaxed);
                observation.recycle();
            }
            Err(_) => {
                self.dropped_records.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// Sends the end, however many records wait before it.
    pub(super) fn end(&self) {
        // Nobody there: the writer has ended already.
        let _ = self.records.send(Record::End);
    }

    /// An observation of `len` bytes has left the queue.
    pub(super) fn taken(&self, len: usize) {
        self.image_bytes.fetch_sub(len, Ordering::Relaxed);
    }

    pub(super) fn dropped(&self) -> Dropped {
        Dropped {
            images: self.dropped_images.load(Ordering::Relaxed),
            records: self.dropped_records.load(Ordering::Relaxed),
        }
    }

    /// Tells people of trouble; the newest counts.
    pub(super) fn complain(&self, text: String) {
        tracing::warn!("flight log: {text}");
        *lock(&self.trouble) = Some(text);
    }

    pub(super) fn poll_trouble(&self) -> Option<String> {
        lock(&self.trouble).take()
    }
}
