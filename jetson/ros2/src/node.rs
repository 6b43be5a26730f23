//! A flight as a ROS 2 node: a plugin that sends observations and flies received commands.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use vizflyt_rgbd::encode_jpeg;
use vizflyt_sdk::{
    ArenaInfo, Autonomy, Body, Cam, Event, HostTime, Intrinsics, Observation, Pose, Sensor,
    SensorKind, Setpoint, host_now,
};

use crate::Ros2Args;
use crate::convert::{self, DepthEncoding, Frames, Rays, RosClock};
use crate::dds::{Dds, Inbox};
use crate::messages::{
    CompressedImage, Empty, Header, Message, Path, TfMessage, Time, TwistStamped,
};
use crate::setpoint::{Commands, Reported};
use crate::topics::{self, Topic};

/// Participants of the node, which a signal removes. There are two, because a participant sends and receives on a
/// single thread: a command never waits for an image.
#[derive(Default)]
pub(crate) struct Participants {
    /// Commands, poses, frames, IMU.
    state: Mutex<Option<Dds>>,
    /// Images and points.
    images: Mutex<Option<Dds>>,
}

impl Participants {
    /// Joins the domain with both participants.
    pub(crate) fn join(&self, join: impl Fn() -> Result<Dds>) -> Result<()> {
        *lock(&self.state) = Some(join()?);
        *lock(&self.images) = Some(join()?);
        Ok(())
    }

    /// Leaves the domain after the last message. A participant's goodbye is one packet, which may be lost, and RustDDS
    /// does not send it if images are still queued when it ends; subscribers then keep the node for 50 s. Therefore the
    /// topics are withdrawn first, by writers that repeat unacknowledged messages for a while.
    pub(crate) fn leave(&self) {
        let mut left = [lock(&self.state).take(), lock(&self.images).take()];
        thread::sleep(LAST_IMAGE);
        left.iter_mut().flatten().for_each(Dds::withdraw);
        thread::sleep(GOODBYE);
        drop(left);
    }
}

fn lock(dds: &Mutex<Option<Dds>>) -> MutexGuard<'_, Option<Dds>> {
    dds.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Quality of JPEG, the default of image_transport.
const JPEG_QUALITY: u8 = 95;
/// Maximum time to send the last image.
const LAST_IMAGE: Duration = Duration::from_millis(100);
/// Time to send and repeat the withdrawal of topics. RustDDS sends it after the queued images, two per topic. Clouds of
/// 5 MB take 0.1 s each on an idle processor.
const GOODBYE: Duration = Duration::from_millis(900);
/// Maximum number of queued images; further ones are dropped.
const WAITING_IMAGES: usize = 4;
const CAMERA_TOPICS: [Topic; 6] = [
    topics::IMAGE,
    topics::COMPRESSED,
    topics::CAMERA_INFO,
    topics::DEPTH,
    topics::DEPTH_INFO,
    topics::DEPTH_POINTS,
];

/// State of the node, kept from flight to flight.
pub(crate) struct Node {
    dds: Arc<Participants>,
    frames: Frames,
    path_speed_mps: f64,
    velocities: Inbox,
    paths: Inbox,
    landings: Inbox,
    commands: Commands,
    reported: Reported,
    clock: RosClock,
    images: SyncSender<Shot>,
    cameras: Vec<Source<Cam>>,
    sensors: Vec<Source<Sensor>>,
    /// Stamp of the newest state of the vehicle that was sent.
    sent_vehicle: HostTime,
    has_flown: bool,
}

/// A camera or a sensor of this flight.
struct Source<F> {
    name: String,
    mounting: Pose<Body, F>,
    /// Number of its newest image or reading that was sent.
    sent: u64,
}

/// An image in the queue.
struct Shot {
    camera: String,
    stamp: Time,
    intrinsics: Intrinsics,
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
}

