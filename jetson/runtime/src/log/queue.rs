//! Bounded queue from the flight's threads to the log's thread. Senders never wait.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use vizflyt_process::lock;

use vizflyt_protocol::messages::{Odometry, PoseSample};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::HostTime;

use super::{Channel, Level, LoggedSensors};
use crate::stream::Mailbox;

/// Maximum number of waiting records, about 10 s of flight. Further records are dropped and counted.
const QUEUE: usize = 8192;
/// Maximum size of waiting images, about 5 s at 640x480 and 60 Hz. Further images are dropped and
/// counted. [bytes]
pub(super) const MAX_IMAGE_BYTES: usize = 64 << 20;

/// Record to be logged.
#[derive(Debug)]
pub(super) enum Record {
    /// An encoded message of a JSON channel.
    Json { channel: Channel, at: HostTime, json: Vec<u8> },
    /// A localized pose of the instant `stamp`.
    Pose { at: HostTime, stamp: HostTime, sample: PoseSample },
    /// An odometry estimate of the plugin.
    Odometry { at: HostTime, odometry: Odometry },
    /// A text line of foxglove.Log.
    Text { channel: Channel, at: HostTime, level: Level, name: String, text: String },
    /// A message to or from the plugin.
    Plugin { at: HostTime, is_to_plugin: bool, body: Vec<u8> },
    /// An observation of the plugin.
    Observation(Box<ObservationRecord>),
    /// Names and values that identify the flight.
    Flight(Vec<(&'static str, String)>),
    /// End of the flight.
    End,
}

/// One observation: head, and images as received.
#[derive(Debug)]
pub(super) struct ObservationRecord {
    pub(super) at: HostTime,
    pub(super) seq: u64,
    pub(super) head: Vec<u8>,
    pub(super) images: Vec<LoggedImage>,
    pub(super) sensors: LoggedSensors,
    /// Mailbox that reuses the buffers of the images.
    pub(super) home: Arc<Mailbox>,
}

impl ObservationRecord {
    pub(super) fn len(&self) -> usize {
        self.images.iter().flat_map(|image| &image.pieces).map(Vec::len).sum()
    }

    /// Returns the buffers to the mailbox.
    pub(super) fn recycle(self) {
        for piece in self.images.into_iter().flat_map(|image| image.pieces) {
            self.home.recycle(piece);
        }
    }
}

/// One received image for the log.
#[derive(Debug)]
pub struct LoggedImage {
    /// Index of the camera.
    pub camera: usize,
    /// Name of the camera.
    pub name: String,
    pub header: ImageHeader,
    /// Measurement time of the newest pose used for the image. [host]
    pub pose: HostTime,
    /// Arrival time of the last byte. [host]
    pub received: HostTime,
    /// Header and slices of the bitstream.
    pub pieces: Vec<Vec<u8>>,
}

impl LoggedImage {
    /// Returns the instant that the image shows. [host]
    pub(super) fn shown(&self) -> HostTime {
        shown(&self.header, self.pose)
    }
}

/// Returns the instant that an image shows; `pose` is the measurement time of its newest pose. [host]
pub(super) fn shown(header: &ImageHeader, pose: HostTime) -> HostTime {
    let ahead_ns = header.exposure_ns.get().wrapping_sub(header.pose_ns.get());
    pose.plus_ns(ahead_ns.cast_signed())
}

/// Counts of dropped records.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Observations with their images.
    pub images: u64,
    /// All other records.
    pub records: u64,
}

/// The queue, and the state shared by its two ends.
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

    /// Queues a record, or drops and counts it if the queue is full.
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

    /// Queues the end; waits while the queue is full.
    pub(super) fn end(&self) {
        // Fails only if the writer has ended already.
        let _ = self.records.send(Record::End);
    }

    /// Subtracts an observation of `len` bytes that has left the queue.
    pub(super) fn taken(&self, len: usize) {
        self.image_bytes.fetch_sub(len, Ordering::Relaxed);
    }

    pub(super) fn dropped(&self) -> Dropped {
        Dropped {
            images: self.dropped_images.load(Ordering::Relaxed),
            records: self.dropped_records.load(Ordering::Relaxed),
        }
    }

    /// Reports a problem; replaces an unread one.
    pub(super) fn complain(&self, text: String) {
        tracing::warn!("flight log: {text}");
        *lock(&self.trouble) = Some(text);
    }

    pub(super) fn poll_trouble(&self) -> Option<String> {
        lock(&self.trouble).take()
    }
}
