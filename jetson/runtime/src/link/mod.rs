//! MAVLink link to an autopilot, as a sans-IO state machine. Bytes, poses, setpoints and `now` in; datagrams and events
//! out. The guardian transports the bytes.
//!
//! ```text
//! poses 100 Hz ── vision() ──▶ VISION_POSITION_ESTIMATE 30-50 Hz   external navigation
//! readings ── reading() ─────▶ DISTANCE_SENSOR, OBSTACLE_DISTANCE  if enabled for the sensor
//! guard 50 Hz ── setpoint() ─▶ SET_POSITION_TARGET_LOCAL_NED       yaw always sent
//! flight ── set_goal() ──────▶ mode, arming, take-off, landing     acknowledged or repeated
//! autopilot ── handle_input() ▶ VehicleState, clock offset, parameters, LinkEvents
//! ```
//! Commands depend on the observed state, not on a script: the link sends the next command that the goal needs.
//! Therefore a restart of either side or a lost packet only repeats a step.
//!
//! `receive` handles packets, `advance` chooses the next message to send, `messages` contains the messages for people,
//! and `dialect` contains the differences between ArduCopter and PX4.

mod advance;
mod commands;
mod companions;
mod dialect;
mod distances;
mod events;
mod fence;
mod goal;
mod identity;
mod messages;
mod navigation;
mod neighbors;
mod own_mode;
mod params;
mod rates;
mod receive;
mod signing;
#[cfg(test)]
mod tests;

use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};

use vizflyt_protocol::mavlink::dialect::{
    EkfStatusFlags, MavCmd, MavMessage, MavSysStatusSensor, SETUP_SIGNING_DATA,
};
use vizflyt_protocol::mavlink::{
    GlobalPoint, GuidedSetpoint, MAX_PACKET, MavHeader, Packet, StreamDecoder, encode,
    guided_to_mavlink, is_signed, vision_of_sample,
};
use vizflyt_protocol::messages::{PoseSample, VehicleState};
use vizflyt_protocol::sensor::MAX_SENSORS;
use vizflyt_protocol::time::{Autopilot, Host, HostTime, OffsetFilter};
use vizflyt_sdk::ImuSample;

use crate::guard::Response;

use commands::{Command, Commands};
use companions::Companions;
use dialect::Dialect;
pub use events::{LinkEvent, advice};
pub use fence::{FenceEvent, FencePolygon};
pub use goal::Goal;
pub use identity::{COMPONENT_ID, Firmware, SYSTEM_ID};
use navigation::Feed;
pub use navigation::{Delay, VISION_HZ};
use neighbors::Neighbors;
use own_mode::OwnMode;
use params::Params;
pub use params::{Param, ParamEvent, same};
pub use rates::Rate;
use rates::Rates;
use receive::TextParts;
use signing::Signatures;
pub use signing::{SigningFile, SigningFileError};
pub use vizflyt_guardian::port::LinkSigning;
use vizflyt_guardian::port::Wanted;

/// Settings of the link.
#[derive(Clone, Debug)]
pub struct LinkSettings {
    /// Name announced to other companions on the same vehicle; empty: no announcement.
    pub name: String,
    /// System id of the autopilot; `None` uses the only autopilot on the link.
    pub system: Option<u8>,
    /// Rate of external navigation, clamped to [`VISION_HZ`]. [Hz]
    pub vision_hz: f64,
    /// If set, signs all packets and rejects unsigned ones.
    pub signing: Option<LinkSigning>,
}

impl Default for LinkSettings {
    fn default() -> Self {
        Self { name: String::new(), system: None, vision_hz: *VISION_HZ.end(), signing: None }
    }
}

impl LinkSettings {
    /// Returns which autopilot the guardian accepts.
    pub fn wanted(&self) -> Wanted {
        Wanted { system: self.system, signing: self.signing.clone() }
    }
}

/// Payload of one UDP datagram.
#[derive(Clone, Copy, Debug)]
pub struct Datagram {
    bytes: [u8; MAX_PACKET],
    len: usize,
}

