//! The autopilot's own estimate over MAVLink, for example from UWB, optical flow or a camera. Sans-IO.
//!
//! Uses only ODOMETRY (331), or LOCAL_POSITION_NED (32) for the position with the newest ATTITUDE_QUATERNION
//! (31) or ATTITUDE (30), extrapolated to its time with its own rates. The driver requests 32 and 31 at 50 Hz
//! from each sender. Stamps are the autopilot's time since boot, which [`super::sender_clock`] maps to the
//! server's clock. A vehicle's object is its system id; a single vehicle accepts any.

use std::collections::BTreeSet;
use std::net::SocketAddr;

use glam::{DQuat, DVec3};
use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_arena::pose::{PoseSigma, Resolution};
use vizflyt_protocol::mavlink::dialect::{
    ATTITUDE_QUATERNION_DATA, COMMAND_LONG_DATA, HEARTBEAT_DATA, MavCmd, MavFrame, MavMessage,
    ODOMETRY_DATA,
};
use vizflyt_protocol::mavlink::{
    HeartbeatSender, MAX_PACKET, MavHeader, Packet, StreamDecoder, attitude_from_mavlink,
    body_from_frd, encode, heartbeat_sender, heartbeat_sender_name, local_position_from_mavlink,
    world_from_ned, world_rotation_from_ned,
};
use vizflyt_protocol::time::ServerTime;

use super::sender_clock::{SenderClock, unit_name};
use super::source::{Measurement, SourceCounters};
use super::udp::{PoseStream, Silence, UNNAMED};
use super::vehicle_names::VehicleNames;
use crate::poses::settings::LocalizationConfig;

/// Driver for MAVLink.
pub struct MavlinkStream {
    names: VehicleNames,
    decoder: StreamDecoder,
    /// Packets of one datagram that are not processed yet.
    packets: Vec<Packet>,
    systems: Vec<System>,
    asks: u8,
    /// Systems whose heartbeats name another vehicle than a multirotor.
    refused: BTreeSet<u8>,
}

/// State of one vehicle's autopilot.
#[derive(Clone, Debug, Default)]
struct System {
    clock: SenderClock,
    attitude: Option<Attitude>,
    /// Header of its packets, and its address.
    from: Option<(MavHeader, SocketAddr)>,
    asked: Option<ServerTime>,
    /// ODOMETRY arrives, so the other messages, which contain the same less precisely, are ignored.
    has_odometry: bool,
    /// Newest stamp used. [ns, autopilot]
    last_ns: u64,
}

#[derive(Clone, Copy, Debug)]
struct Attitude {
    boot_ms: u32,
    world_from_body: DQuat,
    omega_body_radps: DVec3,
}

impl MavlinkStream {
    /// Creates a stream for the named vehicles; the first has index 0, and so on.
    pub fn new(config: &LocalizationConfig, source: u8, vehicles: &[&str]) -> Self {
        let names = VehicleNames::new(config, source, vehicles).with_resolution(RESOLUTION);
        let systems = vec![System::default(); names.len().min(MAX_VEHICLES)];
        let decoder = StreamDecoder::default();
        Self { names, decoder, packets: Vec::new(), systems, asks: 0, refused: BTreeSet::new() }
    }

    fn vehicle_of(&self, header: MavHeader) -> Option<usize> {
        let named = self.names.find(header.system_id.to_string().as_bytes());
        named.or((self.names.len() == 1).then_some(0))
    }

