//! From the mailbox to the plugin: decodes each image, slice by slice as it arrives, straight into
//! shared memory.
//!
//! Budget at 640x480: 1.5 MB written once (JPEG and depth about 1.8 ms in four slices, of which the
//! first three overlap with receiving), no copy afterwards, no allocation of ours but for the log's
//! record: the pieces of an image go there when it is published, and their memory comes back. One
//! thread of its own: a slow decode holds up neither poses nor events. Several cameras of one tick share one
//! observation; it is published when all that were sent together have come, or when a later tick's
//! image has come whole.
//!
//! An image that is never finished (cut off, late, nonsense, given way to a newer one: see
//! [`crate::stream::Mailbox`]) leaves its pixels in memory that no plugin sees: only a camera that
//! is declared ready has a size. An image whose observation is published before it is finished is
//! decoded again, from the pieces that have come, into the next one.
//!
//! Cameras may change while flying: each image carries the camera it was rendered with, and so does the
//! observation that holds it. The plugin never sees an image with another one's intrinsics.
//!
//! The newest readings of the other sensors are copied behind the images as the observation is published; a vehicle
//! without such sensors pays nothing.

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

/// The control loop writes them, the image publisher reads them.
pub type SharedSenses = Arc<Mutex<Senses>>;

/// An observation that went to the plugin.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Published {
    /// Its number, from 1.
    pub seq: u64,
    /// The server's tick of its newest image.
    pub tick: u64,
    /// When the pose of its newest image was measured. [host]
    pub pose: HostTime,
    /// When the last byte of its newest image had been received. [host]
    pub received: HostTime,
    /// When it was decoded. [host]
    pub ready: HostTime,
    /// Its images on their way.
    pub images: heapless::Vec<Stamps, MAX_CAMERAS>,
}

/// Decodes and publishes. See the module.
pub struct ImagePublisher {
    ipc: Arc<RuntimeEnd>,
    cameras: Vec<CameraInfo>,
    senses: SharedSenses,
    lanes: Vec<Lane>,
    seq: u64,
    /// Counts memory lent.
    homes: u64,
    under_way: Option<UnderWay>,
    rejected: u64,
    log: Option<ImageLog>,
    sensors: Vec<SensorInfo>,
    readings: Arc<Readings>,
}

/// One camera's decoder and the image it is at.
#[derive(Default)]
struct Lane {
    decoder: Decoder,
    image: Option<Arrival>,
    /// The pieces of the image that have come.
    pieces: Vec<Vec<u8>>,
    /// How many of them were decoded.
    decoded: usize,
    /// Into which memory.
    home: u64,
    info: Option<Info>,
    /// Tick of the newest image that was decoded, and the stamp of its pose.
    newest: (u64, HostTime),
}

/// An observation that waits for more cameras.
struct UnderWay {
    tick: u64,
    home: u64,
    memory: LoanedObservation,
    /// Bit per camera.
    there: u8,
    /// Bit per camera that the server sends together with the first one.
    expected: u8,
    published: Published,
    /// Of the images that are there.
    headers: heapless::Vec<ImageHeader, MAX_CAMERAS>,
    /// For the log; empty without one.
    logged: Vec<LoggedImage>,
}

impl UnderWay {
    /// Whether an image is of a later tick, or its camera's next: then this observation has waited
    /// long enough. An earlier tick's image of another camera, overtaken on its way, comes along.
    fn is_over(&self, tick: u64, bit: u8) -> bool {
        tick > self.tick || self.there & bit != 0
    }
}

impl ImagePublisher {
    /// Makes one for these cameras (at most 8); an image's own description of its camera replaces them later.
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

    /// Puts the newest of `readings` of these sensors (at most 8) into what it publishes.
    pub fn with_sensors(self, sensors: Vec<SensorInfo>, readings: Arc<Readings>) -> Self {
        Self { sensors, readings, ..self }
    }

    /// Logs what it publishes.
    pub fn with_log(self, log: Option<ImageLog>) -> Self {
        Self { log, ..self }
    }

    /// Runs until `stop` returns true; `notify` is called before each observation is published.
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

    /// Waits at most `timeout` for the next thing to do, and does it; returns whether there was
    /// one.
    ///
    /// # Errors
    /// [`IpcError`] if there is no memory; the image is lost.
    pub fn step(
        &mut self,
        mailbox: &Mailbox,
        timeout: Duration,
        notify: &mut impl FnMut(Published),
    ) -> Result<bool, IpcError> {
        // An image that would end the observation under way waits until it has come whole.
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
        let lane = lane.ok_or_else(|| Fault::image("it is of no camera of this arena"))?;
        // A server that restarted counts from the start again, but its poses are newer.
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
        // One image of each camera at most, so there is room.
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

    /// Decodes what has come of a camera's image, and was not, into the observation under way.
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

    /// Takes over the camera that the image was rendered with. Another size re-allocates memory,
    /// and what this tick's observation has already moves there.
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
        // Told first: the answer must not overtake it.
        notify(done.published.clone());
        let published_at = host_now();
        self.ipc.publish(done.memory)?;
        if let Some((log, head, sensors)) = logged {
            log.observation(published_at, done.published.seq, head, done.logged, sensors);
        }
        Ok(())
    }

    /// Returns how many bytes an observation takes now. [bytes]
    fn observation_len(&mut self) -> usize {
        let len = ObservationWriter::len_for(&self.cameras);
        if self.sensors.is_empty() {
            return len;
        }
        // A sensor that was changed in flight may see more than it was announced to.
        let newest = self.readings.newest();
        for (sensor, reading) in self.sensors.iter_mut().zip(newest.iter()) {
            let Some(reading) = reading else { continue };
            sensor.most_records = sensor.most_records.max(reading.header.record_count.get());
        }
        len + ObservationWriter::sensors_len(&self.sensors)
    }

    /// Gives up a camera's image, and the observation if nothing else is or will be in it.
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
        // The first, then ever fewer.
        if self.rejected.is_power_of_two() {
            tracing::warn!("{} images dropped so far; the last because {why}", self.rejected);
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
    /// Decodes the pieces that were not: the bitstream's header first, then slices.
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

/// Why a step came to nothing.
enum Fault {
    /// The image is of no use, and as what it counts.
    Image(String, fn(&mut Arrivals)),
    /// There is no memory.
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