impl std::ops::Deref for Datagram {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Period of clock requests, and of the origin until it is confirmed. [s]
const SECOND_S: f64 = 1.0;
/// Period of heartbeats. Several may be lost before `FS_GCS_TIMEOUT` (minimum 2 s) lands the vehicle. [s]
const HEARTBEAT_S: f64 = 0.25;
/// Timeout of the autopilot: three heartbeats. [s]
pub(crate) const LOST_AFTER_S: f64 = 3.0;
/// Maximum number of waiting datagrams; the driver empties the queue at once, so it is never reached.
const OUTBOX: usize = 512;

/// Address of the autopilot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Target {
    system: u8,
    component: u8,
}

impl Target {
    /// Returns the sender of a packet.
    fn of(packet: &Packet) -> Self {
        Self { system: packet.header.system_id as u8, component: packet.header.component_id }
    }
}

/// State of the pre-arm checks.
#[derive(Clone, Debug)]
struct Prearm {
    /// Result; `None` before the first SYS_STATUS.
    ok: Option<bool>,
    /// Texts about failing checks, newest last.
    texts: VecDeque<(HostTime, String)>,
    /// Enabled sensors that are unhealthy.
    unhealthy: MavSysStatusSensor,
    /// Time of the last request for the checks; `None` if none was sent.
    asked_at: Option<HostTime>,
    /// The autopilot does not support the request.
    is_unsupported: bool,
}

impl Default for Prearm {
    fn default() -> Self {
        Self {
            ok: None,
            texts: VecDeque::new(),
            unhealthy: MavSysStatusSensor::empty(),
            asked_at: None,
            is_unsupported: false,
        }
    }
}

/// Take-off by setpoints in progress.
#[derive(Clone, Copy, Debug)]
struct Rising {
    setpoint: GuidedSetpoint,
    since: HostTime,
    due_at: HostTime,
}

/// Link to the autopilot; see the module.
pub struct Link {
    settings: LinkSettings,
    decoder: StreamDecoder,
    signatures: Option<Signatures>,
    outbox: VecDeque<Datagram>,
    events: VecDeque<LinkEvent>,
    sequence: u8,
    sent_packets: u64,
    goal: Goal,
    /// Goal from before a restart of the autopilot; the link does not arm for it.
    goal_is_stale: bool,
    own_mode: OwnMode,
    commands: Commands,
    chores: VecDeque<Command>,
    /// Commands sent, with the time of the last transmission. Acknowledgements of other commands are not ours.
    commanded: Vec<(MavCmd, HostTime)>,
    /// `None` before the first heartbeat and after a timeout.
    autopilot: Option<Target>,
    /// System of the vehicle that was armed on this link. No other vehicle takes its place, not even after a loss.
    flown: Option<u8>,
    dialect: &'static dyn Dialect,
    firmware: Option<Firmware>,
    /// Whether the autopilot signs its packets.
    autopilot_signs: bool,
    neighbors: Neighbors,
    companions: Companions,
    announced_at: Option<HostTime>,
    received_at: HostTime,
    state: VehicleState,
    /// Measurement time of the attitude in `state`.
    attitude_at: Option<HostTime>,
    /// Whether LOCAL_POSITION_NED has been received.
    position_known: bool,
    /// Newest IMU samples, oldest first.
    imu: VecDeque<ImuSample>,
    /// Whether HIGHRES_IMU is received; then RAW_IMU, which has the same data as integers, is ignored.
    imu_is_fine: bool,
    clock: OffsetFilter<Host, Autopilot>,
    /// Stamps of our newest clock requests. [ns]
    clock_asked: VecDeque<i64>,
    boot_ms: u32,
    /// Origin of the autopilot's local frame, as reported by it.
    origin: Option<GlobalPoint>,
    fence: fence::Upload,
    ekf: EkfStatusFlags,
    prearm: Prearm,
    took_off: bool,
    rising: Option<Rising>,
    feed: Feed,
    delay_reported: bool,
    distances_due: distances::Due,
    params: Params,
    rates: Rates,
    beat_at: HostTime,
    heartbeat_at: HostTime,
    texts: VecDeque<(HostTime, String)>,
    text_parts: TextParts,
}

impl Link {
    /// Creates a link at `now` that uses the only autopilot present.
    pub fn new(now: HostTime) -> Self {
        Self::with(now, LinkSettings::default())
    }

