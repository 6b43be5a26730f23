//! Simulated autopilot that behaves like ArduCopter in a lab with external navigation and without radio control:
//! MAVLink bytes and sensor samples in, MAVLink bytes and motor commands out. Sans-IO: no sockets, no clock.
//!
//! - [`Autopilot::handle_sensors`], 400 Hz: estimate -> mode -> control -> motors ([`flight`]).
//! - [`Autopilot::handle_input`]: bytes of the link -> signature check, if a key is set ([`signing`]) -> messages ->
//!   commands ([`commands`]). Fence polygons use the mission protocol ([`mission`]).
//! - [`Autopilot::handle_timeout`]: heartbeats, streams, failsafes ([`telemetry`], [`failsafe`]).
//! - [`Autopilot::poll_transmit`]: bytes for the link.
//!
//! The observed behaviour of a real ArduCopter 4.8 is reproduced, including its pitfalls: it arms without an origin but
//! refuses take-off; an ignored yaw turns the nose into the direction of travel; a velocity setpoint expires after 3 s;
//! lost vision is detected only after seven seconds. `tests/pitfalls.rs` has one test for each pitfall. Texts of fence
//! and reboot are similar, not identical.

// Why: real ground stations still send messages that are deprecated in the dialect.
#![allow(deprecated)]

mod arming;
mod commands;
mod failsafe;
mod flight;
mod mission;
mod params;
mod setpoints;
mod signing;
mod streams;
mod telemetry;
#[cfg(test)]
mod tests;
mod vibration;

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::mavlink::{
    CopterMode, GuidedSetpoint, MAX_PACKET, MavHeader, StreamDecoder, dialect, encode,
};
use vizflyt_protocol::time::AutopilotTime;

use crate::control::attitude::{AttitudeController, Heading};
use crate::control::position::PositionController;
use crate::estimator::Estimator;
use crate::imu::SensorSample;
use crate::startup::Startup;
use dialect::{MavMessage, MavSeverity};
pub use flight::airframe_limits;
pub use params::{Param, ParamSpec, Params, TABLE, airframe};
use streams::Streams;

/// Maximum number of links; each is a separate stream of bytes, like a telemetry port.
pub const MAX_LINKS: usize = 4;
/// Maximum number of queued messages. A full parameter list fits; beyond it, the oldest message is dropped.
const OUTBOX: usize = 256;

/// Activity of GUIDED.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Guided {
    /// Stop and hold, without a setpoint.
    Hold,
    /// Climb to a height [m, world].
    TakeOff { z_m: f64 },
    /// Follow a setpoint; `p_world_m` is the present position of its moving target.
    Setpoint { setpoint: GuidedSetpoint, since: AutopilotTime, p_world_m: DVec3 },
}

/// Stages of RTL.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Return {
    Climb,
    Travel,
    Land,
}

/// State of LAND.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Landing {
    began: AutopilotTime,
    /// Whether it hovers first, because a failsafe entered LAND or occurred during it.
    pauses: bool,
}

/// State of the radio-control receiver.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Radio {
    /// No receiver is connected: a lab without a pilot.
    #[default]
    Absent,
    /// The transmitter is received.
    Receiving,
    /// The transmitter is silent.
    Lost,
}

/// Simulated ArduCopter.
pub struct Autopilot {
    params: Params,
    startup: Startup,
    estimator: Estimator,
    position: PositionController,
    attitude: AttitudeController,
    mode: CopterMode,
    armed: bool,
    landed: bool,
    guided: Guided,
    returning: Return,
    landing: Landing,
    /// Position where the vehicle was armed [m, world].
    home: Option<DVec3>,
    /// Latitude and longitude [1e-7 deg] and altitude [mm], as set.
    origin: Option<(i32, i32, i32)>,
    datum_reset: bool,
    heading: Heading,
    saturated: bool,
    sample: SensorSample,
    flight: flight::FlightState,
    failsafe: failsafe::Failsafe,
    /// Uploaded fence polygons.
    polygons: mission::Polygons,
    streams: Streams,
    decoders: [StreamDecoder; MAX_LINKS],
    outbox: VecDeque<MavMessage>,
    outbox_dropped: u64,
    /// Present once a key was set.
    signing: Option<signing::Signing>,
    /// Time of the last [`Self::handle_timeout`].
    now: AutopilotTime,
    sequence: u8,
    last_ground_station: Option<AutopilotTime>,
    radio: Radio,
    gauge: failsafe::Gauge,
    vibration: vibration::Vibration,
    wants_reboot: bool,
}

