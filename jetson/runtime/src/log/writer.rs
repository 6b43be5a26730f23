//! Thread of the log: encodes records, writes them, and sends them to viewers.
//!
//! Cost at 640x480 and 60 Hz: 13 MB/s, copied into the chunk and again for a subscribed viewer; one write to
//! disk each second or each [`CHUNK_BYTES`].

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use foxglove::messages as fox;
use mcap::records::{MessageHeader, Metadata};
use mcap::{McapResult, WriteOptions, Writer};
use prost::Message;
use serde_json::json;
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::geometry::{Distortion, Pose};
use vizflyt_protocol::messages::PoseSample;
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::HostTime;
use vizflyt_rgbd::split_jpeg;
use vizflyt_sdk::host_now;
use zerocopy::IntoBytes;

use super::budget::Budget;
use super::channels::Channel;
use super::convert::{BODY, parts, timestamp};
use super::depth::DepthReader;
use super::file::{Disk, SafeFile};
use super::live::Live;
use super::messages::{Observation, ObservedImage, ObservedRecords, PluginMessage};
use super::queue::{Dropped, LoggedImage, ObservationRecord, Queue, Record};
use super::sensors::LoggedSensors;

/// Maximum duration of a chunk, which a killed process loses.
const CHUNK_PERIOD: Duration = Duration::from_secs(1);
/// Maximum size of a chunk in memory. [bytes]
const CHUNK_BYTES: usize = 4 << 20;
/// Free disk space below which images are omitted, so that the rest of the log still fits, and other
/// programs can write. [bytes]
const MIN_FREE: u64 = 256 << 20;
/// Free disk space above which images are logged again. [bytes]
const ENOUGH_FREE: u64 = 512 << 20;
/// Period at which a camera's calibration is repeated, for viewers that connect later. [ns]
const CALIBRATION_PERIOD_NS: u64 = 1_000_000_000;

/// Destinations of messages: the file and the live viewers.
pub(super) struct LogSinks<D: Disk> {
    file: Option<Writer<SafeFile<D>>>,
    live: Option<Live>,
    ids: BTreeMap<Channel, u16>,
    sequence: u32,
    /// Size of the messages since the last chunk. [bytes]
    waiting: usize,
    written_bytes: u64,
    /// Budget that selects images; without it, all are written.
    budget: Option<Budget>,
}

impl<D: Disk> LogSinks<D> {
    /// Begins a file, if there is one, with all fixed channels.
    pub(super) fn new(
        disk: Option<D>,
        live: Option<Live>,
        budget: Option<Budget>,
    ) -> McapResult<Self> {
        let file = disk.map(|disk| {
            WriteOptions::new()
                .compression(None)
                .profile("")
                .library(concat!("vizflyt ", env!("CARGO_PKG_VERSION")))
                // This module closes chunks by time or size.
                .chunk_size(None)
                // Chunks have checksums; a checksum of the data section would require writing in order.
                .calculate_data_section_crc(false)
                .create(SafeFile::new(disk))
        });
        let ids = BTreeMap::new();
        let file = file.transpose()?;
        let mut sinks = Self { file, live, ids, sequence: 0, waiting: 0, written_bytes: 0, budget };
        for channel in Channel::FIXED {
            sinks.offer(channel, "")?;
        }
        sinks.flush()?;
        Ok(sinks)
    }

    fn offer(&mut self, channel: Channel, camera: &str) -> McapResult<()> {
        let description = channel.describe(camera);
        if let Some(live) = &mut self.live {
            live.offer(channel, &description);
        }
        let id = match &mut self.file {
            Some(file) => {
                let schema = &description.schema;
                let schema = file.add_schema(&schema.name, &schema.encoding, &schema.data)?;
                let (topic, encoding) = (&description.topic, description.encoding);
                file.add_channel(schema, topic, encoding, &BTreeMap::new())?
            }
            None => 0,
        };
        self.ids.insert(channel, id);
        Ok(())
    }

