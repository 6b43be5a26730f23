//! The whole lab on one virtual clock: airframe, sensors, autopilot, mocap, referee. Sans-IO: the caller runs
//! [`Simulation::tick`] and transports the bytes.
//!
//! One tick is 2.5 ms: two physics steps, one sensor sample, one autopilot step, and every second time a mocap pose.
//! [`faults`] contains simulated failures.

pub mod faults;
mod hand;

use glam::{DQuat, DVec3};
use serde::Serialize;
use vizflyt_protocol::geometry::{Body, Pose, Volume, World};
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::AutopilotTime;

use crate::airframe::{Airframe, AirframeState};
pub use crate::autopilot::MAX_LINKS;
use crate::autopilot::{Autopilot, Radio, UnknownParam, airframe};
use crate::battery::Battery;
use crate::estimator::ALIGN_S;
use crate::imu::{Imu, ImuModel};
use crate::mocap::{Mocap, MocapConfig, Sight};
use crate::startup::Startup;
use crate::truth::{Truth, TruthReport};
use crate::wifi::{Wifi, WifiConfig};
use crate::wind::Wind;
use faults::{Due, Faults};

/// Ticks a second: the rate of ArduCopter's main loop [Hz].
pub const TICK_HZ: u64 = 400;
const TICK_NS: i64 = 1_000_000_000 / TICK_HZ.cast_signed();
pub(crate) const TICK_S: f64 = 1.0 / TICK_HZ as f64;
/// Physics steps per tick: 800 Hz.
const STEPS: u32 = 2;

/// Time for which a rebooting autopilot is silent [s].
const BOOT_S: f64 = 1.5;
/// Time powered before the start with [`Startup::Quick`] [s]: the estimator is aligned, and has stored the half second
/// that late measurements need.
const POWERED_S: f64 = ALIGN_S + 0.6;

/// Configuration of the lab.
#[derive(Clone, Debug)]
pub struct SimulationConfig {
    /// Start position of the vehicle; z is the floor [m, world].
    pub spawn_m: DVec3,
    /// Start yaw [rad, world].
    pub spawn_yaw_rad: f64,
    /// Seed of all noise.
    pub seed: u64,
    /// Obstacles of the virtual scene, only for the referee: the vehicle flies through them.
    pub obstacles: Vec<Volume>,
    /// Radius of the vehicle's body, for the referee [m].
    pub body_radius_m: f64,
    /// Motion capture; its seed is replaced by `seed`.
    pub mocap: MocapConfig,
    /// Whether a person carries the vehicle instead of a flight.
    pub hand: bool,
    /// Start-up behaviour of the autopilot.
    pub startup: Startup,
    /// Autopilot parameters that differ from the defaults.
    pub params: Vec<(String, f32)>,
    /// Steady wind [m/s, world].
    pub wind_world_mps: DVec3,
    /// Standard deviation of gusts along each horizontal axis [m/s].
    pub gust_mps: f64,
    /// Errors of the autopilot's inertial sensor.
    pub imu: ImuModel,
    /// Amplitude of vibration by the rotors at full throttle [m/s^2].
    pub vibration_mps2: f64,
    /// Charge of the battery at the start, 0 to 1.
    pub battery_share: f64,
    /// Whether a receiver is connected and its transmitter is on.
    pub radio: bool,
    /// Simulated failures.
    pub faults: Faults,
    /// Wi-Fi model for MAVLink; a cable if absent.
    pub wifi: Option<WifiConfig>,
}

impl SimulationConfig {
    /// Returns the default lab with the motion parameters of `hardware/airframe`.
    pub fn airframe() -> Self {
        Self { params: airframe(), ..Self::default() }
    }
}