impl Default for Autopilot {
    fn default() -> Self {
        Self {
            params: Params::default(),
            startup: Startup::default(),
            estimator: Estimator::default(),
            position: PositionController::default(),
            attitude: AttitudeController::default(),
            mode: CopterMode::Stabilize,
            armed: false,
            landed: true,
            guided: Guided::Hold,
            returning: Return::Climb,
            landing: Landing::default(),
            home: None,
            origin: None,
            datum_reset: false,
            heading: Heading { yaw_rad: 0.0, rate_radps: 0.0 },
            saturated: false,
            sample: SensorSample::default(),
            flight: flight::FlightState::default(),
            failsafe: failsafe::Failsafe::default(),
            polygons: mission::Polygons::default(),
            streams: Streams::default(),
            decoders: Default::default(),
            outbox: VecDeque::new(),
            outbox_dropped: 0,
            signing: None,
            now: AutopilotTime::ZERO,
            sequence: 0,
            last_ground_station: None,
            radio: Radio::Absent,
            gauge: failsafe::Gauge::default(),
            vibration: vibration::Vibration::default(),
            wants_reboot: false,
        }
    }
}

impl Autopilot {
    /// Returns an autopilot that has just booted, with some parameters changed by name.
    ///
    /// # Errors
    /// Returns the first name that is not a parameter.
    pub fn with_params(changes: &[(String, f32)]) -> Result<Self, UnknownParam> {
        let mut autopilot = Self::default();
        for (name, value) in changes {
            let index = Params::index_of(name).ok_or_else(|| UnknownParam(name.clone()))?;
            autopilot.params.set(index, *value);
        }
        Ok(autopilot)
    }

    /// Sets the start-up behaviour. Call it before the autopilot runs.
    pub fn set_startup(&mut self, startup: Startup) {
        self.startup = startup;
        self.estimator = Estimator::new(startup);
    }

    /// Returns the autopilot after a reboot: it keeps parameters, fence and key.
    pub fn rebooted(&self) -> Self {
        let signing = self.signing.as_ref().map(|signing| signing.rebooted(self.now));
        let (params, polygons) = (self.params.clone(), self.polygons.stored());
        let (startup, estimator) = (self.startup, Estimator::new(self.startup));
        Self { params, polygons, radio: self.radio, signing, startup, estimator, ..Self::default() }
    }

    /// Whether a reboot was requested.
    pub fn wants_reboot(&self) -> bool {
        self.wants_reboot
    }

    /// Sets the state of the radio-control receiver.
    pub fn set_radio(&mut self, radio: Radio) {
        self.radio = radio;
    }

    /// Takes bytes from a link, one of [`MAX_LINKS`].
    pub fn handle_input(&mut self, now: AutopilotTime, link: usize, bytes: &[u8]) {
        // Taken out temporarily, because packets change the rest of the autopilot.
        let mut decoder = std::mem::take(&mut self.decoders[link]);
        decoder.push_whole(bytes, |bytes, packet| {
            let mut signing = self.signing.as_mut();
            if signing.as_mut().is_none_or(|s| s.accepts(now, link, bytes, &packet.message)) {
                self.handle_packet(now, &packet);
            }
        });
        self.decoders[link] = decoder;
    }