    /// Creates a link at `now` with these settings.
    pub fn with(now: HostTime, settings: LinkSettings) -> Self {
        // Two runtimes start at the same nanosecond of their computers' uptimes with negligible probability.
        let nonce = (now.as_ns() ^ now.as_ns() >> 32) as u32 ^ u32::from(settings.name.len() as u8);
        Self {
            decoder: StreamDecoder::default(),
            signatures: settings.signing.clone().map(|signing| Signatures::new(now, signing)),
            outbox: VecDeque::new(),
            events: VecDeque::new(),
            sequence: 0,
            sent_packets: 0,
            goal: Goal::Prepare,
            goal_is_stale: false,
            own_mode: OwnMode::default(),
            commands: Commands::default(),
            chores: VecDeque::new(),
            commanded: Vec::new(),
            autopilot: None,
            flown: None,
            dialect: &dialect::ArduCopter,
            firmware: None,
            autopilot_signs: false,
            neighbors: Neighbors::default(),
            companions: Companions::new(nonce),
            announced_at: None,
            received_at: now,
            state: VehicleState { battery_fraction: -1.0, ..VehicleState::default() },
            attitude_at: None,
            position_known: false,
            imu: VecDeque::new(),
            imu_is_fine: false,
            clock: OffsetFilter::default(),
            clock_asked: VecDeque::new(),
            boot_ms: 0,
            origin: None,
            fence: fence::Upload::default(),
            ekf: EkfStatusFlags::empty(),
            prearm: Prearm::default(),
            took_off: false,
            rising: None,
            feed: Feed::new(settings.vision_hz),
            delay_reported: false,
            distances_due: [now; MAX_SENSORS],
            params: Params::default(),
            rates: Rates::default(),
            beat_at: now,
            heartbeat_at: now,
            texts: VecDeque::new(),
            text_parts: TextParts::default(),
            settings,
        }
    }

    // ---- input ----

    /// Accepts bytes from the autopilot, in chunks of any size.
    pub fn handle_input(&mut self, now: HostTime, bytes: &[u8]) {
        let mut packets = Vec::new();
        let signatures = &mut self.signatures;
        self.decoder.push_whole(bytes, |bytes, packet| {
            if signatures.as_mut().is_none_or(|s| s.accepts(now, bytes, &packet.message)) {
                packets.push((packet, is_signed(bytes)));
            }
        });
        for (packet, signed) in packets {
            self.handle_packet(now, &packet);
            if self.autopilot == Some(Target::of(&packet)) {
                self.autopilot_signs = signed;
            }
        }
        self.advance(now);
    }

    /// Runs everything due at `now`.
    pub fn handle_timeout(&mut self, now: HostTime) {
        if now >= self.heartbeat_at {
            self.heartbeat_at = now.plus_seconds(HEARTBEAT_S);
            // Heartbeats also give our address to a bridge or an autopilot that waits for it.
            self.send_heartbeat(now);
        }
        if now >= self.beat_at {
            self.beat_at = now.plus_seconds(SECOND_S);
            self.every_second(now);
        }
        if self.autopilot.is_some() && now.seconds_since(self.received_at) > LOST_AFTER_S {
            self.autopilot = None;
            self.commands = Commands::default();
            self.rising = None;
            self.events.push_back(LinkEvent::Lost);
        }
        self.advance(now);
    }

    /// Sets the goal from `now` on. Setting the same goal again changes nothing.
    pub fn set_goal(&mut self, now: HostTime, goal: Goal) {
        if self.goal != goal {
            self.goal = goal;
            self.goal_is_stale = false;
            self.rising = None;
            // Do not repeat a command of the old goal, for example arming after "land".
            self.commands.abandon();
            self.advance(now);
        }
    }

    /// Sends a localized pose, measured at `stamp`, as external navigation. Call it with every pose: it limits the rate
    /// and drops poses older than 0.5 s.
    pub fn vision(&mut self, now: HostTime, sample: &PoseSample, stamp: HostTime) {
        if self.autopilot.is_some() && sample.is_valid() && self.feed.take(now, stamp) {
            let message = vision_of_sample(sample, stamp);
            self.send(now, &MavMessage::VISION_POSITION_ESTIMATE(message));
        }
    }

