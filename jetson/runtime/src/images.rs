//! Decodes images from the mailbox, slice by slice as they arrive, directly into the plugin's shared memory.
//!
//! Cost at 640x480: 1.5 MB written once (JPEG and depth about 1.8 ms in four slices, of which the first three
//! overlap with receiving), and no copy afterwards. Nothing is allocated except for the log's record: the
//! pieces of a published image go to the log, which returns their buffers. A separate thread decodes, so that
//! a slow decode does not delay poses or events. The cameras of one tick share one observation. It is
//! published when all images that were sent together are complete, or when an image of a later tick is.
//!
//! An unfinished image (truncated, late, invalid, or replaced by a newer one: see [`crate::stream::Mailbox`])
//! leaves its pixels in memory that the plugin does not see: only ready cameras have a size. If an
//! observation is published before an image of it is finished, the received pieces of that image are decoded
//! again into the next observation.
//!
//! Cameras may change during a flight: each image contains the camera with which it was rendered, and the
//! observation does too. An image therefore never has the intrinsics of another one.
//!
//! At publication, the newest readings of other sensors are copied behind the images. A vehicle without such
//! sensors has no extra cost.

use std::sync::{Arc, Mutex};
use std::time::Duration;
use vizflyt_process::lock;

use vizflyt_protocol::messages::{Arrivals, CameraInfo, MAX_CAMERAS};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::sensor::SensorInfo;
use vizflyt_protocol::time::HostTime;
use vizflyt_rgbd::{DecodeError, Decoder, ImageMut, Info};
use vizflyt_sdk::ipc::{IpcError, LoanedObservation, RuntimeEnd};
use vizflyt_sdk::{ImageStamps, ObservationTooLarge, ObservationWriter, PlanesMut, host_now};

use crate::companion::Senses;
use crate::log::{ImageLog, LoggedImage, LoggedSensors, observation_head};
use crate::stream::{Arrival, DecodeStep, Mailbox, NewestReadings, Readings, Whole};
use crate::waterfall::Stamps;

/// Vehicle state that the control loop writes and the image publisher reads.
pub type SharedSenses = Arc<Mutex<Senses>>;

/// A published observation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Published {
    /// Number of the observation, from 1.
    pub seq: u64,
    /// Server's tick of the newest image.
    pub tick: u64,
    /// Measurement time of the newest image's pose. [host]
    pub pose: HostTime,
    /// Arrival time of the newest image's last byte. [host]
    pub received: HostTime,
    /// Time at which decoding ended. [host]
    pub ready: HostTime,
    /// Stamps of each image.
    pub images: heapless::Vec<Stamps, MAX_CAMERAS>,
}

/// Decodes images and publishes observations. See the module.
pub struct ImagePublisher {
    ipc: Arc<RuntimeEnd>,
    cameras: Vec<CameraInfo>,
    senses: SharedSenses,
    lanes: Vec<Lane>,
    seq: u64,
    /// Number of loaned memory blocks, used as their id.
    homes: u64,
    under_way: Option<UnderWay>,
    rejected: u64,
    log: Option<ImageLog>,
    sensors: Vec<SensorInfo>,
    readings: Arc<Readings>,
}

/// One camera's decoder and its present image.
#[derive(Default)]
struct Lane {
    decoder: Decoder,
    image: Option<Arrival>,
    /// Received pieces of the image.
    pieces: Vec<Vec<u8>>,
    /// Number of decoded pieces.
    decoded: usize,
    /// Id of the loaned memory block that contains the decoded pieces.
    home: u64,
    info: Option<Info>,
    /// Tick of the newest decoded image, and stamp of its pose.
    newest: (u64, HostTime),
}

/// An observation that waits for more cameras.
struct UnderWay {
    tick: u64,
    home: u64,
    memory: LoanedObservation,
    /// Ready cameras, one bit each.
    there: u8,
    /// Cameras that the server sends together with the first one, one bit each.
    expected: u8,
    published: Published,
    /// Headers of the ready images.
    headers: heapless::Vec<ImageHeader, MAX_CAMERAS>,
    /// Images for the log; empty without one.
    logged: Vec<LoggedImage>,
}

impl UnderWay {
    /// Whether an image ends the wait of this observation: it has a later tick, or is the next of a ready
    /// camera. A late image of another camera with an earlier tick still joins the observation.
    fn is_over(&self, tick: u64, bit: u8) -> bool {
        tick > self.tick || self.there & bit != 0
    }
}

