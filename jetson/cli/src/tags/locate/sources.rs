//! Image sources: one thread per live camera, newest image wins; recorded images one after the
//! other.
//!
//! A failed camera does not affect the others: its thread reopens it until it works again.

use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;
use vizflyt_process::lock;

use anyhow::{Context, Result, bail};
use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::HostTime;
use vizflyt_server::poses::drivers::json::PosePacket;
use vizflyt_tags::camera::TagCamera;
use vizflyt_tags::capture::{self, CameraWatch, CaptureError, Exposure, ImageSource, now_ns};
use vizflyt_tags::image::Gray;
use vizflyt_tags::locate::{LocateSetup, SIMULATED};
use vizflyt_tags::simulated::{SimulatedCamera, Truth};

/// An image of one camera.
#[derive(Clone, Debug)]
pub(super) struct CameraImage {
    /// Index of the camera.
    pub(super) camera: usize,
    /// Middle of the exposure.
    pub(super) stamp: HostTime,
    pub(super) image: Gray,
}

/// Sources of all cameras.
pub(super) struct Sources {
    mailbox: Arc<Mailbox>,
    truth: Option<(SocketAddr, Arc<SharedTruth>)>,
    /// Recordings, of which every image is located; empty if the cameras are live.
    recorded: Vec<Recording>,
    /// Last reported fault of each camera.
    told: Vec<Option<String>>,
}

/// A change of a camera's fault.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CameraEvent {
    /// Index of the camera.
    pub(super) camera: usize,
    /// Fault; `None` if the camera works again.
    pub(super) fault: Option<String>,
}

/// Recording of one camera: a folder or a video.
struct Recording {
    camera: TagCamera,
    source: Box<dyn ImageSource>,
    watch: CameraWatch,
    /// Next image; `None` at the end.
    head: Option<Exposure>,
}

/// Newest image of each camera that was not yet taken.
#[derive(Default)]
struct Mailbox {
    shots: Mutex<Vec<CameraImage>>,
    arrived: Condvar,
    /// One per live camera; empty if they are simulated.
    watches: Mutex<Vec<CameraWatch>>,
}

/// True poses, from which the simulated cameras render.
#[derive(Default)]
struct SharedTruth {
    truth: Mutex<Truth>,
    arrived: Condvar,
}

impl Sources {
    /// Opens all cameras of a setup.
    pub(super) fn open(
        setup: &LocateSetup,
        truth_at: SocketAddr,
        stop: &Arc<AtomicBool>,
    ) -> Result<Self> {
        let mut sources = Self {
            mailbox: Arc::new(Mailbox::default()),
            truth: None,
            recorded: Vec::new(),
            told: vec![None; setup.cameras.len()],
        };
        let is_simulated = |camera: &&TagCamera| camera.source.as_deref() == Some(SIMULATED);
        let simulated = setup.cameras.iter().filter(is_simulated).count();
        if simulated == setup.cameras.len() {
            sources.simulate(setup, truth_at, stop)?;
            return Ok(sources);
        }
        if simulated > 0 {
            bail!(
                "tags: {simulated} of {} cameras are simulated; use all or none",
                setup.cameras.len()
            );
        }
        let mut opened = Vec::new();
        for camera in &setup.cameras {
            let name = &camera.name;
            let Some(source) = &camera.source else {
                bail!(
                    "tags: camera {name:?} has no source; add it to its file, or give --source {name}=/dev/video0"
                );
            };
            let source = capture::open(source).with_context(|| format!("tags: camera {name:?}"))?;
            opened.push((camera, source));
        }
        let live = opened.iter().filter(|(_, source)| source.is_live()).count();
        if live == 0 {
            for (camera, mut source) in opened {
                let head = next_exposed(camera, source.as_mut())?;
                let watch = CameraWatch::new(head.as_ref().map_or(0, |head| head.stamp_ns));
                sources.recorded.push(Recording { camera: camera.clone(), source, watch, head });
            }
            return Ok(sources);
        }
        if live < opened.len() {
            bail!(
                "tags: {live} of {} cameras are live, the others recordings; use all or none",
                opened.len()
            );
        }
        *lock(&sources.mailbox.watches) = vec![CameraWatch::new(now_ns()); opened.len()];
        for (index, (camera, source)) in opened.into_iter().enumerate() {
            let (mailbox, stop) = (Arc::clone(&sources.mailbox), Arc::clone(stop));
            let camera = camera.clone();
            std::thread::spawn(move || read(index, &camera, source, &mailbox, &stop));
        }
        Ok(sources)
    }