impl Default for SimulationConfig {
    fn default() -> Self {
        Self {
            spawn_m: DVec3::ZERO,
            spawn_yaw_rad: 0.0,
            seed: 0,
            obstacles: Vec::new(),
            body_radius_m: 0.12,
            mocap: MocapConfig::default(),
            hand: false,
            startup: Startup::default(),
            params: Vec::new(),
            wind_world_mps: DVec3::ZERO,
            gust_mps: 0.0,
            imu: ImuModel::default(),
            vibration_mps2: 0.0,
            battery_share: 1.0,
            radio: false,
            faults: Faults::default(),
            wifi: None,
        }
    }
}

/// Final report of the simulation.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SimulationReport {
    /// Figures of the referee.
    #[serde(flatten)]
    pub truth: TruthReport,
    /// Horizontal error of the autopilot's estimate in flight, root mean square [m].
    pub estimate_error_m_rms: f64,
    /// Whether the vehicle is armed.
    pub armed: bool,
    /// ArduCopter's mode number.
    pub mode: u32,
    /// Simulated time since the start [s].
    pub seconds: f64,
    /// Received MAVLink packets.
    pub mavlink_packets_in: u64,
    /// Sent MAVLink packets.
    pub mavlink_packets_out: u64,
    /// MAVLink packets dropped because they were not sent in time.
    pub mavlink_packets_dropped: u64,
    /// Packets ignored because they were not signed with the autopilot's key.
    pub mavlink_packets_refused: u64,
    /// Sent mocap poses.
    pub mocap_poses: u64,
    /// MAVLink packets lost by the Wi-Fi model, in both directions.
    pub wifi_packets_lost: u64,
    /// Number of reboots of the autopilot.
    pub reboots: u32,
}

/// Simulated lab.
pub struct Simulation {
    now: AutopilotTime,
    /// Start of the autopilot's clock.
    booted_at: AutopilotTime,
    /// Time for which the autopilot ran before the start [ns].
    powered_ns: u64,
    reboots: u32,
    /// Wi-Fi model to and from the autopilot.
    wifi: Option<[Wifi; 2]>,
    airframe: Airframe,
    wind: Wind,
    faults: Faults,
    imu: Imu,
    battery: Battery,
    autopilot: Autopilot,
    mocap: Mocap,
    /// Start pose, if a person carries the vehicle.
    hand: Option<Pose<World, Body>>,
    truth: Truth,
    motors: [f64; 4],
    packets_out: u64,
    mocap_poses: u64,
    error_square_sum: f64,
    error_samples: u64,
}

impl Simulation {
    /// Places the vehicle and boots the autopilot.
    ///
    /// # Errors
    /// Returns the first parameter name that the autopilot does not have.
    pub fn new(config: SimulationConfig) -> Result<Self, UnknownParam> {
        let mut imu = Imu::new(config.imu, config.seed);
        imu.set_vibration(config.vibration_mps2);
        let mut autopilot = Autopilot::with_params(&config.params)?;
        autopilot.set_radio(if config.radio { Radio::Receiving } else { Radio::Absent });
        autopilot.set_startup(config.startup);
        let mut simulation = Self {
            now: AutopilotTime::ZERO,
            booted_at: AutopilotTime::ZERO,
            powered_ns: 0,
            reboots: 0,
            airframe: Airframe::standing(config.spawn_m, config.spawn_yaw_rad),
            wind: Wind::new(config.seed, config.wind_world_mps, config.gust_mps),
            faults: config.faults,
            wifi: config.wifi.map(|wifi| [Wifi::new(wifi, 0), Wifi::new(wifi, 1)]),
            imu,
            battery: Battery::charged(config.battery_share),
            autopilot,
            hand: config
                .hand
                .then(|| Pose::new(config.spawn_m, DQuat::from_rotation_z(config.spawn_yaw_rad))),
            mocap: Mocap::new(MocapConfig { seed: config.seed, ..config.mocap }),
            truth: Truth::new(&config.obstacles, config.body_radius_m, config.spawn_m.z),
            motors: [0.0; 4],
            packets_out: 0,
            mocap_poses: 0,
            error_square_sum: 0.0,
            error_samples: 0,
        };
        if config.startup == Startup::Quick {
            simulation.stand_powered();
        }
        Ok(simulation)
    }