impl ImagePublisher {
    /// Makes a publisher for these cameras (at most 8). Each image updates the description of its camera.
    pub fn new(ipc: Arc<RuntimeEnd>, cameras: Vec<CameraInfo>, senses: SharedSenses) -> Self {
        Self {
            ipc,
            lanes: cameras.iter().map(|_| Lane::default()).collect(),
            cameras,
            senses,
            seq: 0,
            homes: 0,
            under_way: None,
            rejected: 0,
            log: None,
            sensors: Vec::new(),
            readings: Arc::default(),
        }
    }

    /// Adds the newest `readings` of these sensors (at most 8) to observations.
    pub fn with_sensors(self, sensors: Vec<SensorInfo>, readings: Arc<Readings>) -> Self {
        Self { sensors, readings, ..self }
    }

    /// Logs published observations.
    pub fn with_log(self, log: Option<ImageLog>) -> Self {
        Self { log, ..self }
    }

    /// Runs until `stop` returns true; calls `notify` before each publication.
    pub fn run(
        mut self,
        mailbox: &Mailbox,
        stop: impl Fn() -> bool,
        mut notify: impl FnMut(Published),
    ) {
        while !stop() {
            if let Err(error) = self.step(mailbox, Duration::from_millis(100), &mut notify) {
                tracing::warn!("an image is not published: {error}");
            }
        }
    }

    /// Waits for the next decode step, at most `timeout`, and runs it. Returns whether a step was run.
    ///
    /// # Errors
    /// [`IpcError`] if no memory is available; the image is lost.
    pub fn step(
        &mut self,
        mailbox: &Mailbox,
        timeout: Duration,
        notify: &mut impl FnMut(Published),
    ) -> Result<bool, IpcError> {
        // An image that would end the present observation waits until it is complete.
        let may_begin = |header: &ImageHeader| {
            let (tick, bit) = (header.seq.get(), bit(header.camera.into()));
            !self.under_way.as_ref().is_some_and(|under_way| under_way.is_over(tick, bit))
        };
        let Some((camera, step)) = mailbox.next(timeout, may_begin) else { return Ok(false) };
        let result = match step {
            DecodeStep::Begin(arrival) => self.begin(camera, &arrival),
            DecodeStep::Piece(piece) => self.piece(camera, piece, notify),
            DecodeStep::End(whole) => self.end(camera, &whole, notify),
            DecodeStep::Drop => {
                self.forget(camera);
                Ok(())
            }
        };
        if result.is_err() {
            self.forget(camera);
        }
        match self.lanes.get_mut(camera) {
            Some(lane) if lane.image.is_some() => {}
            Some(lane) => {
                lane.pieces.drain(..).for_each(|piece| mailbox.recycle(piece));
                mailbox.give_up(camera);
            }
            None => mailbox.give_up(camera),
        }
        match result {
            Ok(()) => Ok(true),
            Err(Fault::Image(why, count)) => {
                self.reject(&why);
                mailbox.note(camera, count);
                Ok(true)
            }
            Err(Fault::Ipc(error)) => Err(error),
        }
    }

    fn begin(&mut self, camera: usize, arrival: &Arrival) -> Result<(), Fault> {
        let lane = self.lanes.get_mut(camera);
        let lane = lane.ok_or_else(|| Fault::image("its camera is not in this arena"))?;
        // A restarted server counts from 1 again, but its poses are newer.
        if arrival.header.seq.get() < lane.newest.0 && arrival.pose <= lane.newest.1 {
            return Err(Fault::Image("it is stale".to_owned(), |counts| counts.stale += 1));
        }
        (lane.image, lane.info, lane.decoded, lane.home) = (Some(*arrival), None, 0, 0);
        Ok(())
    }

    fn piece(
        &mut self,
        camera: usize,
        piece: Vec<u8>,
        notify: &mut impl FnMut(Published),
    ) -> Result<(), Fault> {
        if let Some(lane) = self.lanes.get_mut(camera) {
            lane.pieces.push(piece);
        }
        self.place(camera, notify)
    }