    /// Takes one sensor sample, `dt_s` after the last one. Returns the motor commands: rotor speeds as fractions of
    /// full speed, in ArduCopter's order. 400 Hz.
    pub fn handle_sensors(
        &mut self,
        now: AutopilotTime,
        sample: &SensorSample,
        dt_s: f64,
    ) -> [f64; 4] {
        self.sample = *sample;
        self.gauge_charge(dt_s);
        self.vibration.handle_accel(sample.accel_body_mps2, dt_s);
        self.estimator.handle_sensors(now, sample, dt_s, !self.armed);
        self.fly(now, dt_s)
    }

    /// Runs due work: heartbeat, streams, failsafes. Call it at least 100 times a second.
    pub fn handle_timeout(&mut self, now: AutopilotTime) {
        self.now = now;
        self.check_failsafes(now);
        self.tend_upload(now);
        self.stream(now);
    }

    /// Returns the next packet for the links.
    pub fn poll_transmit<'a>(&mut self, buffer: &'a mut [u8; MAX_PACKET]) -> Option<&'a [u8]> {
        let message = self.outbox.pop_front()?;
        let header = MavHeader {
            system_id: self.system_id().into(),
            component_id: AUTOPILOT_COMPONENT,
            sequence: self.sequence,
        };
        self.sequence = self.sequence.wrapping_add(1);
        let mut len = encode(header, &message, buffer).len();
        if let Some(signing) = &mut self.signing {
            len = signing.sign(self.now, buffer, len);
        }
        Some(&buffer[..len])
    }

    /// Whether the vehicle is armed.
    pub fn is_armed(&self) -> bool {
        self.armed
    }

    /// Whether the autopilot's landing detection reports ground contact.
    pub fn is_landed(&self) -> bool {
        self.landed
    }

    /// Returns the flight mode.
    pub fn mode(&self) -> CopterMode {
        self.mode
    }

    pub fn estimator(&self) -> &Estimator {
        &self.estimator
    }

    /// Returns the number of packets received over all links.
    pub fn packets_in(&self) -> u64 {
        self.decoders.iter().map(|decoder| decoder.stats().packets).sum()
    }

    /// Returns the number of received packets that were refused because they were not signed with the key.
    pub fn packets_refused(&self) -> u64 {
        self.signing.as_ref().map_or(0, signing::Signing::refused)
    }

    /// Returns the number of messages dropped because the outbox was full.
    pub fn outbox_dropped(&self) -> u64 {
        self.outbox_dropped
    }

    fn system_id(&self) -> u8 {
        self.params.value(Param::SystemId) as u8
    }

    fn send(&mut self, message: MavMessage) {
        if self.outbox.len() == OUTBOX {
            self.outbox.pop_front();
            self.outbox_dropped += 1;
        }
        self.outbox.push_back(message);
    }

    /// Sends a status text of at most 50 characters.
    fn send_status_text(&mut self, severity: MavSeverity, text: &str) {
        tracing::info!(target: "autopilot", "{text}");
        self.send(MavMessage::STATUSTEXT(dialect::STATUSTEXT_DATA {
            severity,
            text: text.into(),
            ..Default::default()
        }));
    }
}

/// MAV_COMP_ID_AUTOPILOT1.
const AUTOPILOT_COMPONENT: u8 = 1;

/// Parameter name that the autopilot does not have.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("autopilot: no parameter {0}; PARAM_REQUEST_LIST returns all names")]
pub struct UnknownParam(pub String);

/// Returns ArduCopter's name of a mode.
fn name_of(mode: CopterMode) -> &'static str {
    match mode {
        CopterMode::Stabilize => "STABILIZE",
        CopterMode::AltHold => "ALT_HOLD",
        CopterMode::Guided => "GUIDED",
        CopterMode::Loiter => "LOITER",
        CopterMode::Rtl => "RTL",
        CopterMode::Land => "LAND",
        CopterMode::Brake => "BRAKE",
    }
}