    /// Sends a guarded setpoint. Returns whether an autopilot is connected.
    pub fn setpoint(&mut self, now: HostTime, setpoint: &GuidedSetpoint) -> bool {
        let Some(target) = self.autopilot else { return false };
        let target = (target.system, target.component);
        let message = guided_to_mavlink(setpoint, target, (now.as_ns() / 1_000_000) as u32);
        self.send(now, &MavMessage::SET_POSITION_TARGET_LOCAL_NED(message));
        true
    }

    /// Reads all parameters; [`LinkEvent::Param`] reports the end.
    pub fn read_params(&mut self, now: HostTime) {
        self.params.read_all(now);
        self.advance(now);
    }

    /// Writes a parameter; [`LinkEvent::Param`] reports the result.
    pub fn write_param(&mut self, now: HostTime, name: &str, value: f64) {
        self.params.write(name, value);
        self.advance(now);
    }

    /// Uploads these polygons as the autopilot's own fence, when it is next on the ground; [`LinkEvent::Fence`] reports
    /// the result. Repeating the same polygons changes nothing.
    pub fn set_fence(&mut self, now: HostTime, polygons: Vec<FencePolygon>) {
        self.fence.want(polygons);
        if let Some(origin) = self.origin {
            self.fence.set_origin(origin);
        }
        self.advance(now);
    }

    /// Sends the signing key to the autopilot; `None` disables signing. Returns whether an autopilot is connected. The
    /// autopilot does not reply. Use this only over a link that cannot be intercepted.
    pub fn setup_signing(&mut self, now: HostTime, signing: Option<&LinkSigning>) -> bool {
        let Some(target) = self.autopilot else { return false };
        let message = SETUP_SIGNING_DATA {
            initial_timestamp: signing.map_or(0, |signing| signing.start.units()),
            target_system: target.system,
            target_component: target.component,
            secret_key: signing.map_or([0; 32], |signing| *signing.key.bytes()),
        };
        // Twice, because the autopilot does not acknowledge it.
        self.send(now, &MavMessage::SETUP_SIGNING(message.clone()));
        self.send(now, &MavMessage::SETUP_SIGNING(message));
        true
    }

    // ---- output ----

    /// Returns the next datagram to send to the autopilot.
    pub fn poll_transmit(&mut self) -> Option<Datagram> {
        self.outbox.pop_front()
    }

    /// Returns the next event.
    pub fn poll_event(&mut self) -> Option<LinkEvent> {
        self.events.pop_front()
    }

    /// Returns the time at which [`Self::handle_timeout`] is due next.
    pub fn poll_timeout(&self) -> Option<HostTime> {
        let rising = self.rising.map(|rising| rising.due_at);
        let due = [self.commands.due_at(), self.params.due_at(), self.fence.due_at(), rising];
        Some(due.into_iter().flatten().fold(self.beat_at.min(self.heartbeat_at), Ord::min))
    }

    /// Returns the vehicle's state as last reported by the autopilot, in our frames.
    pub fn state(&self) -> &VehicleState {
        &self.state
    }

    /// Returns the measurement time of the attitude in [`Self::state`]; `None` before the first. [host]
    pub fn attitude_at(&self) -> Option<HostTime> {
        self.attitude_at
    }

    /// Returns the newest IMU samples, oldest first; at most
    /// [`MAX_IMU`](vizflyt_protocol::packet::MAX_IMU).
    pub fn imu(&self) -> &VecDeque<ImuSample> {
        &self.imu
    }

    /// Whether heartbeats of the autopilot are received.
    pub fn is_connected(&self) -> bool {
        self.autopilot.is_some()
    }

    /// Returns the autopilot's system id.
    pub fn system(&self) -> Option<u8> {
        self.autopilot.map(|target| target.system)
    }