    fn simulate(
        &mut self,
        setup: &LocateSetup,
        truth_at: SocketAddr,
        stop: &Arc<AtomicBool>,
    ) -> Result<()> {
        let (socket, shared) = listen(truth_at)?;
        let address = socket.local_addr().context("tags: the socket of the truth")?;
        spawn_listener(socket, Arc::clone(&shared), setup.object.clone(), Arc::clone(stop));
        let as_stated = (&setup.cameras, &setup.layouts);
        let (cameras, layouts) =
            setup.truth.as_ref().map_or(as_stated, |truth| (&truth.cameras, &truth.layouts));
        for (index, camera) in cameras.iter().enumerate() {
            let sensor = setup.simulated.sensor(index, cameras.len());
            let camera = SimulatedCamera::new(camera.clone(), sensor);
            let (shared, mailbox) = (Arc::clone(&shared), Arc::clone(&self.mailbox));
            let (layouts, stop) = (layouts.clone(), Arc::clone(stop));
            std::thread::spawn(move || {
                draw(index, camera, &layouts, &shared, &mailbox, &stop);
            });
        }
        self.truth = Some((address, shared));
        Ok(())
    }

    /// Returns the address for true poses, if a camera is simulated.
    pub(super) fn truth(&self) -> Option<SocketAddr> {
        self.truth.as_ref().map(|(address, _)| *address)
    }

    /// Returns the true pose at an instant, if known.
    pub(super) fn true_pose(&self, stamp: HostTime) -> Option<Pose<World, Body>> {
        let (_, shared) = self.truth.as_ref()?;
        lock(&shared.truth).at(stamp)
    }

    /// Whether stamps are on this computer's clock.
    pub(super) fn is_live(&self) -> bool {
        self.recorded.is_empty()
    }