    /// Sends a message to viewers, and writes it.
    pub(super) fn put(
        &mut self,
        channel: Channel,
        camera: &str,
        at_ns: u64,
        message: &[u8],
    ) -> McapResult<()> {
        self.show(channel, camera, at_ns, message)?;
        let Some(file) = &mut self.file else { return Ok(()) };
        if let Some(budget) = &mut self.budget {
            budget.spend(message.len());
        }
        self.sequence = self.sequence.wrapping_add(1);
        self.waiting += message.len();
        let header = MessageHeader {
            channel_id: self.ids[&channel],
            sequence: self.sequence,
            log_time: at_ns,
            publish_time: at_ns,
        };
        file.write_to_known_channel(&header, message)
    }

    /// Sends a message to viewers without writing it.
    fn show(
        &mut self,
        channel: Channel,
        camera: &str,
        at_ns: u64,
        message: &[u8],
    ) -> McapResult<()> {
        if !self.ids.contains_key(&channel) {
            self.offer(channel, camera)?;
        }
        if let Some(live) = &self.live {
            live.send(channel, at_ns, message);
        }
        Ok(())
    }

    fn metadata(&mut self, values: BTreeMap<String, String>) -> McapResult<()> {
        let Some(file) = &mut self.file else { return Ok(()) };
        file.write_metadata(&Metadata { name: FLIGHT.into(), metadata: values })
    }

    /// Completes the chunk.
    pub(super) fn flush(&mut self) -> McapResult<()> {
        self.written_bytes += std::mem::take(&mut self.waiting) as u64;
        self.file.as_mut().map_or(Ok(()), Writer::flush)
    }

    pub(super) fn is_chunk_full(&self) -> bool {
        self.waiting >= CHUNK_BYTES
    }

    /// Completes the file.
    pub(super) fn finish(mut self) -> McapResult<()> {
        if let Some(live) = self.live.take() {
            live.stop();
        }
        self.file.take().map_or(Ok(()), |mut file| file.finish().map(|_| ()))
    }

    /// Closes the file without further writes.
    fn abandon(&mut self) {
        if let Some(file) = self.file.take() {
            // `into_inner`, because a dropped writer tries to finish the file.
            drop(file.into_inner());
        }
    }
}

/// Name of the metadata record that identifies the flight.
pub(super) const FLIGHT: &str = "vizflyt.flight";

/// State of the thread.
pub(super) struct LogWriter<D: Disk> {
    pub(super) sinks: LogSinks<D>,
    queue: Arc<Queue>,
    /// Offset from this computer's clock to time since 1970. [ns]
    offset_ns: u64,
    free_bytes: Box<dyn Fn() -> Option<u64> + Send>,
    images_fit: bool,
    /// Number of observations without their images.
    left_out: u64,
    /// Reported drops.
    reported: Dropped,
    calibrations: BTreeMap<usize, (Vec<u8>, u64)>,
    /// Instant of the newest written reading of each sensor. [host]
    readings: BTreeMap<u8, HostTime>,
    rest: Vec<u8>,
    /// Decoder of depth for viewers, if requested.
    depth: Option<DepthReader>,
}

impl<D: Disk> LogWriter<D> {
    /// `free_bytes` returns the free disk space, if available.
    pub(super) fn new(
        sinks: LogSinks<D>,
        queue: Arc<Queue>,
        free_bytes: Box<dyn Fn() -> Option<u64> + Send>,
    ) -> Self {
        // MCAP uses times since 1970.
        let wall = SystemTime::now().duration_since(UNIX_EPOCH);
        let wall_ns = wall.map_or(0, |since| since.as_nanos() as u64);
        Self::since(wall_ns.wrapping_sub(host_now().as_ns()), sinks, queue, free_bytes)
    }

    /// Same as [`Self::new`], with a clock that starts `offset_ns` after 1970.
    pub(super) fn since(
        offset_ns: u64,
        sinks: LogSinks<D>,
        queue: Arc<Queue>,
        free_bytes: Box<dyn Fn() -> Option<u64> + Send>,
    ) -> Self {
        Self {
            sinks,
            queue,
            offset_ns,
            free_bytes,
            images_fit: true,
            left_out: 0,
            reported: Dropped::default(),
            calibrations: BTreeMap::new(),
            readings: BTreeMap::new(),
            rest: Vec::new(),
            depth: None,
        }
    }

    /// Also writes depth for viewers.
    pub(super) fn show_depth(&mut self) {
        self.depth = Some(DepthReader::default());
    }