    /// Returns that several multirotors are on the link, and how to select one; `None` if one is selected.
    pub fn several(&self, now: HostTime) -> Option<String> {
        let mut systems = self.neighbors.multirotors(now);
        let ours = self.system().filter(|_| self.settings.system.is_none())?;
        let others = systems.len();
        systems.push(ours);
        systems.sort_unstable();
        let list = systems.iter().map(u8::to_string).collect::<Vec<_>>();
        let (last, first) = list.split_last().filter(|_| others > 0)?;
        Some(format!(
            "several multirotors are on this link, systems {} and {last}; select one with `system` of [vehicle] in \
             jetson.toml",
            first.join(", ")
        ))
    }

    /// Returns why a vehicle on the link cannot be flown, if it is the only one.
    pub fn wrong_vehicle(&self, now: HostTime) -> Option<String> {
        if self.is_connected() { None } else { self.neighbors.wrong_vehicle(now) }
    }

    /// Returns the autopilot's firmware, after the autopilot has reported it.
    pub fn firmware(&self) -> Option<Firmware> {
        self.firmware
    }

    /// Returns the last mode chosen by a pilot, a ground station or a failsafe after our mode was confirmed. Unless it
    /// is LAND, the link sends no more commands.
    pub fn taken_mode(&self) -> Option<u32> {
        self.own_mode.taken()
    }

    /// Whether the autopilot has accepted the take-off.
    pub fn took_off(&self) -> bool {
        self.took_off
    }

    /// Returns the offset between the autopilot's clock and ours.
    pub fn clock(&self) -> &OffsetFilter<Host, Autopilot> {
        &self.clock
    }

    /// Returns the parameters read so far, by name.
    pub fn params(&self) -> &BTreeMap<String, Param> {
        self.params.known()
    }

    /// Returns the vehicle's response to velocities according to the autopilot's parameters; `None` while they are
    /// unknown.
    pub fn response(&self) -> Option<Response> {
        self.dialect.response(self.params.known())
    }

    /// Whether parameters are being read or written.
    pub fn is_busy_with_params(&self) -> bool {
        self.params.is_busy()
    }

    /// Whether the upload of the fence is in progress.
    pub fn is_busy_with_fence(&self) -> bool {
        self.fence.is_under_way()
    }

    /// Returns the requested streams and their rates.
    pub fn rates(&self) -> impl Iterator<Item = Rate> + '_ {
        self.rates.rates()
    }

    /// Returns the latency of external navigation, once it is measured: this needs 5 s of poses and one reply of the
    /// autopilot's clock.
    pub fn delay(&self, now: HostTime) -> Option<Delay> {
        // About half of the best round trip.
        let link_s = self.clock.error_bound_ns(now)? as f64 * 1e-9;
        let measured_ms = self.feed.delay_ms(link_s)?;
        let parameter = self.dialect.delay_parameter();
        let set_ms = self.params.known().get(parameter).map(|param| param.value);
        Some(Delay { parameter, measured_ms, set_ms })
    }

    /// Returns the number of packets sent and received since the start.
    pub fn packets(&self) -> u64 {
        self.sent_packets + self.decoder.stats().packets
    }

    /// Returns the number of packets rejected for their signature, and of poses that were too old to send.
    pub fn refused(&self) -> (u64, u64) {
        (self.signatures.as_ref().map_or(0, Signatures::refused), self.feed.stale())
    }

    /// Whether the vehicle may be armed.
    ///
    /// # Errors
    /// Returns, as a sentence, the condition that arming waits for.
    pub fn ready_to_arm(&self, now: HostTime) -> Result<(), Cow<'static, str>> {
        match self.missing(now) {
            Some(missing) => Err(missing),
            None => Ok(()),
        }
    }

    // ---- internals ----

    fn send(&mut self, now: HostTime, message: &MavMessage) {
        if self.outbox.len() >= OUTBOX {
            self.outbox.pop_front();
        }
        let header = MavHeader {
            system_id: SYSTEM_ID.into(),
            component_id: COMPONENT_ID,
            sequence: self.sequence,
        };
        self.sequence = self.sequence.wrapping_add(1);
        let mut bytes = [0; MAX_PACKET];
        let mut len = encode(header, message, &mut bytes).len();
        if let Some(signatures) = &mut self.signatures {
            len = signatures.sign(now, &mut bytes, len);
        }
        self.outbox.push_back(Datagram { bytes, len });
        self.sent_packets += 1;
    }
}