    fn handle(&mut self, now: ServerTime, from: Option<SocketAddr>, packet: &Packet) {
        let relevant = matches!(
            packet.message,
            MavMessage::ODOMETRY(_)
                | MavMessage::LOCAL_POSITION_NED(_)
                | MavMessage::ATTITUDE_QUATERNION(_)
                | MavMessage::ATTITUDE(_)
                | MavMessage::HEARTBEAT(_)
        );
        // Ground stations and companions of the same system have other component numbers.
        if !relevant || packet.header.component_id != AUTOPILOT {
            return;
        }
        let (vehicle, address) = (self.vehicle_of(packet.header), from.unwrap_or(UNNAMED));
        if let MavMessage::HEARTBEAT(heartbeat) = &packet.message {
            // A stranger must not stop the poses of the vehicle.
            if vehicle.is_some_and(|vehicle| !self.names.may_be_sender(vehicle, address, now)) {
                return;
            }
            self.note_type(packet.header, heartbeat);
        }
        if self.refused.contains(&(packet.header.system_id as u8)) {
            return;
        }
        let Some(vehicle) = vehicle else {
            let name = packet.header.system_id.to_string();
            let advice =
                "set `objects` to the autopilots' system numbers: objects = { bee = \"2\" }";
            return self.names.others(std::iter::once(name.as_str()), advice);
        };
        if !matches!(packet.message, MavMessage::HEARTBEAT(_))
            && !self.names.is_from_sender(vehicle, address, now)
        {
            return;
        }
        let system = &mut self.systems[vehicle];
        if let Some(from) = from {
            system.from = Some((packet.header, from));
        }
        match &packet.message {
            MavMessage::ATTITUDE_QUATERNION(message) => {
                system.attitude = attitude_of(message).or(system.attitude);
            }
            MavMessage::ATTITUDE(message) => {
                let (world_from_body, omega_body_radps) = attitude_from_mavlink(message);
                let boot_ms = message.time_boot_ms;
                // If both messages arrive, the quaternion is preferred.
                let newer =
                    system.attitude.is_none_or(|old| boot_ms.wrapping_sub(old.boot_ms) > 100);
                if newer && world_from_body.is_normalized() && omega_body_radps.is_finite() {
                    system.attitude = Some(Attitude { boot_ms, world_from_body, omega_body_radps });
                }
            }
            MavMessage::LOCAL_POSITION_NED(message) if !system.has_odometry => {
                let (p_world_m, _) = local_position_from_mavlink(message);
                let Some(attitude) = system.attitude else { return };
                let dt_ms = message.time_boot_ms.wrapping_sub(attitude.boot_ms).cast_signed();
                // Reject attitudes of another time.
                if dt_ms.unsigned_abs() > OLDEST_ATTITUDE_MS {
                    return;
                }
                let turned = attitude.omega_body_radps * (f64::from(dt_ms) * 1e-3);
                let rotation = attitude.world_from_body * DQuat::from_scaled_axis(turned);
                let stamp_ns = u64::from(message.time_boot_ms) * 1_000_000;
                self.measure(vehicle, now, (stamp_ns, 1e-3), (p_world_m, rotation), None);
            }
            MavMessage::ODOMETRY(message) => self.handle_odometry(vehicle, now, message),
            _ => {}
        }
    }

    /// Refuses the packets of a system that is no multirotor, such as an antenna tracker or a rover.
    fn note_type(&mut self, header: MavHeader, heartbeat: &HEARTBEAT_DATA) {
        let (system, mavtype) = (header.system_id as u8, heartbeat.mavtype);
        let sender =
            heartbeat_sender(header.component_id, mavtype as u8, heartbeat.autopilot as u8);
        if sender != HeartbeatSender::OtherVehicle {
            self.refused.remove(&system);
        } else if self.refused.insert(system) {
            let name = heartbeat_sender_name(header.component_id, mavtype);
            self.names.warn(format!(
                "mavlink: system {system} is {name}, not a multirotor with ArduPilot or PX4; its poses are ignored"
            ));
        }
    }

    fn handle_odometry(&mut self, vehicle: usize, now: ServerTime, message: &ODOMETRY_DATA) {
        if message.frame_id != MavFrame::MAV_FRAME_LOCAL_NED {
            let error = format!("ODOMETRY is in {:?}", message.frame_id);
            return self.names.bad(&error, "only MAV_FRAME_LOCAL_NED is known");
        }
        self.systems[vehicle].has_odometry = true;
        let [w, x, y, z] = message.q.map(f64::from);
        let rotation = DQuat::from_xyzw(x, y, z, w);
        let p = DVec3::new(message.x.into(), message.y.into(), message.z.into());
        if !((rotation.length() - 1.0).abs() <= 0.01) {
            let error = format!("ODOMETRY's rotation {rotation} is not of unit length");
            return self.names.bad(&error, "does the autopilot know its attitude yet?");
        }
        // Diagonal of an upper triangle; NaN as first element means unknown.
        let variance = |[a, b, c]: [usize; 3]| {
            let at = |index: usize| f64::from(message.pose_covariance[index]);
            DVec3::new(at(a), at(b), at(c))
        };
        let (p2, r2) = (variance([0, 6, 11]), variance([15, 18, 20]));
        let known = p2.cmpgt(DVec3::ZERO).all() && r2.cmpgt(DVec3::ZERO).all();
        let sigma = (known && p2.is_finite() && r2.is_finite()).then(|| PoseSigma {
            position_m: DVec3::new(p2.y, p2.x, p2.z).map(f64::sqrt),
            rotation_rad: r2.map(f64::sqrt),
        });
        let rotation = world_rotation_from_ned(rotation.normalize());
        let stamp_ns = message.time_usec.wrapping_mul(1000);
        self.measure(vehicle, now, (stamp_ns, 1e-6), (world_from_ned(p), rotation), sigma);
    }

    fn measure(
        &mut self,
        vehicle: usize,
        now: ServerTime,
        (stamp_ns, unit_s): (u64, f64),
        (p_m, rotation): (DVec3, DQuat),
        sigma: Option<PoseSigma>,
    ) {
        if !(p_m.abs().cmple(DVec3::splat(MAX_POSITION_M)).all() && rotation.is_normalized()) {
            let error = format!("position {p_m} with rotation {rotation} is not a valid pose");
            return self.names.bad(&error, "has the autopilot an estimate yet?");
        }
        let system = &mut self.systems[vehicle];
        // A routed link may deliver a packet twice.
        if stamp_ns == system.last_ns
            || self.names.measured().iter().any(|measured| measured.vehicle == vehicle)
        {
            return;
        }
        system.last_ns = stamp_ns;
        let stamp = system.clock.map_in_order(stamp_ns, now);
        if let Some(unit) = system.clock.take_unit(unit_s) {
            let expected = unit_name(unit_s).unwrap_or_default();
            self.names.warn(format!(
                "mavlink: the stamps of the poses are in {unit} instead of {expected}; correct the sender: till then \
                 poses are stamped as they come"
            ));
        } else if let Some(jump_s) = system.clock.take_jump_s() {
            self.names.warn(format!(
                "mavlink: the autopilot's clock has jumped by {jump_s:.3} s; has it rebooted?"
            ));
        }
        self.names.measure(vehicle, (stamp, now), (p_m, rotation), sigma);
    }