    /// Writes until the end of the flight. After a write error, only the file ends: viewers still receive
    /// messages, and buffers of images are reused.
    pub(super) fn run(mut self, records: &Receiver<Record>) {
        let mut flushed = Instant::now();
        loop {
            let result = match records.recv_timeout(CHUNK_PERIOD) {
                Ok(Record::End) | Err(RecvTimeoutError::Disconnected) => break,
                Ok(record) => self.take(record),
                Err(RecvTimeoutError::Timeout) => Ok(()),
            };
            let is_due = flushed.elapsed() >= CHUNK_PERIOD;
            let result = result.and_then(|()| {
                if !is_due && !self.sinks.is_chunk_full() {
                    return Ok(());
                }
                if is_due {
                    flushed = Instant::now();
                    self.check_health()?;
                }
                self.sinks.flush()
            });
            if let Err(error) = result {
                self.fail(&error);
            }
        }
        let (queue, offset_ns) = (Arc::clone(&self.queue), self.offset_ns);
        let result = self.status("the flight is over");
        tracing::debug!("flight log: closed at {} ns", offset_ns.wrapping_add(host_now().as_ns()));
        if let Err(error) = result.and_then(|()| self.sinks.finish()) {
            queue.complain(format!("it could not be completed: {error}"));
        }
    }

    fn fail(&mut self, error: &mcap::McapError) {
        if self.sinks.file.is_none() {
            return;
        }
        self.sinks.abandon();
        let megabytes = self.sinks.written_bytes as f64 / 1e6;
        self.queue.complain(format!(
            "the flight is not logged any further: {error}; the first {megabytes:.1} MB are a complete \
             file"
        ));
    }

    /// Stops logging images while the disk is almost full, warns if images or records were dropped, and
    /// logs the status. Called once a second.
    pub(super) fn check_health(&mut self) -> McapResult<()> {
        let free = if self.sinks.file.is_some() { (self.free_bytes)() } else { None };
        let fit = images_fit(self.images_fit, free);
        if fit != self.images_fit {
            self.images_fit = fit;
            let megabytes = free.unwrap_or(0) >> 20;
            let text = if fit {
                format!("images are logged again: {megabytes} MB are free")
            } else {
                format!(
                    "images are no longer logged: only {megabytes} MB are free on the disk; delete \
                     old flights"
                )
            };
            self.queue.complain(text);
        }
        let dropped = self.queue.dropped();
        // Reports the first drop, and then each doubling.
        let is_due = |now: u64, reported: u64| now > 0 && now >= 2 * reported && now != reported;
        if is_due(dropped.images, self.reported.images)
            || is_due(dropped.records, self.reported.records)
        {
            self.reported = dropped;
            self.queue.complain(format!(
                "{} images and {} records were dropped: the disk is too slow",
                dropped.images, dropped.records
            ));
        }
        self.status("")
    }

    fn status(&mut self, text: &str) -> McapResult<()> {
        let Dropped { images, records } = self.queue.dropped();
        let status = json!({
            "written_bytes": self.sinks.written_bytes, "dropped_images": images,
            "dropped_records": records, "left_out_images": self.left_out,
            "free_bytes": (self.free_bytes)(), "text": text
        });
        let at_ns = self.wall_ns(host_now());
        self.sinks.put(Channel::Log, "", at_ns, status.to_string().as_bytes())
    }

    fn wall_ns(&self, at: HostTime) -> u64 {
        at.as_ns().wrapping_add(self.offset_ns)
    }