    /// Runs the autopilot of the standing vehicle before the start, without sending.
    fn stand_powered(&mut self) {
        let state = *self.airframe.state();
        let felt_body = self.airframe.specific_force_body_mps2();
        for _ in 0..(POWERED_S * TICK_HZ as f64) as u64 {
            self.powered_ns += TICK_NS.unsigned_abs();
            let mut sample = self.imu.sample(
                felt_body,
                state.omega_body_radps,
                state.p_world_m.z,
                state.rotor_speed,
                TICK_S,
            );
            sample.battery_v = self.battery.voltage_v();
            self.motors = self.autopilot.handle_sensors(self.autopilot_now(), &sample, TICK_S);
        }
    }

    /// Returns the time since the start.
    pub fn now(&self) -> AutopilotTime {
        self.now
    }

    /// Returns the true state of the vehicle.
    pub fn state(&self) -> &AirframeState {
        self.airframe.state()
    }

    pub fn autopilot(&self) -> &Autopilot {
        &self.autopilot
    }

    /// Returns the time on the autopilot's clock, which restarts at 0 when it reboots.
    pub fn autopilot_now(&self) -> AutopilotTime {
        let since_ns = self.now.as_ns().saturating_sub(self.booted_at.as_ns());
        AutopilotTime::from_ns(since_ns + self.powered_ns)
    }

    fn since_start_s(&self) -> f64 {
        self.now.seconds_since(AutopilotTime::ZERO)
    }

    /// Sets the steady wind [m/s, world].
    pub fn set_wind(&mut self, wind_world_mps: DVec3) {
        self.wind.set_steady(wind_world_mps);
    }

    /// Reduces the thrust of a motor (ArduCopter's order, from 0) to this share.
    pub fn break_motor(&mut self, motor: usize, share: f64) {
        self.airframe.break_motor(motor, share);
    }

    /// Sets the state of the radio-control receiver.
    pub fn set_radio(&mut self, radio: Radio) {
        self.autopilot.set_radio(radio);
    }

    /// Interrupts the autopilot's power: motors stop, it loses all state except stored parameters, fence and key, and
    /// is silent for [`BOOT_S`].
    pub fn reboot(&mut self) {
        tracing::info!(target: "autopilot", "reboots");
        self.autopilot = self.autopilot.rebooted();
        self.motors = [0.0; 4];
        self.booted_at = self.now.plus_seconds(BOOT_S);
        self.powered_ns = 0;
        self.reboots += 1;
    }

    fn is_booting(&self) -> bool {
        self.now < self.booted_at
    }

    /// Takes bytes of a MAVLink link, one of [`MAX_LINKS`]. Each link is a separate stream; sent packets go to all.
    pub fn handle_mavlink(&mut self, link: usize, bytes: &[u8]) {
        match &mut self.wifi {
            Some([up, _]) => up.send(self.now, link, bytes),
            None => self.deliver(link, bytes),
        }
    }

    fn deliver(&mut self, link: usize, bytes: &[u8]) {
        if !self.is_booting() {
            self.autopilot.handle_input(self.autopilot_now(), link, bytes);
        }
    }

