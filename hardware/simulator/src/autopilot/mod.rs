//! An autopilot that behaves as ArduCopter does in a lab with external navigation and no radio
//! control: MAVLink bytes and sensor samples in, MAVLink bytes and motor commands out. Sans-IO:
//! no socket, no clock.
//!
//! - [`Autopilot::handle_sensors`], 400 Hz: estimate -> mode -> control -> motors ([`flight`]).
//! - [`Autopilot::handle_input`]: bytes of the link -> signed by the key, if one was given
//!   ([`signing`]) -> messages -> commands ([`commands`]).
//!   The fence's polygons come by the mission protocol ([`mission`]).
//! - [`Autopilot::handle_timeout`]: heartbeats, streams, failsafes ([`telemetry`], [`failsafe`]).
//! - [`Autopilot::poll_transmit`]: bytes for the link.
//!
//! What a real ArduCopter 4.8 was seen to do is reproduced, its pitfalls included: take-off
//! without an origin is refused though it arms; an ignored yaw turns the nose into travel; a
//! velocity setpoint dies after 3 s; lost vision is only noticed after seven seconds. One test a
//! pitfall: `tests/pitfalls.rs`. Texts of fence and reboot are worded alike, not copied.

// Why: what real ground stations still send is deprecated in the dialect and alive on the wire.
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

/// Links that are served at once, as telemetry ports: each has its own stream of bytes.
pub const MAX_LINKS: usize = 4;
/// Messages that wait for the link at most. A full parameter list fits; beyond it the oldest goes.
const OUTBOX: usize = 256;

/// What GUIDED is doing.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Guided {
    /// Nothing asked yet: stop and stay.
    Hold,
    /// Climbing to a height. [m, world]
    TakeOff { z_m: f64 },
    /// Following a setpoint; `p_world_m` is where its point has moved to by now.
    Setpoint { setpoint: GuidedSetpoint, since: AutopilotTime, p_world_m: DVec3 },
}

/// Stages of RTL.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Return {
    Climb,
    Travel,
    Land,
}

/// LAND of the moment.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Landing {
    began: AutopilotTime,
    /// A failsafe entered it, or came during it: it hovers first.
    pauses: bool,
}

/// The receiver of a radio control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Radio {
    /// None is connected: a lab without a pilot.
    #[default]
    Absent,
    /// A transmitter is received.
    Receiving,
    /// The transmitter has fallen silent.
    Lost,
}

/// The autopilot.
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
    /// Where the vehicle was armed. [m, world]
    home: Option<DVec3>,
    /// Latitude and longitude [1e-7 deg] and altitude [mm], as set.
    origin: Option<(i32, i32, i32)>,
    datum_reset: bool,
    heading: Heading,
    saturated: bool,
    sample: SensorSample,
    flight: flight::FlightState,
    failsafe: failsafe::Failsafe,
    /// The fence's, as uploaded.
    polygons: mission::Polygons,
    streams: Streams,
    decoders: [StreamDecoder; MAX_LINKS],
    outbox: VecDeque<MavMessage>,
    outbox_dropped: u64,
    /// Since a key was given.
    signing: Option<signing::Signing>,
    /// Of the last [`Self::handle_timeout`].
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
    /// Makes an autopilot that has just booted, with some parameters changed by name.
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

    /// Makes it start as `startup` has it. Call it before it runs.
    pub fn set_startup(&mut self, startup: Startup) {
        self.startup = startup;
        self.estimator = Estimator::new(startup);
    }

    /// Makes an autopilot that boots with the parameters, the fence and the key this one has stored.
    pub fn rebooted(&self) -> Self {
        let signing = self.signing.as_ref().map(|signing| signing.rebooted(self.now));
        let (params, polygons) = (self.params.clone(), self.polygons.stored());
        let (startup, estimator) = (self.startup, Estimator::new(self.startup));
        Self { params, polygons, radio: self.radio, signing, startup, estimator, ..Self::default() }
    }

    /// Whether somebody has asked for a reboot.
    pub fn wants_reboot(&self) -> bool {
        self.wants_reboot
    }

    /// Sets the state of the radio-control receiver.
    pub fn set_radio(&mut self, radio: Radio) {
        self.radio = radio;
    }

    /// Takes bytes from a link; there are [`MAX_LINKS`].
    pub fn handle_input(&mut self, now: AutopilotTime, link: usize, bytes: &[u8]) {
        // Taken out while it runs, because every packet changes the rest of the autopilot.
        let mut decoder = std::mem::take(&mut self.decoders[link]);
        decoder.push_whole(bytes, |bytes, packet| {
            let mut signing = self.signing.as_mut();
            if signing.as_mut().is_none_or(|s| s.accepts(now, link, bytes, &packet.message)) {
                self.handle_packet(now, &packet);
            }
        });
        self.decoders[link] = decoder;
    }

    /// Takes one sensor sample, `dt_s` after the last, and returns the motor commands: rotor
    /// speeds as fractions of full speed in ArduCopter's order. 400 Hz.
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

    /// Does what is due: heartbeat, streams, failsafes. Call at least 100 times a second.
    pub fn handle_timeout(&mut self, now: AutopilotTime) {
        self.now = now;
        self.check_failsafes(now);
        self.tend_upload(now);
        self.stream(now);
    }

    /// Returns the next packet for the link.
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

    /// Whether the motors may turn.
    pub fn is_armed(&self) -> bool {
        self.armed
    }

    /// Whether the autopilot estimates that it stands on the ground.
    pub fn is_landed(&self) -> bool {
        self.landed
    }

    /// Returns the flight mode.
    pub fn mode(&self) -> CopterMode {
        self.mode
    }

    /// Returns the estimator.
    pub fn estimator(&self) -> &Estimator {
        &self.estimator
    }

    /// Returns packets received over all links.
    pub fn packets_in(&self) -> u64 {
        self.decoders.iter().map(|decoder| decoder.stats().packets).sum()
    }

    /// Returns packets refused because they were not signed with the key; each is one of those received.
    pub fn packets_refused(&self) -> u64 {
        self.signing.as_ref().map_or(0, signing::Signing::refused)
    }

    /// Returns messages dropped because the link did not take them.
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

    /// Says something to people, at most 50 characters.
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

/// A parameter name that the autopilot does not have.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("autopilot: no parameter {0}; PARAM_REQUEST_LIST names those there are")]
pub struct UnknownParam(pub String);

/// ArduCopter's name of a mode.
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