    pub(super) fn take(&mut self, record: Record) -> McapResult<()> {
        match record {
            Record::Json { channel, at, json } => {
                self.sinks.put(channel, "", self.wall_ns(at), &json)
            }
            Record::Pose { at, stamp, sample } => self.pose(at, stamp, &sample),
            Record::Odometry { at, odometry } => {
                let stamp_ns = self.wall_ns(odometry.stamp);
                let pose = pose_in_frame(stamp_ns, ODOM, &odometry.odom_from_body);
                self.sinks.put(Channel::Odometry, "", self.wall_ns(at), &pose.encode_to_vec())
            }
            Record::Text { channel, at, level, name, text } => {
                let at_ns = self.wall_ns(at);
                let log = fox::Log {
                    timestamp: Some(timestamp(at_ns)),
                    level: level as i32,
                    message: text,
                    name,
                    ..fox::Log::default()
                };
                self.sinks.put(channel, "", at_ns, &log.encode_to_vec())
            }
            Record::Plugin { at, is_to_plugin, body } => {
                let protocol = PROTOCOL_VERSION.into();
                let at_ns = at.as_ns();
                let message = PluginMessage { is_to_plugin, protocol, body, at_ns };
                self.sinks.put(Channel::Plugin, "", self.wall_ns(at), &message.encode_to_vec())
            }
            Record::Observation(record) => {
                self.queue.taken(record.len());
                let result = self.queued(&record);
                record.recycle();
                result
            }
            Record::Flight(values) => {
                let own = |(name, value): (&str, String)| (name.to_owned(), value);
                let images = if self.sinks.budget.is_some() { "reduced" } else { "full" };
                let values = values.into_iter().chain([("images", images.to_owned())]);
                self.sinks.metadata(values.map(own).collect())
            }
            Record::End => Ok(()),
        }
    }

    fn pose(&mut self, at: HostTime, stamp: HostTime, sample: &PoseSample) -> McapResult<()> {
        let at_ns = self.wall_ns(stamp);
        let (world_from_body, twist) = (&sample.world_from_body, &sample.twist);
        let pose = pose_in_frame(at_ns, WORLD, world_from_body);
        self.sinks.put(Channel::Pose, "", at_ns, &pose.encode_to_vec())?;
        let transform = transform(at_ns, WORLD, BODY, world_from_body);
        self.sinks.put(Channel::Transform, "", at_ns, &transform.encode_to_vec())?;
        let motion = json!({
            "stamp_ns": stamp.as_ns(),
            "v_world_mps": twist.linear_mps.to_array(),
            "omega_body_radps": twist.angular_radps.to_array(),
            "position_sigma_m": sample.position_sigma_m.to_array(),
            "rotation_sigma_rad": sample.rotation_sigma_rad.to_array(),
            "age_ms": at.seconds_since(stamp) * 1e3
        });
        self.sinks.put(Channel::Motion, "", at_ns, motion.to_string().as_bytes())
    }

    /// Writes an observation of the image thread, if the disk has enough free space.
    fn queued(&mut self, record: &ObservationRecord) -> McapResult<()> {
        if !self.images_fit {
            return Ok(());
        }
        let is_kept = self.keeps_image(record.at);
        let ObservationRecord { at, seq, head, images, sensors, .. } = record;
        self.observation(*at, *seq, head.clone(), images, sensors, is_kept)
    }

    /// Whether images that arrived at `at` fit into the budget.
    pub(super) fn keeps_image(&mut self, at: HostTime) -> bool {
        self.sinks.budget.as_mut().is_none_or(|budget| budget.allows_image(at))
    }

    /// Writes an observation, with its images if `is_kept`.
    pub(super) fn observation(
        &mut self,
        at: HostTime,
        seq: u64,
        head: Vec<u8>,
        logged: &[LoggedImage],
        sensors: &LoggedSensors,
        is_kept: bool,
    ) -> McapResult<()> {
        let at_ns = self.wall_ns(at);
        let mut images = Vec::new();
        let records = self.readings(at_ns, sensors, is_kept)?;
        if is_kept {
            self.poses_at_images(at_ns, logged)?;
            for image in logged {
                images.push(self.image(at_ns, image)?);
            }
        } else {
            self.left_out += 1;
            self.show_images(at_ns, logged)?;
        }
        let protocol = PROTOCOL_VERSION.into();
        let (published_ns, table) = (at.as_ns(), sensors.table.clone());
        let observation =
            Observation { seq, protocol, published_ns, head, images, sensors: table, records };
        self.sinks.put(Channel::Observation, "", at_ns, &observation.encode_to_vec())
    }