    /// Returns the next MAVLink packet to send.
    pub fn poll_mavlink<'a>(&mut self, buffer: &'a mut [u8; MAX_PACKET]) -> Option<&'a [u8]> {
        let Some([_, down]) = &mut self.wifi else {
            let packet = self.autopilot.poll_transmit(buffer)?;
            self.packets_out += 1;
            return Some(packet);
        };
        while let Some(packet) = self.autopilot.poll_transmit(buffer) {
            down.send(self.now, 0, packet);
            self.packets_out += 1;
        }
        let (_, packet) = down.poll(self.now)?;
        let whole = buffer.get_mut(..packet.len())?;
        whole.copy_from_slice(&packet);
        Some(whole)
    }

    /// Returns the next pose that the motion capture sends.
    pub fn poll_mocap(&mut self) -> Option<Sight> {
        let sight = self.mocap.poll_transmit(self.now)?;
        self.mocap_poses += 1;
        Some(sight)
    }

    /// Returns the vehicle's name in the motion capture.
    pub fn object(&self) -> &str {
        self.mocap.object()
    }

    /// Returns the true pose of the vehicle.
    pub fn true_pose(&self) -> Pose<World, Body> {
        self.airframe.state().pose()
    }

    /// Advances by one tick of 2.5 ms.
    pub fn tick(&mut self) {
        let dt_s = TICK_S / f64::from(STEPS);
        let mut felt_body = DVec3::ZERO;
        let mut omega_body = DVec3::ZERO;
        self.airframe.set_wind(self.wind.tick(TICK_S));
        for _ in 0..STEPS {
            omega_body += self.airframe.state().omega_body_radps / 2.0;
            self.airframe.tick(self.motors, dt_s);
            felt_body += self.airframe.specific_force_body_mps2();
            omega_body += self.airframe.state().omega_body_radps / 2.0;
            let (armed, mode) = (self.autopilot.is_armed(), self.autopilot.mode());
            self.truth.tick(self.airframe.state(), armed, mode, dt_s);
        }
        self.now = self.now.plus_ns(TICK_NS);
        let state = *self.airframe.state();
        self.battery.tick(state.rotor_speed, TICK_S);

        let steps = f64::from(STEPS);
        let (felt_body, omega_body) = match &self.hand {
            // In a hand, the IMU measures the hand's motion, without contact to the floor.
            Some(world_from_start) => hand::felt(world_from_start, self.since_start_s(), TICK_S),
            None => (felt_body / steps, omega_body / steps),
        };
        let mut sample =
            self.imu.sample(felt_body, omega_body, state.p_world_m.z, state.rotor_speed, TICK_S);
        sample.battery_v = self.battery.voltage_v();
        sample.battery_a = self.battery.current_a();
        if !self.is_booting() {
            let now = self.autopilot_now();
            self.motors = self.autopilot.handle_sensors(now, &sample, TICK_S);
            self.autopilot.handle_timeout(now);
            if self.autopilot.wants_reboot() {
                self.reboot();
            }
        }
        while let Some((link, packet)) = self.wifi.as_mut().and_then(|[up, _]| up.poll(self.now)) {
            self.deliver(link, &packet);
        }
        while let Some(due) = self.faults.due(self.truth.since_take_off_s()) {
            match due {
                Due::Motor { motor, share } => self.break_motor(motor, share),
                Due::Radio => self.set_radio(Radio::Lost),
                Due::Reboot => self.reboot(),
            }
        }
        let seen = match self.hand {
            Some(world_from_start) => hand::carried(&world_from_start, self.since_start_s()),
            None => state.pose(),
        };
        self.mocap.handle_truth(self.now, &seen);

        if self.autopilot.is_armed() && !self.autopilot.is_landed() {
            let error = self.autopilot.estimator().estimate().p_world_m - state.p_world_m;
            self.error_square_sum += error.truncate().length_squared();
            self.error_samples += 1;
        }
    }

    /// Returns the present figures.
    pub fn report(&self) -> SimulationReport {
        SimulationReport {
            truth: self.truth.report(),
            estimate_error_m_rms: (self.error_square_sum / (self.error_samples.max(1)) as f64)
                .sqrt(),
            armed: self.autopilot.is_armed(),
            mode: self.autopilot.mode() as u32,
            seconds: self.now.seconds_since(AutopilotTime::ZERO),
            mavlink_packets_in: self.autopilot.packets_in(),
            mavlink_packets_out: self.packets_out,
            mavlink_packets_dropped: self.autopilot.outbox_dropped(),
            mavlink_packets_refused: self.autopilot.packets_refused(),
            mocap_poses: self.mocap_poses,
            wifi_packets_lost: self.wifi.iter().flatten().map(Wifi::lost).sum(),
            reboots: self.reboots,
        }
    }
}

#[cfg(test)]
pub(crate) mod companion;
#[cfg(test)]
mod tests;