    /// Returns the newest images sorted by stamp, or none after the timeout; `None` at the end of
    /// all sources.
    pub(super) fn next(&mut self, wait: Duration) -> Result<Option<Vec<CameraImage>>> {
        if !self.recorded.is_empty() {
            return self.next_recorded();
        }
        let shots = lock(&self.mailbox.shots);
        let (mut shots, _) = self
            .mailbox
            .arrived
            .wait_timeout_while(shots, wait, |shots| shots.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        let mut taken = std::mem::take(&mut *shots);
        drop(shots);
        // Without a reader thread there are no more images.
        if taken.is_empty() && Arc::strong_count(&self.mailbox) == 1 {
            return Ok(None);
        }
        taken.sort_by_key(|shot| shot.stamp);
        Ok(Some(taken))
    }

    /// Returns a change of a camera's fault: each fault is reported once, and its end once.
    pub(super) fn poll_event(&mut self) -> Option<CameraEvent> {
        let faults: Vec<Option<String>> = if self.recorded.is_empty() {
            let now_ns = now_ns();
            lock(&self.mailbox.watches).iter().map(|watch| watch.fault(now_ns)).collect()
        } else {
            // Recordings have no delay.
            let fault = |recording: &Recording| recording.watch.fault(0);
            self.recorded.iter().map(fault).collect()
        };
        for (camera, (fault, told)) in faults.into_iter().zip(&mut self.told).enumerate() {
            // A longer duration of the same fault is not a change.
            let words = |fault: &Option<String>| {
                fault.as_ref().map(|text| text.split(" for ").next().unwrap_or("").to_owned())
            };
            if words(&fault) != words(told) {
                told.clone_from(&fault);
                return Some(CameraEvent { camera, fault });
            }
        }
        None
    }

    /// Returns the earliest images of the recordings; those of one instant together.
    fn next_recorded(&mut self) -> Result<Option<Vec<CameraImage>>> {
        let heads = self.recorded.iter().filter_map(|r| r.head.as_ref());
        let Some(first) = heads.map(|head| head.stamp_ns).min() else { return Ok(None) };
        let mut shots = Vec::new();
        for (camera, recording) in self.recorded.iter_mut().enumerate() {
            let due = |head: &Exposure| head.stamp_ns - first <= TOGETHER_NS;
            if recording.head.as_ref().is_some_and(due)
                && let Some(Exposure { stamp_ns, image }) = recording.head.take()
            {
                check_size(&recording.camera, &image).map_err(anyhow::Error::msg)?;
                if recording.watch.handle_image(stamp_ns, &image) {
                    shots.push(CameraImage { camera, stamp: HostTime::from_ns(stamp_ns), image });
                }
                recording.head = next_exposed(&recording.camera, recording.source.as_mut())?;
            }
        }
        shots.sort_by_key(|shot| shot.stamp);
        Ok(Some(shots))
    }
}

impl Mailbox {
    fn put(&self, shot: CameraImage) {
        let mut shots = lock(&self.shots);
        shots.retain(|kept| kept.camera != shot.camera);
        shots.push(shot);
        self.arrived.notify_one();
    }
}

/// Reads one live camera until stopped; reopens it after an error.
fn read(
    index: usize,
    camera: &TagCamera,
    source: Box<dyn ImageSource>,
    mailbox: &Mailbox,
    stop: &AtomicBool,
) {
    let mut source = Some(source);
    while !stop.load(Ordering::Relaxed) {
        let next = match &mut source {
            Some(source) => {
                next_exposed(camera, source.as_mut()).map_err(|error| error.to_string())
            }
            None => Err(String::new()),
        };
        let ended = match next {
            Ok(Some(Exposure { stamp_ns, image })) => match check_size(camera, &image) {
                Ok(()) => {
                    let is_fit = lock(&mailbox.watches)[index].handle_image(now_ns(), &image);
                    if is_fit {
                        let stamp = HostTime::from_ns(stamp_ns);
                        mailbox.put(CameraImage { camera: index, stamp, image });
                    }
                    continue;
                }
                Err(why) => why,
            },
            Ok(None) => "its images ended".into(),
            Err(why) => why,
        };
        if source.take().is_some() {
            lock(&mailbox.watches)[index].handle_end(ended);
        }
        // Standard input cannot be reopened.
        let Some(name) = camera.source.as_deref().filter(|name| *name != "-") else { return };
        std::thread::sleep(OPEN_AGAIN);
        source = capture::open(name).ok();
    }
}

/// Returns the next image of a source; its stamp is corrected by the camera's known delay.
fn next_exposed(
    camera: &TagCamera,
    source: &mut dyn ImageSource,
) -> Result<Option<Exposure>, CaptureError> {
    let late_ns = (1e6 * camera.latency_ms) as u64;
    let next = source.next()?;
    Ok(next.map(|next| Exposure { stamp_ns: next.stamp_ns.saturating_sub(late_ns), ..next }))
}

/// Images of another size than that of the calibration would be located incorrectly.
fn check_size(camera: &TagCamera, image: &Gray) -> Result<(), String> {
    let (width, height) = (camera.intrinsics.width_px, camera.intrinsics.height_px);
    if (image.width_px(), image.height_px()) != (width, height) {
        return Err(format!(
            "camera {:?} gives images of {}x{}, its file is for {width}x{height}; set the camera to \
             that size, or calibrate it in this one",
            camera.name,
            image.width_px(),
            image.height_px()
        ));
    }
    Ok(())
}

fn listen(at: SocketAddr) -> Result<(UdpSocket, Arc<SharedTruth>)> {
    let socket = UdpSocket::bind(at).with_context(|| {
        format!("tags: cannot listen for the truth at {at}; is the port taken?")
    })?;
    socket.set_read_timeout(Some(LOOK_AT_STOP)).context("tags: the socket of the truth")?;
    Ok((socket, Arc::new(SharedTruth::default())))
}

fn spawn_listener(
    socket: UdpSocket,
    shared: Arc<SharedTruth>,
    object: String,
    stop: Arc<AtomicBool>,
) {
    std::thread::spawn(move || {
        let mut bytes = [0; 2048];
        while !stop.load(Ordering::Relaxed) {
            let Ok(length) = socket.recv(&mut bytes) else { continue };
            let Ok(packet) = PosePacket::parse(&bytes[..length]) else { continue };
            let Some(stamp_ns) = packet.stamp_ns else { continue };
            if packet.object != object {
                continue;
            }
            let pose = Pose::new(
                DVec3::from_array(packet.position_m),
                DQuat::from_array(packet.rotation_xyzw).normalize(),
            );
            lock(&shared.truth).push(HostTime::from_ns(stamp_ns), pose);
            shared.arrived.notify_all();
        }
    });
}

/// Renders the images of one camera until stopped.
fn draw(
    index: usize,
    mut camera: SimulatedCamera,
    layouts: &[vizflyt_tags::layout::TagLayout],
    shared: &SharedTruth,
    mailbox: &Mailbox,
    stop: &AtomicBool,
) {
    while !stop.load(Ordering::Relaxed) {
        let mut known = Truth::default();
        {
            let truth = lock(&shared.truth);
            let (truth, waited) = shared
                .arrived
                .wait_timeout_while(truth, LOOK_AT_STOP, |truth| camera.due(truth).is_none())
                .unwrap_or_else(PoisonError::into_inner);
            if waited.timed_out() {
                continue;
            }
            // Rendering is slow; poses arrive meanwhile.
            known.clone_from(&truth);
        }
        if let Some((stamp, image)) = camera.expose(&known, layouts, true) {
            mailbox.put(CameraImage { camera: index, stamp, image });
        }
    }
}

/// Maximum interval between recorded images that were exposed together.
const TOGETHER_NS: u64 = 2_000_000;
/// Period of attempts to reopen a camera.
const OPEN_AGAIN: Duration = Duration::from_millis(500);
/// Period at which threads check the stop flag.
const LOOK_AT_STOP: Duration = Duration::from_millis(100);