    fn end(
        &mut self,
        camera: usize,
        whole: &Whole,
        notify: &mut impl FnMut(Published),
    ) -> Result<(), Fault> {
        self.place(camera, notify)?;
        let (Some(lane), Some(under_way)) = (self.lanes.get_mut(camera), &mut self.under_way)
        else {
            return Ok(());
        };
        let Some(arrival) = lane.image.take() else { return Ok(()) };
        let slices = lane.info.map_or(0, |info| usize::from(info.slices));
        if slices == 0 || lane.decoded != 1 + slices {
            return Err(Fault::image("slices are missing"));
        }
        let (tick, ready) = (arrival.header.seq.get(), host_now());
        lane.newest = (tick, arrival.pose);
        let mut writer = ObservationWriter::resume(under_way.memory.memory(), &self.cameras)?;
        let shown = arrival.header.exposure_stamp().as_ns();
        let ahead_ns = shown.wrapping_sub(arrival.header.pose_stamp().as_ns()).cast_signed();
        let ahead_ns = ahead_ns.clamp(i32::MIN.into(), i32::MAX.into()) as i32;
        let stamps = ImageStamps { seq: tick, pose: arrival.pose, ready, ahead_ns };
        writer.image_ready(camera, &self.cameras[camera], stamps);
        under_way.there |= bit(camera);
        let published = &mut under_way.published;
        published.tick = published.tick.max(tick);
        published.pose = published.pose.max(arrival.pose);
        published.received = published.received.max(whole.received);
        published.ready = ready;
        let own = [arrival.first, whole.received, ready];
        let stamps = Stamps::of(&arrival.header, &whole.trailer, arrival.pose, own);
        // Cannot fail: at most one image of each camera.
        let _ = published.images.push(stamps);
        let _ = under_way.headers.push(arrival.header);
        if self.log.is_some() {
            under_way.logged.push(LoggedImage {
                camera,
                name: self.cameras[camera].name.as_str().to_owned(),
                header: arrival.header,
                pose: arrival.pose,
                received: whole.received,
                pieces: std::mem::take(&mut lane.pieces),
            });
        }
        if under_way.there & under_way.expected == under_way.expected {
            self.publish(notify)?;
        }
        Ok(())
    }

    /// Decodes the received and undecoded pieces of a camera's image into the present observation.
    fn place(&mut self, camera: usize, notify: &mut impl FnMut(Published)) -> Result<(), Fault> {
        let image = self.lanes.get(camera).and_then(|lane| lane.image);
        let Some(arrival) = image else { return Ok(()) };
        let (tick, together) = (arrival.header.seq.get(), arrival.header.together.get());
        if self.under_way.as_ref().is_some_and(|under_way| under_way.is_over(tick, bit(camera))) {
            self.publish(notify)?;
        }
        self.follow(camera, &arrival)?;
        if self.under_way.is_none() {
            let len = self.observation_len();
            let memory = self.ipc.loan(len)?;
            (self.seq, self.homes) = (self.seq + 1, self.homes + 1);
            let (seq, home, cameras) = (self.seq, self.homes, &self.cameras);
            self.under_way = Some(UnderWay::new(memory, seq, home, cameras, tick, together)?);
        }
        let Some(under_way) = &mut self.under_way else { return Ok(()) };
        let lane = &mut self.lanes[camera];
        if lane.home != under_way.home {
            (lane.home, lane.decoded) = (under_way.home, 0);
        }
        let mut writer = ObservationWriter::resume(under_way.memory.memory(), &self.cameras)?;
        let Some(planes) = writer.planes(camera, &self.cameras[camera]) else { return Ok(()) };
        let PlanesMut { rgb, depth_mm } = planes;
        Ok(lane.decode(&mut ImageMut { rgb, depth_mm, ..ImageMut::default() })?)
    }

    /// Updates the camera's description from its image. If the size has changed, allocates new memory, and
    /// moves the ready images of the present observation there.
    fn follow(&mut self, index: usize, image: &Arrival) -> Result<(), Fault> {
        let camera = &mut self.cameras[index];
        let intrinsics = image.header.intrinsics();
        let is = (camera.intrinsics.width_px, camera.intrinsics.height_px);
        let is_same_size = is == (intrinsics.width_px, intrinsics.height_px);
        let before = (!is_same_size).then(|| self.cameras.clone());
        let camera = &mut self.cameras[index];
        camera.intrinsics = intrinsics;
        camera.body_from_cam = image.header.body_from_cam();
        let (Some(before), Some(mut under_way)) =
            (before, self.under_way.take_if(|_| !is_same_size))
        else {
            return Ok(());
        };
        let len = self.observation_len();
        let mut memory = self.ipc.loan(len)?;
        let old = under_way.memory.bytes();
        ObservationWriter::adopt(memory.memory(), &self.cameras, old, &before)?;
        self.homes += 1;
        (under_way.memory, under_way.home) = (memory, self.homes);
        self.under_way = Some(under_way);
        Ok(())
    }

