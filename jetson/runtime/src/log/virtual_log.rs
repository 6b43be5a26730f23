//! Log of a flight on a virtual clock ([`crate::lockstep`]): the same format, written by the flight's thread.
//!
//! Nothing is dropped and no real clock is read, so the same flight gives the same bytes, except for the positions of
//! the plugin's printed lines, which depend on the timing of a pipe. Colour and depth are lossless; each kept image is
//! also written as JPEG for viewers. The virtual clock starts in 1970.

use std::ffi::OsString;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::sync::Arc;

use foxglove::messages as fox;
use mcap::McapResult;
use prost::Message;
use serde::Serialize;
use vizflyt_protocol::messages::{Event, FromPlugin, Odometry, PoseSample, ToPlugin};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::HostTime;
use vizflyt_rgbd::{ColorMode, EncodeOptions, Encoder, RgbdView, encode_jpeg};
use vizflyt_sdk::ImuSample;

use super::budget::Budget;
use super::convert::timestamp;
use super::file::{self, Disk};
use super::queue::{LoggedImage, Queue, Record, shown};
use super::writer::{LogSinks, LogWriter};
use super::{
    Channel, LoggedImages, LoggedSensors, event_record, flight_record, imu_message, line_record,
    plugin_record,
};

/// Maximum duration of a chunk. [s]
const CHUNK_PERIOD_S: f64 = 1.0;
/// JPEG quality of the images for viewers. [0 to 100]
const QUALITY: u8 = 85;

/// One camera's image as passed to the plugin.
#[derive(Clone, Copy, Debug)]
pub struct GivenImage<'a> {
    /// Camera, size, lens and stamps.
    pub header: &'a ImageHeader,
    /// Name of the camera.
    pub name: &'a str,
    /// Measurement time of the newest pose used for the image. [host]
    pub pose: HostTime,
    /// H x W x 3.
    pub rgb: &'a [u8],
    /// H x W, camera z, 0 without a return. [mm]
    pub depth_mm: &'a [u16],
}

/// Log of one flight on a virtual clock. [`Self::finish`] completes the file.
pub struct VirtualLog {
    writer: LogWriter<PlainFile>,
    closed_at: HostTime,
    encoder: Encoder,
    /// First error; nothing is written after it.
    failed: Option<mcap::McapError>,
}