impl Node {
    /// Announces the topics that every vehicle has, and subscribes to commands.
    pub(crate) fn new(args: &Ros2Args, dds: &Arc<Participants>) -> Result<Self> {
        let frames = Frames::new(&args.frame_prefix);
        let (images, waiting) = sync_channel(WAITING_IMAGES);
        let sender = Sender {
            dds: Arc::clone(dds),
            frames: frames.clone(),
            depth: args.depth,
            rays: Rays::default(),
        };
        thread::Builder::new()
            .name("images".to_owned())
            .spawn(move || sender.run(&waiting))
            .context("cannot start a thread")?;
        let mut guard = lock(&dds.state);
        let open = guard.as_mut().context("the node has ended")?;
        for topic in [topics::IMU, topics::POSE, topics::ODOMETRY, topics::TF, topics::TF_STATIC] {
            open.announce(&topic, "")?;
        }
        Ok(Self {
            frames,
            path_speed_mps: args.path_speed,
            velocities: open.subscribe(&topics::VELOCITY)?,
            paths: open.subscribe(&topics::PATH)?,
            landings: open.subscribe(&topics::LAND)?,
            commands: Commands::default(),
            reported: Reported::default(),
            clock: RosClock::default(),
            images,
            cameras: Vec::new(),
            sensors: Vec::new(),
            sent_vehicle: HostTime::ZERO,
            has_flown: false,
            dds: Arc::clone(dds),
        })
    }

    /// Returns whether a flight has begun with this node.
    pub(crate) fn has_flown(&self) -> bool {
        self.has_flown
    }

    fn begin(&mut self, info: &ArenaInfo) -> Result<()> {
        self.has_flown = true;
        self.commands.clear();
        self.relate_clocks();
        self.sent_vehicle = HostTime::ZERO;
        let cameras = info.cameras.iter();
        self.cameras = cameras.map(|camera| source(&camera.name, camera.body_from_cam)).collect();
        let sensors = info.sensors.iter();
        self.sensors = sensors.map(|it| source(&it.name, it.body_from_sensor)).collect();
        if let Some(images) = lock(&self.dds.images).as_mut() {
            for camera in &self.cameras {
                for topic in &CAMERA_TOPICS {
                    images.announce(topic, &camera.name)?;
                }
            }
            for lidar in info.sensors.iter().filter(|sensor| sensor.kind == SensorKind::Lidar) {
                images.announce(&topics::LIDAR, &lidar.name)?;
            }
        }
        if let Some(state) = lock(&self.dds.state).as_ref() {
            self.send_mountings(state);
        }
        Ok(())
    }

    /// Sends all fixed transforms in one message, because late subscribers receive only the newest message.
    fn send_mountings(&self, dds: &Dds) {
        let (stamp, frames) = (self.clock.time(host_now()), &self.frames);
        let mut transforms = vec![convert::odom_in_map(stamp, frames)];
        transforms.extend(self.cameras.iter().map(|camera| {
            convert::mounted(stamp, frames, frames.optical(&camera.name), &camera.mounting)
        }));
        transforms.extend(self.sensors.iter().map(|sensor| {
            convert::mounted(stamp, frames, frames.sensor(&sensor.name), &sensor.mounting)
        }));
        dds.send(&topics::TF_STATIC, "", &TfMessage { transforms });
    }

    fn relate_clocks(&mut self) {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.clock.relate(since.as_nanos() as i64, host_now());
    }

    fn send(&mut self, obs: &Observation<'_>) {
        let dds = Arc::clone(&self.dds);
        let mut state = lock(&dds.state);
        let Some(state) = state.as_mut() else { return };
        state.count_subscribers();
        self.send_state(obs, state);
        let mut images = lock(&dds.images);
        let Some(images) = images.as_mut() else { return };
        images.count_subscribers();
        self.send_images(obs, images, state);
    }