    fn publish(&mut self, notify: &mut impl FnMut(Published)) -> Result<(), IpcError> {
        let Some(mut done) = self.under_way.take() else { return Ok(()) };
        if done.there == 0 {
            return Ok(());
        }
        let mut readings = NewestReadings::default();
        if let Ok(mut writer) = ObservationWriter::resume(done.memory.memory(), &self.cameras) {
            let senses = lock(&self.senses);
            senses.write(&mut writer);
            for header in &done.headers {
                senses.write_pose_at_image(&mut writer, header);
            }
            if !self.sensors.is_empty() {
                readings = self.readings.newest();
                senses.write_readings(&mut writer, &self.sensors, &readings);
            }
        }
        let logged = self.log.as_ref().map(|log| {
            let bytes = done.memory.bytes();
            let sensors = LoggedSensors::of(bytes, &self.sensors, &readings);
            (log, observation_head(bytes).to_vec(), sensors)
        });
        // Notifies first: the plugin's reply must not arrive before the notification.
        notify(done.published.clone());
        let published_at = host_now();
        self.ipc.publish(done.memory)?;
        if let Some((log, head, sensors)) = logged {
            log.observation(published_at, done.published.seq, head, done.logged, sensors);
        }
        Ok(())
    }

    /// Returns the present size of an observation. [bytes]
    fn observation_len(&mut self) -> usize {
        let len = ObservationWriter::len_for(&self.cameras);
        if self.sensors.is_empty() {
            return len;
        }
        // A sensor that was changed in flight may have more records than announced.
        let newest = self.readings.newest();
        for (sensor, reading) in self.sensors.iter_mut().zip(newest.iter()) {
            let Some(reading) = reading else { continue };
            sensor.most_records = sensor.most_records.max(reading.header.record_count.get());
        }
        len + ObservationWriter::sensors_len(&self.sensors)
    }

    /// Discards a camera's image, and the observation if it contains and expects no other image.
    fn forget(&mut self, camera: usize) {
        if let Some(lane) = self.lanes.get_mut(camera) {
            lane.image = None;
        }
        let lanes = &self.lanes;
        let is_used = |under_way: &UnderWay| {
            let home = |lane: &Lane| lane.image.is_some() && lane.home == under_way.home;
            under_way.there != 0 || lanes.iter().any(home)
        };
        self.under_way.take_if(|under_way| !is_used(under_way));
    }

    fn reject(&mut self, why: &str) {
        self.rejected += 1;
        // Reports the first, and then each doubling.
        if self.rejected.is_power_of_two() {
            tracing::warn!("{} images dropped; last reason: {why}", self.rejected);
        }
    }
}

impl UnderWay {
    fn new(
        mut memory: LoanedObservation,
        seq: u64,
        home: u64,
        cameras: &[CameraInfo],
        tick: u64,
        together: u32,
    ) -> Result<Self, ObservationTooLarge> {
        ObservationWriter::new(memory.memory(), seq, cameras)?;
        let all = 1u8.unbounded_shl(cameras.len() as u32).wrapping_sub(1);
        let expected = if together as u8 & all == 0 { all } else { together as u8 & all };
        let published = Published {
            seq,
            tick,
            pose: HostTime::ZERO,
            received: HostTime::ZERO,
            ready: HostTime::ZERO,
            images: heapless::Vec::new(),
        };
        let (headers, logged) = (heapless::Vec::new(), Vec::new());
        Ok(Self { tick, home, memory, there: 0, expected, published, headers, logged })
    }
}

impl Lane {
    /// Decodes the undecoded pieces: first the bitstream's header, then slices.
    fn decode(&mut self, room: &mut ImageMut<'_>) -> Result<(), DecodeError> {
        while let Some(piece) = self.pieces.get(self.decoded) {
            if self.decoded == 0 {
                self.info = Some(self.decoder.start(piece)?);
            } else {
                self.decoder.push_slice(piece, room)?;
            }
            self.decoded += 1;
        }
        Ok(())
    }
}

/// Error of a step.
enum Fault {
    /// The image cannot be used: reason, and the count to increase.
    Image(String, fn(&mut Arrivals)),
    /// No memory is available.
    Ipc(IpcError),
}

impl Fault {
    fn image(why: &(impl ToString + ?Sized)) -> Self {
        Self::Image(why.to_string(), |counts| counts.broken += 1)
    }
}

impl From<IpcError> for Fault {
    fn from(error: IpcError) -> Self {
        Self::Ipc(error)
    }
}

impl From<DecodeError> for Fault {
    fn from(error: DecodeError) -> Self {
        Self::image(&error)
    }
}

impl From<ObservationTooLarge> for Fault {
    fn from(error: ObservationTooLarge) -> Self {
        Self::image(&error)
    }
}

fn bit(camera: usize) -> u8 {
    1u8.unbounded_shl(camera as u32)
}

#[cfg(test)]
mod tests;
