//! Readings of the vehicle's gyroscope over MAVLink, received by a separate thread.
//!
//! Each reading has its time of measurement on this computer's clock: from the autopilot's clock,
//! which the link relates to this computer's (TIMESYNC), otherwise the time of arrival.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use vizflyt_process::lock;

use anyhow::{Context, Result};
use glam::DVec3;
use vizflyt_guardian::port::{MavlinkAddress, Port};
use vizflyt_protocol::time::HostTime;
use vizflyt_runtime::link::{Link, LinkSettings};
use vizflyt_sdk::host_now;

/// Data received since the last `take`.
#[derive(Clone, Debug, Default)]
pub(super) struct Heard {
    /// New readings: time [s, CLOCK_MONOTONIC] and angular velocity [rad/s, body].
    pub(super) readings: Vec<(f64, DVec3)>,
    /// Whether heartbeats of an autopilot arrive.
    pub(super) is_connected: bool,
    /// Why the vehicle on the link cannot be used: no multirotor, or several.
    pub(super) wrong_vehicle: Option<String>,
    /// Error bound of the times; `None` if the autopilot's clock is unknown and times of arrival
    /// are used. [ms]
    pub(super) clock_off_ms: Option<f64>,
    /// Whether the autopilot's clock became known since the last `take`: earlier readings have
    /// other times.
    pub(super) began_anew: bool,
}

/// Receiver thread.
#[derive(Debug)]
pub(super) struct Gyro {
    heard: Arc<Mutex<Heard>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Gyro {
    /// Opens the link and starts the thread.
    pub(super) fn open(address: &MavlinkAddress, settings: LinkSettings) -> Result<Self> {
        let port = Port::open(address, settings.wanted())
            .with_context(|| format!("{address} cannot be opened"))?;
        let heard = Arc::new(Mutex::new(Heard::default()));
        let stop = Arc::new(AtomicBool::new(false));
        let link = Link::with(host_now(), settings);
        let shared = (heard.clone(), stop.clone());
        let thread = std::thread::Builder::new()
            .name("gyro".to_owned())
            .spawn(move || listen(&port, link, &shared.0, &shared.1))
            .context("cannot start the gyroscope's thread")?;
        Ok(Self { heard, stop, thread: Some(thread) })
    }

    /// Returns the data received since the last call.
    pub(super) fn take(&self) -> Heard {
        let mut heard = lock(&self.heard);
        let taken = heard.clone();
        heard.readings.clear();
        heard.began_anew = false;
        taken
    }
}

impl Drop for Gyro {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been printed on standard error already.
            let _ = thread.join();
        }
    }
}

fn listen(port: &Port, mut link: Link, heard: &Mutex<Heard>, stop: &AtomicBool) {
    let mut buffer = [0; 2048];
    let mut newest = HostTime::ZERO;
    let mut is_timed = false;
    while !stop.load(Ordering::Relaxed) {
        link.handle_timeout(host_now());
        while let Some(datagram) = link.poll_transmit() {
            port.send(&datagram);
        }
        // A failed socket receives nothing, like an autopilot that is off.
        if let Ok(Some(len)) = port.receive(&mut buffer) {
            link.handle_input(host_now(), &buffer[..len]);
        }
        // Events of the link are not used.
        while link.poll_event().is_some() {}
        let clock_off_ms = link.clock().error_bound_ns(host_now()).map(|ns| ns as f64 * 1e-6);
        let mut heard = lock(heard);
        heard.is_connected = link.is_connected();
        let now = host_now();
        heard.wrong_vehicle = link.several(now).or_else(|| link.wrong_vehicle(now));
        if clock_off_ms.is_some() && !is_timed {
            is_timed = true;
            heard.began_anew = true;
            heard.readings.clear();
            newest = link.imu().back().map_or(newest, |sample| sample.stamp).max(newest);
        }
        heard.clock_off_ms = clock_off_ms;
        let mut take = |stamp: HostTime, rate_radps: DVec3| {
            if stamp > newest && heard.readings.len() < MAX_READINGS {
                newest = stamp;
                heard.readings.push((stamp.as_ns() as f64 * 1e-9, rate_radps));
            }
        };
        for sample in link.imu() {
            take(sample.stamp, sample.gyro_radps);
        }
        // If the autopilot sends no IMU data, use the rates of its attitude.
        if let Some(stamp) = link.attitude_at().filter(|_| link.imu().is_empty()) {
            take(stamp, link.state().omega_body_radps);
        }
    }
}

/// Maximum number of waiting readings: ten seconds at 400 Hz.
const MAX_READINGS: usize = 4000;