    fn send_images(&mut self, obs: &Observation<'_>, images: &Dds, state: &Dds) {
        let (mut moved, mut remounted) = (None, false);
        for camera in obs.cameras() {
            let known = self.cameras.iter_mut().find(|known| known.name == camera.name);
            let Some(known) = known.filter(|known| camera.seq > known.sent) else { continue };
            known.sent = camera.seq;
            if known.mounting != camera.body_from_cam {
                (known.mounting, remounted) = (camera.body_from_cam, true);
            }
            let stamp = self.clock.time(camera.shown);
            // Cameras of one tick show the same instant.
            if let Some(pose) = camera.pose_at_image.filter(|_| moved != Some(stamp)) {
                moved = Some(stamp);
                let transforms = convert::moving(stamp, &self.frames, &pose).to_vec();
                state.send(&topics::TF, "", &TfMessage { transforms });
            }
            if CAMERA_TOPICS.iter().any(|topic| images.is_wanted(topic, camera.name)) {
                let shot = Shot {
                    camera: camera.name.to_owned(),
                    stamp,
                    intrinsics: camera.intrinsics,
                    rgb: camera.rgb.to_vec(),
                    depth_mm: camera.depth_mm.to_vec(),
                };
                if self.images.try_send(shot).is_err() {
                    tracing::debug!("{}: an image was left out", camera.name);
                }
            }
        }
        if remounted {
            self.send_mountings(state);
        }
        for reading in obs.sensors().filter(|reading| reading.kind == SensorKind::Lidar) {
            let known = self.sensors.iter_mut().find(|known| known.name == reading.name);
            let Some(known) = known.filter(|known| reading.seq > known.sent) else { continue };
            known.sent = reading.seq;
            let stamp = self.clock.time(reading.shown);
            let header = Header { stamp, frame_id: self.frames.sensor(reading.name) };
            let cloud = convert::lidar_points(header, reading.points());
            images.send(&topics::LIDAR, reading.name, &cloud);
        }
    }

    fn send_state(&mut self, obs: &Observation<'_>, state: &Dds) {
        for sample in obs.imu() {
            state.send(&topics::IMU, "", &convert::imu(self.clock, &self.frames, &sample));
        }
        let vehicle = obs.vehicle().filter(|vehicle| vehicle.stamp > self.sent_vehicle);
        if let Some(vehicle) = vehicle {
            self.sent_vehicle = vehicle.stamp;
            let known = convert::pose_and_odometry(self.clock, &self.frames, &vehicle);
            if let Some((pose, odometry)) = known {
                state.send(&topics::POSE, "", &pose);
                state.send(&topics::ODOMETRY, "", &odometry);
            }
        }
    }

    /// Processes the commands since the last image, oldest first.
    fn receive(&mut self, now: HostTime) {
        while let Some(found) = self.velocities.next::<TwistStamped>() {
            let taken = found.map_err(|error| error.to_string()).and_then(|(twist, age_ns)| {
                self.commands
                    .velocity(&self.frames, &twist, age_ns, now.as_ns())
                    .map_err(|error| error.to_string())
            });
            report(&mut self.reported, &self.velocities.name, taken);
        }
        while let Some(found) = self.paths.next::<Path>() {
            let taken = found.map_err(|error| error.to_string()).and_then(|(path, _)| {
                self.commands
                    .path(&self.frames, &path, self.path_speed_mps)
                    .map_err(|error| error.to_string())
            });
            report(&mut self.reported, &self.paths.name, taken);
        }
        while let Some(found) = self.landings.next::<Empty>() {
            if found.is_ok() {
                tracing::info!("{}: landing", self.landings.name);
                self.commands.land();
            }
        }
    }
}

fn source<F>(name: &str, mounting: Pose<Body, F>) -> Source<F> {
    Source { name: name.to_owned(), mounting, sent: 0 }
}

fn report(reported: &mut Reported, name: &str, taken: Result<(), String>) {
    if let Err(fault) = taken
        && let Some(sentence) = reported.news(name, fault)
    {
        tracing::error!("{sentence}");
    }
}

/// One flight of a node. The runtime uses the name of this type as the plugin's name.
pub(crate) struct Ros2<'n>(pub(crate) &'n mut Node);