impl VirtualLog {
    /// Begins the log of a flight by `plugin` at `now` in the empty `file`. `depth`: also writes depth for viewers.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn new(
        file: File,
        images: LoggedImages,
        plugin: &OsString,
        depth: bool,
        now: HostTime,
    ) -> McapResult<Self> {
        let budget = (images == LoggedImages::Reduced).then(Budget::default);
        let probe = file.try_clone()?;
        let sinks = LogSinks::new(Some(PlainFile(file)), None, budget)?;
        let (queue, _) = Queue::of(0);
        let free_bytes = Box::new(move || file::free_bytes(&probe));
        let mut writer = LogWriter::since(0, sinks, Arc::clone(&queue), free_bytes);
        if depth {
            writer.show_depth();
        }
        let options = EncodeOptions { color_mode: ColorMode::Lossless, ..EncodeOptions::default() };
        let encoder = Encoder::new(options);
        let mut log = Self { writer, closed_at: now, encoder, failed: None };
        log.take(now, flight_record(plugin, &[]));
        Ok(log)
    }

    /// Logs `message` on a JSON channel.
    pub fn write(&mut self, channel: Channel, at: HostTime, message: &impl Serialize) {
        if let Ok(json) = serde_json::to_vec(message) {
            self.take(at, Record::Json { channel, at, json });
        }
    }

    /// Logs a pose of the instant `stamp` that arrived at `at`.
    pub fn pose(&mut self, at: HostTime, stamp: HostTime, sample: &PoseSample) {
        self.take(at, Record::Pose { at, stamp, sample: *sample });
    }

    /// Logs an odometry estimate of the plugin that arrived at `at`.
    pub fn odometry(&mut self, at: HostTime, odometry: &Odometry) {
        self.take(at, Record::Odometry { at, odometry: *odometry });
    }

    pub fn imu(&mut self, sample: &ImuSample) {
        self.write(Channel::Imu, sample.stamp, &imu_message(sample));
    }

    pub fn event(&mut self, at: HostTime, event: &Event) {
        self.take(at, event_record(at, event));
    }

    /// Logs a line that the plugin printed on `stream` (`stdout` or `stderr`) while it processed image `seq`.
    pub fn line(&mut self, at: HostTime, stream: &str, line: &str, seq: u64) {
        self.take(at, line_record(at, stream, line, seq));
    }

    /// Logs a message to the plugin; a replay sends it again.
    pub fn to_plugin(&mut self, at: HostTime, message: &ToPlugin) {
        self.take(at, plugin_record(at, true, message));
    }

    /// Logs a message of the plugin; a replay compares its replies with it.
    pub fn from_plugin(&mut self, at: HostTime, message: &FromPlugin) {
        self.take(at, plugin_record(at, false, message));
    }

    /// Logs an observation: shared memory up to the first plane, and its images, if the log keeps them.
    pub fn observation(
        &mut self,
        at: HostTime,
        seq: u64,
        head: &[u8],
        images: &[GivenImage<'_>],
        sensors: &LoggedSensors,
    ) {
        if self.failed.is_some() {
            return;
        }
        let result = self.write_observation(at, seq, head, images, sensors);
        self.keep(at, result);
    }

    fn write_observation(
        &mut self,
        at: HostTime,
        seq: u64,
        head: &[u8],
        images: &[GivenImage<'_>],
        sensors: &LoggedSensors,
    ) -> McapResult<()> {
        let is_kept = self.writer.keeps_image(at);
        let mut logged = Vec::new();
        for image in images.iter().filter(|_| is_kept) {
            let mut bitstream = Vec::new();
            let (width, height) = (image.header.width_px.get(), image.header.height_px.get());
            let GivenImage { header, name, pose, rgb, depth_mm } = *image;
            let view = RgbdView { width, height, rgb, depth_mm };
            let encoded = self.encoder.encode(&view, &mut bitstream);
            encoded.map_err(io::Error::other)?;
            self.show(at, image, (width, height))?;
            logged.push(LoggedImage {
                camera: header.camera.into(),
                name: name.to_owned(),
                header: *header,
                pose,
                received: at,
                pieces: vec![bitstream],
            });
        }
        self.writer.observation(at, seq, head.to_vec(), &logged, sensors, is_kept)
    }

    /// Writes an image's colour as JPEG for viewers.
    fn show(
        &mut self,
        at: HostTime,
        image: &GivenImage<'_>,
        (width, height): (u32, u32),
    ) -> McapResult<()> {
        let mut jpeg = Vec::new();
        encode_jpeg(image.rgb, width, height, QUALITY, &mut jpeg).map_err(io::Error::other)?;
        let color = fox::CompressedImage {
            timestamp: Some(timestamp(shown(image.header, image.pose).as_ns())),
            frame_id: image.name.to_owned(),
            data: jpeg.into(),
            format: "jpeg".into(),
        };
        let channel = Channel::Color(image.header.camera);
        self.writer.sinks.put(channel, image.name, at.as_ns(), &color.encode_to_vec())
    }

    fn take(&mut self, at: HostTime, record: Record) {
        if self.failed.is_some() {
            return;
        }
        let result = self.writer.take(record);
        self.keep(at, result);
    }

    fn keep(&mut self, at: HostTime, result: McapResult<()>) {
        let is_due = at.seconds_since(self.closed_at) >= CHUNK_PERIOD_S;
        let result = result.and_then(|()| {
            if is_due || self.writer.sinks.is_chunk_full() {
                self.closed_at = at;
                return self.writer.sinks.flush();
            }
            Ok(())
        });
        self.failed = result.err();
    }

    /// Completes the file.
    ///
    /// # Errors
    /// The first error, for example a full disk. The file then lacks all later records.
    pub fn finish(self) -> McapResult<()> {
        match self.failed {
            None => self.writer.sinks.finish(),
            Some(error) => Err(error),
        }
    }
}

impl std::fmt::Debug for VirtualLog {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VirtualLog").field("failed", &self.failed).finish_non_exhaustive()
    }
}

/// File without synchronization to the medium; the caller synchronizes it at the end.
struct PlainFile(File);

impl Disk for PlainFile {
    fn write_at(&mut self, bytes: &[u8], offset: u64) -> io::Result<()> {
        self.0.write_all_at(bytes, offset)
    }

    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.0.set_len(len)
    }
}