    /// Writes new readings on the sensors' topics, large ones only if images are kept. Returns the observation's
    /// records of all readings.
    fn readings(
        &mut self,
        at_ns: u64,
        sensors: &LoggedSensors,
        is_kept: bool,
    ) -> McapResult<Vec<ObservedRecords>> {
        let mut records = Vec::new();
        for logged in &sensors.readings {
            let (shown, is_apart) = (logged.reading.shown, logged.is_apart());
            let is_new = self.readings.get(&logged.sensor) != Some(&shown);
            if is_new && (is_kept || !is_apart) {
                let message = logged.message(self.wall_ns(shown));
                self.sinks.put(logged.channel(), &logged.name, at_ns, &message)?;
                self.readings.insert(logged.sensor, shown);
            }
            let bytes = if is_apart { Vec::new() } else { logged.reading.records.clone() };
            let (sensor, name) = (logged.sensor.into(), logged.name.clone());
            records.push(ObservedRecords { sensor, name, is_apart, bytes });
        }
        Ok(records)
    }

    /// Writes the poses from which images were rendered, once for images of the same instant.
    fn poses_at_images(&mut self, at_ns: u64, images: &[LoggedImage]) -> McapResult<()> {
        let mut before = None;
        for image in images {
            let shown_ns = self.wall_ns(image.shown());
            if before.replace(shown_ns) == Some(shown_ns) {
                continue;
            }
            let world_from_body = image.header.world_from_body();
            let pose = pose_in_frame(shown_ns, WORLD, &world_from_body);
            self.sinks.put(Channel::PoseAtImage, "", at_ns, &pose.encode_to_vec())?;
        }
        Ok(())
    }

    /// Sends images that are not written to viewers.
    fn show_images(&mut self, at_ns: u64, images: &[LoggedImage]) -> McapResult<()> {
        if self.sinks.live.is_none() {
            return Ok(());
        }
        for image in images {
            self.calibration(at_ns, image)?;
            if let Some(color) = self.color(image) {
                let channel = Channel::Color(image.camera as u8);
                self.sinks.show(channel, &image.name, at_ns, &color)?;
            }
        }
        Ok(())
    }

    /// Writes an image's colour and calibration; returns the rest of it.
    fn image(&mut self, at_ns: u64, image: &LoggedImage) -> McapResult<ObservedImage> {
        self.calibration(at_ns, image)?;
        self.stamps(at_ns, image)?;
        self.depth(at_ns, image)?;
        let color = self.color(image);
        let is_color_apart = color.is_some();
        let bitstream = match color {
            Some(color) => {
                let channel = Channel::Color(image.camera as u8);
                self.sinks.put(channel, &image.name, at_ns, &color)?;
                self.rest.clone()
            }
            None => image.pieces.concat(),
        };
        Ok(ObservedImage {
            camera: image.camera as u32,
            name: image.name.clone(),
            header: image.header.as_bytes().to_vec(),
            received_ns: image.received.as_ns(),
            bitstream,
            is_color_apart,
            pose_ns: image.pose.as_ns(),
            shown_ns: image.shown().as_ns(),
        })
    }

    /// Writes the stamps of an image.
    fn stamps(&mut self, at_ns: u64, image: &LoggedImage) -> McapResult<()> {
        let stamps = json!({
            "seq": image.header.seq.get(),
            "shown_ns": self.wall_ns(image.shown()),
            "pose_ns": self.wall_ns(image.pose),
            "received_ns": self.wall_ns(image.received)
        });
        let channel = Channel::Stamps(image.camera as u8);
        self.sinks.put(channel, &image.name, at_ns, stamps.to_string().as_bytes())
    }

    /// Writes an image's depth for viewers, if requested; omits images that do not decode.
    fn depth(&mut self, at_ns: u64, image: &LoggedImage) -> McapResult<()> {
        let shown_ns = self.wall_ns(image.shown());
        let Some(reader) = &mut self.depth else { return Ok(()) };
        let Some(depth_mm) = reader.read(&image.pieces) else { return Ok(()) };
        let (width, height) = (image.header.width_px.get(), image.header.height_px.get());
        let raw = fox::RawImage {
            timestamp: Some(timestamp(shown_ns)),
            frame_id: image.name.clone(),
            width,
            height,
            encoding: "16UC1".into(),
            step: 2 * width,
            data: depth_mm.iter().flat_map(|mm| mm.to_le_bytes()).collect::<Vec<u8>>().into(),
        };
        let channel = Channel::Depth(image.camera as u8);
        self.sinks.put(channel, &image.name, at_ns, &raw.encode_to_vec())
    }