impl Autonomy for Ros2<'_> {
    fn on_start(&mut self, info: &ArenaInfo) {
        let Self(node) = self;
        // Discard commands that were sent before this flight.
        node.receive(host_now());
        if let Err(error) = node.begin(info) {
            tracing::error!("{error:#}");
        }
        tracing::info!("'{}': a flight begins", info.name);
    }

    fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint> {
        let Self(node) = self;
        node.relate_clocks();
        node.send(obs);
        let now = host_now();
        node.receive(now);
        Some(node.commands.setpoint(now.as_ns()))
    }

    fn on_event(&mut self, event: &Event) {
        tracing::debug!("{event:?}");
    }

    fn on_stop(&mut self) {
        tracing::info!("the flight is over");
    }
}

/// Encodes and sends images on a separate thread, so that setpoints do not wait for them.
struct Sender {
    dds: Arc<Participants>,
    frames: Frames,
    depth: DepthEncoding,
    rays: Rays,
}

impl Sender {
    fn run(mut self, waiting: &Receiver<Shot>) {
        for shot in waiting {
            // Calibration first, so that subscribers that pair both by stamp do not wait.
            let info = convert::camera_info(self.header(&shot), &shot.intrinsics);
            self.send(&topics::CAMERA_INFO, &shot, || Some(&info));
            self.send(&topics::DEPTH_INFO, &shot, || Some(&info));
            self.send(&topics::IMAGE, &shot, || {
                Some(convert::image(self.header(&shot), &shot.intrinsics, &shot.rgb))
            });
            self.send(&topics::DEPTH, &shot, || {
                let header = self.header(&shot);
                Some(convert::depth(header, &shot.intrinsics, &shot.depth_mm, self.depth))
            });
            self.send(&topics::COMPRESSED, &shot, || {
                let data = jpeg(&shot.rgb, &shot.intrinsics)?;
                Some(CompressedImage { header: self.header(&shot), format: "jpeg", data })
            });
            let mut rays = std::mem::take(&mut self.rays);
            self.send(&topics::DEPTH_POINTS, &shot, || {
                let (header, camera) = (self.header(&shot), &shot.intrinsics);
                Some(convert::depth_points(header, camera, &mut rays, &shot.rgb, &shot.depth_mm))
            });
            self.rays = rays;
        }
    }

    fn header(&self, shot: &Shot) -> Header {
        convert::optical_header(shot.stamp, &self.frames, &shot.camera)
    }

    /// Creates and sends a message if there is a subscriber. The lock is free while the message is created.
    fn send<M: Message>(&self, topic: &Topic, shot: &Shot, make: impl FnOnce() -> Option<M>) {
        let images = || lock(&self.dds.images);
        if !images().as_ref().is_some_and(|dds| dds.is_wanted(topic, &shot.camera)) {
            return;
        }
        let Some(message) = make() else { return };
        let bytes = message.encode();
        if let Some(dds) = images().as_ref() {
            dds.send_encoded(topic, &shot.camera, bytes);
        }
    }
}

/// Returns an image as a JPEG file.
fn jpeg(rgb: &[u8], intrinsics: &Intrinsics) -> Option<Vec<u8>> {
    let mut file = Vec::new();
    encode_jpeg(rgb, intrinsics.width_px, intrinsics.height_px, JPEG_QUALITY, &mut file).ok()?;
    Some(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jpeg_keeps_size_and_colour() {
        let intrinsics = Intrinsics::from_horizontal_fov(16, 8, 1.0);
        let file = jpeg(&[99; 16 * 8 * 3], &intrinsics).unwrap();
        let mut decoder = zune_jpeg::JpegDecoder::new(std::io::Cursor::new(&file));
        let pixels = decoder.decode().unwrap();
        assert_eq!(decoder.dimensions(), Some((16, 8)));
        assert!(pixels.iter().all(|value| value.abs_diff(99) < 3));
        assert!(jpeg(&[0; 3], &intrinsics).is_none());
    }
}
