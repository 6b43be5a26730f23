//! The vehicle's gyroscope over MAVLink, read by a thread beside the poses.
//!
//! Each reading bears the time at which it was measured, on this computer's clock: by the autopilot's own clock,
//! which the link relates to ours (TIMESYNC), else when it came.

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

/// What has come.
#[derive(Clone, Debug, Default)]
pub(super) struct Heard {
    /// Readings since the last look: when [s, CLOCK_MONOTONIC], and the angular velocity [rad/s, body].
    pub(super) readings: Vec<(f64, DVec3)>,
    /// Whether an autopilot's heartbeats come.
    pub(super) is_connected: bool,
    /// How far the times may be off; `None` where the autopilot's clock is not known, and a reading is as old as its
    /// arrival. [ms]
    pub(super) clock_off_ms: Option<f64>,
    /// The autopilot's clock became known since the last look: earlier readings have other times.
    pub(super) began_anew: bool,
}

/// The thread.
#[derive(Debug)]
pub(super) struct Gyro {
    heard: Arc<Mutex<Heard>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Gyro {
    /// Opens the link and begins to listen.
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

    /// Takes what has come since the last time.
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
            // A thread that panicked has reported it on standard error.
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
        // A failed socket receives nothing, as an autopilot that is off.
        if let Ok(Some(len)) = port.receive(&mut buffer) {
            link.handle_input(host_now(), &buffer[..len]);
        }
        // Nobody reads what happens on the link.
        while link.poll_event().is_some() {}
        let clock_off_ms = link.clock().error_bound_ns(host_now()).map(|ns| ns as f64 * 1e-6);
        let mut heard = lock(heard);
        heard.is_connected = link.is_connected();
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
        // An autopilot that sends no IMU sends its attitude's rates.
        if let Some(stamp) = link.attitude_at().filter(|_| link.imu().is_empty()) {
            take(stamp, link.state().omega_body_radps);
        }
    }
}

/// Readings that wait at most: ten seconds at 400 Hz.
const MAX_READINGS: usize = 4000;