    /// Returns an image's colour for viewers, and stores the rest of the bitstream in `rest`; `None` if
    /// the colour is not a JPEG.
    fn color(&mut self, image: &LoggedImage) -> Option<Vec<u8>> {
        let mut jpeg = Vec::with_capacity(image.pieces.iter().map(Vec::len).sum());
        self.rest.clear();
        let pieces = image.pieces.iter().map(Vec::as_slice);
        if !split_jpeg(pieces, &mut jpeg, &mut self.rest) {
            return None;
        }
        let color = fox::CompressedImage {
            timestamp: Some(timestamp(self.wall_ns(image.shown()))),
            frame_id: image.name.clone(),
            data: jpeg.into(),
            format: "jpeg".into(),
        };
        Some(color.encode_to_vec())
    }

    /// Writes a camera's calibration when it has changed, and each [`CALIBRATION_PERIOD_NS`].
    fn calibration(&mut self, at_ns: u64, image: &LoggedImage) -> McapResult<()> {
        let calibration = calibration(at_ns, &image.name, &image.header);
        let body_from_cam = image.header.body_from_cam();
        let timeless = fox::CameraCalibration { timestamp: None, ..calibration.clone() };
        let mut key = timeless.encode_to_vec();
        key.extend_from_slice(image.header.mount_m.as_bytes());
        key.extend_from_slice(image.header.mount_xyzw.as_bytes());
        let is_known = self.calibrations.get(&image.camera).is_some_and(|(known, written_ns)| {
            *known == key && at_ns.saturating_sub(*written_ns) < CALIBRATION_PERIOD_NS
        });
        if is_known {
            return Ok(());
        }
        self.calibrations.insert(image.camera, (key, at_ns));
        let channel = Channel::Calibration(image.camera as u8);
        self.sinks.put(channel, &image.name, at_ns, &calibration.encode_to_vec())?;
        let transform = transform(at_ns, BODY, &image.name, &body_from_cam);
        self.sinks.put(Channel::Transform, "", at_ns, &transform.encode_to_vec())
    }
}

const WORLD: &str = "world";
const ODOM: &str = "odom";

/// Whether the free disk space is enough for images, with hysteresis.
fn images_fit(they_did: bool, free: Option<u64>) -> bool {
    free.is_none_or(|free| free >= if they_did { MIN_FREE } else { ENOUGH_FREE })
}

fn pose_in_frame<A, B>(at_ns: u64, frame: &str, pose: &Pose<A, B>) -> fox::PoseInFrame {
    let (position, orientation) = parts(pose);
    fox::PoseInFrame {
        timestamp: Some(timestamp(at_ns)),
        frame_id: frame.into(),
        pose: Some(fox::Pose { position: Some(position), orientation: Some(orientation) }),
    }
}

fn transform<A, B>(
    at_ns: u64,
    parent: &str,
    child: &str,
    pose: &Pose<A, B>,
) -> fox::FrameTransform {
    let (translation, rotation) = parts(pose);
    fox::FrameTransform {
        timestamp: Some(timestamp(at_ns)),
        parent_frame_id: parent.into(),
        child_frame_id: child.into(),
        translation: Some(translation),
        rotation: Some(rotation),
    }
}

fn calibration(at_ns: u64, name: &str, header: &ImageHeader) -> fox::CameraCalibration {
    let k = header.intrinsics();
    // The origin is the centre of the first pixel in OpenCV and Foxglove, but its corner in VizFlyt.
    let (cx, cy) = (k.cx_px - 0.5, k.cy_px - 0.5);
    let (model, d) = match k.distortion {
        Distortion::None => ("", vec![]),
        Distortion::BrownConrady { .. } => ("plumb_bob", k.distortion.to_wire().1.to_vec()),
        Distortion::KannalaBrandt { .. } => {
            ("kannala_brandt", k.distortion.to_wire().1[..4].to_vec())
        }
    };
    fox::CameraCalibration {
        timestamp: Some(timestamp(at_ns)),
        frame_id: name.into(),
        width: k.width_px,
        height: k.height_px,
        distortion_model: model.into(),
        d,
        k: vec![k.fx_px, 0.0, cx, 0.0, k.fy_px, cy, 0.0, 0.0, 1.0],
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: vec![k.fx_px, 0.0, cx, 0.0, 0.0, k.fy_px, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
}