    fn handle_bytes(
        &mut self,
        now: ServerTime,
        from: Option<SocketAddr>,
        bytes: &[u8],
    ) -> &[Measurement] {
        self.names.begin();
        let mut packets = std::mem::take(&mut self.packets);
        let before = self.decoder.stats();
        self.decoder.push(bytes, |packet| packets.push(packet));
        let after = self.decoder.stats();
        if after.packets + after.unknown == before.packets + before.unknown {
            self.names.bad(
                &format!("{} bytes contain no MAVLink packet", bytes.len()),
                "is something else sent to this port?",
            );
        }
        for packet in packets.drain(..) {
            self.handle(now, from, &packet);
        }
        self.packets = packets;
        self.names.measured()
    }
}

fn attitude_of(message: &ATTITUDE_QUATERNION_DATA) -> Option<Attitude> {
    let q = [message.q2, message.q3, message.q4, message.q1].map(f64::from);
    let rotation = DQuat::from_array(q);
    let rates = [message.rollspeed, message.pitchspeed, message.yawspeed].map(f64::from);
    let rates = DVec3::from(rates);
    ((rotation.length() - 1.0).abs() <= 0.01 && rates.is_finite()).then(|| Attitude {
        boot_ms: message.time_boot_ms,
        world_from_body: world_rotation_from_ned(rotation.normalize()),
        omega_body_radps: body_from_frd(rates),
    })
}

impl PoseStream for MavlinkStream {
    fn handle_packet(&mut self, now: ServerTime, bytes: &[u8]) -> &[Measurement] {
        self.handle_bytes(now, None, bytes)
    }

    fn handle_packet_from(
        &mut self,
        now: ServerTime,
        from: SocketAddr,
        bytes: &[u8],
    ) -> &[Measurement] {
        self.handle_bytes(now, Some(from), bytes)
    }

    fn poll_transmit(&mut self, now: ServerTime) -> Option<(SocketAddr, Vec<u8>)> {
        let due = |system: &&mut System| {
            system.from.is_some()
                && system.asked.is_none_or(|at| now.seconds_since(at) > ASK_EVERY_S)
        };
        // One message per call: first the position, then the attitude.
        let attitude = self.asks % 2 == 1;
        let system = self.systems.iter_mut().find(due)?;
        let (autopilot, to) = system.from?;
        if attitude {
            system.asked = Some(now);
        }
        self.asks = self.asks.wrapping_add(1);
        let message = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            target_system: autopilot.system_id as u8,
            target_component: autopilot.component_id,
            command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
            param1: if attitude { 31.0 } else { 32.0 },
            param2: INTERVAL_US,
            ..COMMAND_LONG_DATA::default()
        });
        let header =
            MavHeader { system_id: OUR_SYSTEM, component_id: OUR_COMPONENT, sequence: self.asks };
        Some((to, encode(header, &message, &mut [0; MAX_PACKET]).to_vec()))
    }

    fn next_warning(&mut self) -> Option<String> {
        self.names.next_warning()
    }

    fn counters(&self, vehicle: usize) -> SourceCounters {
        self.names.counters(vehicle)
    }

    fn silence(&self) -> Silence {
        Silence {
            at_first: "send the autopilot's MAVLink here, for example with the bridge or \
                       mavlink-router",
            later: "is the autopilot's link there?",
        }
    }
}

/// An estimator that does not get measurements keeps its position, but turns with its gyroscope.
const RESOLUTION: Resolution = Resolution { position_m: 0.0, rotation_rad: std::f64::consts::PI };
/// MAV_COMP_ID_AUTOPILOT1.
const AUTOPILOT: u8 = 1;
/// Our system id: not one of a ground station, so that the autopilot does not treat us as one.
const OUR_SYSTEM: u32 = 246;
/// MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY.
const OUR_COMPONENT: u8 = 197;
/// 50 Hz. [us]
const INTERVAL_US: f32 = 20_000.0;
/// Interval of requests: a request may be lost, and a rebooted autopilot loses its settings. [s]
const ASK_EVERY_S: f64 = 5.0;
/// Maximum extrapolation of an attitude. [ms]
const OLDEST_ATTITUDE_MS: u32 = 100;
/// Maximum coordinate. [m]
const MAX_POSITION_M: f64 = 1e6;

#[cfg(test)]
mod tests;
