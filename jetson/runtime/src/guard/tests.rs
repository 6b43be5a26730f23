use glam::{DQuat, DVec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::{
    ArenaInfo, Axes, COEFFICIENTS, Limits, Path, PathYaw, Piece, Trajectory, Waypoint,
};

use super::limits::{FENCE_EXCESS, GRAVITY_MPS2, acceleration_within_tilt_mps2};
use super::velocity::MAX_YAW_RATE_RADPS;
use super::*;

const TICK_S: f64 = 0.02;
/// Response of a [`Vehicle`].
const QUICK: Option<Response> = Some(Response::smooth(0.2, 80.0));

fn arena(geofence: Volume, max_speed_mps: f64, max_acceleration_mps2: f64) -> ArenaInfo {
    ArenaInfo {
        body_radius_m: 0.12,
        pose_ages: PoseAges { hold_after_s: 0.5, land_after_s: 2.0 },
        setpoints: SetpointKinds::ALL,
        ..ArenaInfo::new("test", geofence, Limits::new(max_speed_mps, max_acceleration_mps2))
    }
}

fn room() -> Volume {
    Volume::aabb(DVec3::new(-5.0, -3.0, 0.0), DVec3::new(5.0, 3.0, 4.0))
}

/// Vehicle that follows velocity commands with delay, first-order lag, limited acceleration and jerk.
struct Vehicle {
    response: Response,
    p_m: DVec3,
    v_mps: DVec3,
    yaw_rad: f64,
    max_acceleration_mps2: f64,
    /// Acceleration in the last tick. [m/s^2]
    a_mps2: DVec3,
    delayed: std::collections::VecDeque<DVec3>,
}

/// Ticks from a command to the vehicle's first response.
const DELAY_TICKS: usize = 2;
/// Small quadrotor with an autopilot that does not shape commands.
const UNSHAPED: Response = Response::smooth(0.12, f64::INFINITY);

impl Vehicle {
    fn new(p_m: DVec3, max_acceleration_mps2: f64) -> Self {
        let delayed = [DVec3::ZERO; DELAY_TICKS].into();
        let (v_mps, a_mps2) = (DVec3::ZERO, DVec3::ZERO);
        let response = UNSHAPED;
        Self { response, p_m, v_mps, yaw_rad: 0.3, max_acceleration_mps2, a_mps2, delayed }
    }

    fn fly(&mut self, v_command_mps: DVec3) {
        self.delayed.push_back(v_command_mps);
        let v_command_mps = self.delayed.pop_front().unwrap();
        let Response { lag_s, jerk_mps3, acceleration_mps2 } = self.response;
        let most_mps2 = self.max_acceleration_mps2.min(acceleration_mps2);
        let wanted = ((v_command_mps - self.v_mps) / lag_s).clamp_length_max(most_mps2);
        let a = self.a_mps2 + (wanted - self.a_mps2).clamp_length_max(jerk_mps3 * TICK_S);
        self.p_m += self.v_mps * TICK_S + 0.5 * a * TICK_S * TICK_S;
        self.v_mps += a * TICK_S;
        self.a_mps2 = a;
    }

    /// Angle of the thrust from vertical.
    fn tilt_deg(&self) -> f64 {
        (self.a_mps2 + DVec3::Z * GRAVITY_MPS2).angle_between(DVec3::Z).to_degrees()
    }

    fn motion(&self, stamp: HostTime) -> VehicleMotion {
        let rotation = DQuat::from_rotation_z(self.yaw_rad);
        VehicleMotion {
            stamp,
            p_world_m: self.p_m,
            v_world_mps: self.v_mps,
            rotation,
            sigma_m: 0.0,
            allowance_s: 0.0,
        }
    }
}

fn time(tick: usize) -> HostTime {
    HostTime::from_ns(1_000_000_000 + tick as u64 * 20_000_000)
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        8 => -12.0..12.0f64,
        1 => prop::num::f64::ANY,
        1 => Just(f64::NAN),
    ]
}

fn vector() -> impl Strategy<Value = DVec3> {
    (number(), number(), number()).prop_map(|(x, y, z)| DVec3::new(x, y, z))
}

fn setpoint() -> impl Strategy<Value = Setpoint> {
    let yaw = || {
        prop_oneof![
            Just(YawTarget::Keep),
            number().prop_map(YawTarget::Angle),
            number().prop_map(YawTarget::Rate),
        ]
    };
    let axes = || prop_oneof![Just(Axes::World), Just(Axes::Heading), Just(Axes::Body)];
    prop_oneof![
        1 => Just(Setpoint::Hold),
        1 => Just(Setpoint::TakeOff),
        2 => (vector(), yaw()).prop_map(|(p_world_m, yaw)| Setpoint::Position { p_world_m, yaw }),
        4 => (vector(), axes(), yaw())
            .prop_map(|(v_mps, axes, yaw)| Setpoint::Velocity { v_mps, axes, yaw }),
        2 => (vector(), axes(), yaw())
            .prop_map(|(a_mps2, axes, yaw)| Setpoint::Acceleration { a_mps2, axes, yaw }),
        2 => (vector(), axes(), yaw()).prop_map(|(d_m, axes, yaw)| Setpoint::Offset { d_m, axes, yaw }),
        2 => (vector(), number())
            .prop_map(|(omega_body_radps, thrust)| Setpoint::AttitudeRate { omega_body_radps, thrust }),
        2 => (path(), axes(), yaw(), any::<bool>(), 0..3u32).prop_map(|(path, axes, yaw, ahead, id)| {
            let yaw = if ahead { PathYaw::Ahead } else { PathYaw::Target(yaw) };
            Setpoint::Trajectory(Trajectory { id, axes, path, yaw })
        }),
    ]
}

fn path() -> impl Strategy<Value = Path> {
    let waypoint = (vector(), number()).prop_map(|(p_m, speed_mps)| Waypoint { p_m, speed_mps });
    let piece = (0.1..3.0f64, prop::array::uniform8(vector()))
        .prop_map(|(seconds, coefficients)| Piece { seconds, coefficients });
    let calm = (0.5..3.0f64, vector(), vector()).prop_map(|(seconds, p_m, v_mps)| {
        let mut coefficients = [DVec3::ZERO; COEFFICIENTS];
        (coefficients[0], coefficients[1]) = (p_m, v_mps);
        Piece { seconds, coefficients }
    });
    prop_oneof![
        prop::collection::vec(waypoint, 0..6)
            .prop_map(|v| Path::Waypoints(v.into_iter().collect())),
        prop::collection::vec(prop_oneof![piece, calm], 0..4)
            .prop_map(|v| Path::Polynomial(v.into_iter().collect())),
    ]
}

/// Number of random flights: `VIZFLYT_GUARD_CASES`, 10,000 in `tests/run`.
fn cases() -> u32 {
    std::env::var("VIZFLYT_GUARD_CASES").ok().and_then(|n| n.parse().ok()).unwrap_or(5_000)
}

fn volume() -> impl Strategy<Value = Volume> {
    prop_oneof![
        3 => Just(room()),
        1 => Just(Volume::Cuboid {
            center_m: DVec3::new(0.0, 0.0, 2.0),
            half_m: DVec3::new(6.0, 3.0, 2.0),
            rotation: DQuat::from_rotation_z(0.6),
        }),
        1 => Just(Volume::Sphere { center_m: DVec3::Z * 2.0, radius_m: 4.0 }),
        1 => Just(Volume::Capsule {
            a_m: DVec3::new(-4.0, 0.0, 2.0),
            b_m: DVec3::new(4.0, 1.0, 2.0),
            radius_m: 2.5,
        }),
    ]
}

/// Boxes in the room, away from the vehicle's start.
fn no_fly() -> impl Strategy<Value = Vec<Volume>> {
    let corner = (-5.0..5.0f64, -3.0..3.0f64, -1.0..4.0f64);
    let side = (0.05..2.0f64, 0.05..2.0f64, 0.05..3.0f64);
    let keep_out = (corner, side).prop_map(|(corner, side)| {
        let min_m = DVec3::from(corner);
        Volume::aabb(min_m, min_m + DVec3::from(side))
    });
    let start_m = DVec3::Z * 2.0;
    let away = move |volume: &Volume| volume.signed_distance_m(start_m) > 0.5;
    prop_oneof![
        Just(Vec::new()),
        prop::collection::vec(keep_out.prop_filter("the vehicle starts there", away), 1..4),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: cases(), ..ProptestConfig::default() })]

    /// For all setpoints of a plugin, the vehicle stays inside, the limits hold, and no NaN is sent.
    #[test]
    fn stays_inside_and_within_limits_for_any_setpoints(
        geofence in volume(),
        max_speed_mps in 0.5..8.0f64,
        max_acceleration_mps2 in 2.0..10.0f64,
        max_tilt_deg in prop::option::of(12.0..60.0f64),
        max_altitude_m in prop::option::of(2.4..6.0f64),
        floor_z_m in -3.0..1.5f64,
        no_fly in no_fly(),
        asked in prop::collection::vec((setpoint(), 1usize..60), 1..10),
    ) {
        let mut arena = arena(geofence, max_speed_mps, max_acceleration_mps2);
        (arena.limits.max_tilt_deg, arena.limits.max_altitude_m) = (max_tilt_deg, max_altitude_m);
        (arena.floor_z_m, arena.no_fly) = (floor_z_m, no_fly.iter().copied().collect());
        // The vehicle could accelerate more than the limits allow.
        let mut vehicle = Vehicle::new(DVec3::Z * 2.0, 3.0 * max_acceleration_mps2);
        let mut guard = Guard::new(&arena, &vehicle.motion(time(0)), QUICK, time(0), 7);
        let mut v_before = DVec3::ZERO;
        let mut tick = 0;
        for (setpoint, ticks) in asked {
            for _ in 0..ticks {
                tick += 1;
                let _ = guard.handle_setpoint(time(tick), setpoint.clone());
                // The pose is 20 ms old, as over a network.
                let (output, mode) = guard.tick(time(tick), &vehicle.motion(time(tick - 1)));
                let GuardOutput::Guided(guided) = output else {
                    // Two seconds of NaN count as two seconds without a setpoint.
                    let silent = matches!(mode, GuardMode::Landing(LandReason::NoSetpoint(_)));
                    prop_assert!(silent, "{mode:?}");
                    return Ok(());
                };
                let GuidedMotion::Velocity(v) = guided.motion else { panic!("not a velocity") };
                prop_assert!(v.is_finite());
                let turns = match guided.yaw {
                    YawTarget::Angle(yaw) => yaw.abs() <= std::f64::consts::PI + 1e-9,
                    YawTarget::Rate(rate) => rate.abs() <= MAX_YAW_RATE_RADPS,
                    YawTarget::Keep => false,
                };
                prop_assert!(turns, "{guided:?}");
                prop_assert!(v.length() <= max_speed_mps + 1e-9);
                let change_mps2 = (v - v_before).length() / TICK_S;
                // If slew limit and fence contradict, the fence wins: at flat faces within FENCE_EXCESS, at curved
                // faces without a bound.
                let flat = matches!(geofence, Volume::Cuboid { .. }) && no_fly.is_empty();
                let most_mps2 = FENCE_EXCESS * acceleration_within_tilt_mps2(&arena.limits);
                prop_assert!(!flat || change_mps2 <= most_mps2 + 1e-9, "{change_mps2}");
                v_before = v;
                vehicle.fly(v);
                let outside_m = geofence.signed_distance_m(vehicle.p_m) + arena.body_radius_m;
                prop_assert!(outside_m <= 0.0, "{outside_m} m outside at {}", vehicle.p_m);
                prop_assert!(vehicle.p_m.z - arena.body_radius_m >= floor_z_m, "{}", vehicle.p_m);
                for volume in &no_fly {
                    let free_m = volume.signed_distance_m(vehicle.p_m) - arena.body_radius_m;
                    prop_assert!(free_m >= 0.0, "{free_m} m from {volume:?} at {}", vehicle.p_m);
                }
                prop_assert!(vehicle.v_mps.length() <= max_speed_mps + 1e-9);
                let tilts = max_tilt_deg.is_some_and(|most| vehicle.tilt_deg() > most + 1e-6);
                prop_assert!(!flat || !tilts, "{} deg", vehicle.tilt_deg());
                let climbs = max_altitude_m.is_some_and(|most| vehicle.p_m.z > most);
                prop_assert!(!climbs, "at {}", vehicle.p_m);
            }
        }
        // Hold is possible from every state, and it stops the vehicle.
        for _ in 0..300 {
            tick += 1;
            guard.handle_setpoint(time(tick), Setpoint::Hold).unwrap();
            let (output, mode) = guard.tick(time(tick), &vehicle.motion(time(tick)));
            prop_assert!(matches!(mode, GuardMode::Holding(HoldReason::Requested)), "{mode:?}");
            let v = output_velocity(output);
            vehicle.fly(v);
        }
        prop_assert!(vehicle.v_mps.length() < 0.1, "{}", vehicle.v_mps);
        // Landing is also possible from every state.
        guard.handle_setpoint(time(tick), Setpoint::Land).unwrap();
        let (output, _) = guard.tick(time(tick + 1), &vehicle.motion(time(tick + 1)));
        prop_assert_eq!(output, GuardOutput::Land);
    }
}

/// Lags and jerks of vehicles.
fn response() -> impl Strategy<Value = Response> {
    // Most jerks are small: with them the vehicle needs the longest distance to stop.
    (0.2..1.0f64, (3f64.ln()..80f64.ln()).prop_map(f64::exp))
        .prop_map(|(lag_s, jerk_mps3)| Response::smooth(lag_s, jerk_mps3))
}

/// Response that the guard receives as the vehicle's parameters.
#[derive(Clone, Copy, Debug)]
enum Told {
    /// The true response.
    Truth,
    /// No response.
    Nothing,
    /// Response of a vehicle configured with `hardware/airframe`.
    Wrong,
}

fn told() -> impl Strategy<Value = Told> {
    prop_oneof![Just(Told::Truth), Just(Told::Nothing), Just(Told::Wrong)]
}

impl Told {
    fn response(self, truth: Response) -> Option<Response> {
        match self {
            Self::Truth => Some(truth),
            Self::Nothing => None,
            Self::Wrong => Some(Response::of_ardupilot(20.0, 5.0)),
        }
    }
}

/// Localization with a latency of some ticks.
struct Late(std::collections::VecDeque<VehicleMotion>);

impl Late {
    fn new(ticks: usize, vehicle: &Vehicle) -> Self {
        Self((1..ticks).map(|_| vehicle.motion(time(0))).collect())
    }

    /// Returns the newest pose at a tick: the state at the end of the tick before, delayed.
    fn motion(&mut self, tick: usize, vehicle: &Vehicle) -> VehicleMotion {
        self.0.push_back(vehicle.motion(time(tick - 1)));
        self.0.pop_front().unwrap()
    }
}

/// Ticks from a measurement to its pose: up to 0.2 s.
fn delay() -> impl Strategy<Value = usize> {
    1usize..=10
}

proptest! {
    #![proptest_config(ProptestConfig { cases: cases() / 5, ..ProptestConfig::default() })]

    /// At 3 m/s into each face, through a long room: the body never leaves the fence, even if the vehicle responds
    /// late. Wrong parameters are detected during the flight.
    #[test]
    fn a_late_vehicle_stops_before_each_face(
        truth in response(), told in told(), face in 0usize..6, aside in -1.0..1.0f64, delay in delay(),
    ) {
        let room = Volume::aabb(DVec3::splat(-11.0), DVec3::splat(11.0));
        let arena = ArenaInfo { floor_z_m: -11.0, ..arena(room, 3.0, 6.0) };
        let out = [DVec3::X, DVec3::Y, DVec3::Z][face / 2] * [1.0, -1.0][face % 2];
        let mut vehicle = Vehicle::new(-out * 10.0, 6.0);
        vehicle.response = truth;
        let mut late = Late::new(delay, &vehicle);
        let start = vehicle.motion(time(0));
        let mut guard = Guard::new(&arena, &start, told.response(truth), time(0), 7);
        let (mut fastest_mps, mut nearest_m) = (0.0f64, f64::INFINITY);
        for tick in 1..1500 {
            let v_mps = out * 3.0 + out.any_orthonormal_vector() * aside;
            guard.handle_setpoint(time(tick), velocity(v_mps)).unwrap();
            let (output, mode) = guard.tick(time(tick), &late.motion(tick, &vehicle));
            prop_assert_eq!(mode, GuardMode::Following);
            vehicle.fly(output_velocity(output));
            fastest_mps = fastest_mps.max(vehicle.v_mps.length());
            let inside_m = -room.signed_distance_m(vehicle.p_m) - arena.body_radius_m;
            nearest_m = nearest_m.min(inside_m);
            prop_assert!(inside_m >= 0.0, "{inside_m} m inside, {:?}", guard.sight.answers.response());
        }
        // The vehicle also reaches the face.
        let near_m = if matches!(told, Told::Truth) { 0.5 } else { 1.0 };
        prop_assert!(nearest_m < near_m, "{nearest_m} m from it, at {fastest_mps} m/s at most");
    }

    /// Late vehicles with random setpoints.
    #[test]
    fn late_vehicles_stay_inside_for_any_setpoints(
        geofence in volume(),
        truth in response(),
        known in any::<bool>(),
        no_fly in no_fly(),
        asked in prop::collection::vec((setpoint(), 1usize..90), 1..10),
        delay in delay(),
    ) {
        let mut arena = arena(geofence, 3.0, 6.0);
        arena.no_fly = no_fly.iter().copied().collect();
        let mut vehicle = Vehicle::new(DVec3::Z * 2.0, 6.0);
        vehicle.response = truth;
        let mut late = Late::new(delay, &vehicle);
        let told = known.then_some(truth);
        let mut guard = Guard::new(&arena, &vehicle.motion(time(0)), told, time(0), 7);
        let mut tick = 0;
        for (setpoint, ticks) in asked {
            for _ in 0..ticks {
                tick += 1;
                let _ = guard.handle_setpoint(time(tick), setpoint.clone());
                let (output, mode) = guard.tick(time(tick), &late.motion(tick, &vehicle));
                let GuardOutput::Guided(_) = output else {
                    let silent = matches!(mode, GuardMode::Landing(LandReason::NoSetpoint(_)));
                    prop_assert!(silent, "{mode:?}");
                    return Ok(());
                };
                vehicle.fly(output_velocity(output));
                let outside_m = geofence.signed_distance_m(vehicle.p_m) + arena.body_radius_m;
                prop_assert!(outside_m <= 0.0, "{outside_m} m outside at {}", vehicle.p_m);
                for volume in &no_fly {
                    let free_m = volume.signed_distance_m(vehicle.p_m) - arena.body_radius_m;
                    prop_assert!(free_m >= 0.0, "{free_m} m from {volume:?} at {}", vehicle.p_m);
                }
            }
        }
    }
}

/// The parameters are used while the flight agrees with them; a later response is detected and reported.
#[test]
fn a_lag_is_measured_and_lowers_the_speed_limit() {
    let fly = |truth: Response, told: Option<Response>| {
        let arena = arena(Volume::aabb(DVec3::splat(-50.0), DVec3::splat(50.0)), 3.0, 6.0);
        let mut vehicle = Vehicle::new(DVec3::ZERO, 6.0);
        vehicle.response = truth;
        let mut guard = Guard::new(&arena, &vehicle.motion(time(0)), told, time(0), 7);
        for tick in 1..300 {
            let side = if tick / 60 % 2 == 0 { 2.0 } else { -1.0 };
            guard.handle_setpoint(time(tick), velocity(DVec3::X * side)).unwrap();
            let (output, _) = guard.tick(time(tick), &vehicle.motion(time(tick - 1)));
            vehicle.fly(output_velocity(output));
        }
        guard
    };
    let airframe = Response::of_ardupilot(20.0, 5.0);
    let late = Response::smooth(0.9, 5.0);
    // The parameters are right: no reduction.
    let guard = fly(airframe, Some(airframe));
    assert!(!guard.sight.answers.is_measured() && guard.lagging().is_none());
    // The parameters are wrong.
    let lagging = fly(late, Some(airframe)).lagging().expect("it answers late");
    assert!(lagging.measured && (0.8..1.6).contains(&lagging.response.lag_s), "{lagging:?}");
    assert!((0.3..0.65).contains(&lagging.share), "{lagging:?}");
    // Unknown parameters and a quick vehicle: the reduction ends.
    let guard = fly(airframe, None);
    assert!(
        guard.sight.answers.is_measured() && guard.lagging().is_none(),
        "{:?}",
        guard.lagging()
    );
    let lagging = fly(late, None).lagging().expect("it answers late");
    assert!(lagging.response.lag_s >= 0.8, "{lagging:?}");
    // A held vehicle gives no information about its response.
    let arena = arena(room(), 3.0, 4.0);
    let mut held = Guard::new(&arena, &at_rest(0), QUICK, time(0), 7);
    for tick in 1..500 {
        held.handle_setpoint(time(tick), velocity(DVec3::X)).unwrap();
        held.tick(time(tick), &at_rest(tick));
    }
    assert!(held.lagging().is_none());
}

/// A vehicle at rest in the middle of the room.
fn at_rest(tick: usize) -> VehicleMotion {
    Vehicle::new(DVec3::Z * 2.0, 4.0).motion(time(tick))
}

fn guard() -> Guard {
    Guard::new(&arena(room(), 3.0, 4.0), &at_rest(0), QUICK, time(0), 7)
}

fn velocity(v_mps: DVec3) -> Setpoint {
    Setpoint::velocity(v_mps, YawTarget::Keep)
}

fn output_velocity(output: GuardOutput) -> DVec3 {
    match output {
        GuardOutput::Guided(GuidedSetpoint { motion: GuidedMotion::Velocity(v), .. }) => v,
        other => panic!("{other:?} is not a velocity"),
    }
}

#[test]
fn silence_holds_then_lands() {
    let mut guard = guard();
    guard.handle_setpoint(time(1), velocity(DVec3::X)).unwrap();
    let mode = |guard: &mut Guard, tick| guard.tick(time(tick), &at_rest(tick)).1;
    assert_eq!(mode(&mut guard, 2), GuardMode::Following);
    assert_eq!(mode(&mut guard, 26), GuardMode::Following, "0.5 s");
    assert_eq!(mode(&mut guard, 27), GuardMode::Holding(HoldReason::NoSetpoint));
    assert_eq!(mode(&mut guard, 101), GuardMode::Holding(HoldReason::NoSetpoint), "2 s");
    assert!(matches!(mode(&mut guard, 102), GuardMode::Landing(LandReason::NoSetpoint(_))));
    // Final: setpoints of a plugin that resumes are ignored.
    guard.handle_setpoint(time(103), velocity(DVec3::X)).unwrap();
    assert_eq!(guard.tick(time(103), &at_rest(103)).0, GuardOutput::Land);
}

#[test]
fn lands_if_the_plugin_never_replies() {
    let mut guard = guard();
    let (output, mode) = guard.tick(time(101), &at_rest(101));
    assert!(matches!(mode, GuardMode::Landing(LandReason::NoSetpoint(s)) if s > 2.0));
    assert_eq!(output, GuardOutput::Land);
}

#[test]
fn rejects_numbers_that_are_not_finite() {
    let mut guard = guard();
    for tick in 1..=27 {
        assert!(
            guard.handle_setpoint(time(tick), velocity(DVec3::new(0.0, f64::NAN, 0.0))).is_err()
        );
        assert!(
            guard
                .handle_setpoint(
                    time(tick),
                    Setpoint::velocity(DVec3::ZERO, YawTarget::Rate(1.0 / 0.0))
                )
                .is_err()
        );
    }
    assert_eq!(guard.tick(time(27), &at_rest(27)).1, GuardMode::Holding(HoldReason::NoSetpoint));
}

#[test]
fn old_images_slow_then_hold_then_land() {
    let mut guard = guard();
    // The plugin always requests more than the limit, at 50 Hz, while the age of the images rises.
    let seen_at = time(0);
    let (mut flown_mps, mut modes) = (Vec::new(), Vec::new());
    for tick in 1..=140 {
        guard.handle_setpoint(time(tick), velocity(DVec3::X * 100.0)).unwrap();
        guard.see(Some(seen_at));
        guard.see(None);
        let (output, mode) = guard.tick(time(tick), &at_rest(tick));
        let age_s = time(tick).seconds_since(seen_at);
        match mode {
            GuardMode::Following => {
                let v_mps = output_velocity(output).length();
                assert!(v_mps * age_s <= 3.0 * SIGHT_FRESH_S + 0.05, "{age_s} {v_mps}");
                let slowed = guard.slowed();
                assert_eq!(slowed.is_some(), age_s > SIGHT_FRESH_S / 0.8, "{age_s} {slowed:?}");
                flown_mps.push(v_mps);
            }
            GuardMode::Holding(HoldReason::ImagesOld) => assert!(age_s > SIGHT_HOLD_S),
            GuardMode::Landing(LandReason::ImagesOld(old_s)) => {
                // The reason is latched.
                assert!(old_s <= age_s && old_s > SIGHT_HOLD_S + SIGHT_LAND_S, "{old_s}");
            }
            other => panic!("{other:?}"),
        }
        modes.push(std::mem::discriminant(&mode));
    }
    modes.dedup();
    assert_eq!(modes.len(), 3, "each once, and in this order");
    assert!(flown_mps.len() > 30 && *flown_mps.last().unwrap() < 0.25 * 3.0);

    // With fresh images the vehicle follows again.
    let mut guard = self::guard();
    for tick in 1..=100 {
        guard.handle_setpoint(time(tick), velocity(DVec3::X)).unwrap();
        guard.see(Some(if tick > 60 { time(tick) } else { time(0) }));
        let (_, mode) = guard.tick(time(tick), &at_rest(tick));
        let holds = mode == GuardMode::Holding(HoldReason::ImagesOld);
        // At tick 35 the age is 0.7 s up to rounding.
        assert!(tick == 35 || holds == (36..=60).contains(&tick), "{tick} {mode:?}");
    }
}

#[test]
fn an_unsure_pose_holds_then_lands() {
    // 3 x 0.06 m fits into the margin of 0.2 m, 3 x 0.07 m does not.
    let unsure = |tick, sigma_m| VehicleMotion { sigma_m, ..at_rest(tick) };
    let mut guard = guard();
    for tick in 1..=60 {
        guard.handle_setpoint(time(tick), velocity(DVec3::X)).unwrap();
        let sigma_m = if (11..=30).contains(&tick) { 0.07 } else { 0.06 };
        let (_, mode) = guard.tick(time(tick), &unsure(tick, sigma_m));
        let holds = mode == GuardMode::Holding(HoldReason::PoseUnsure);
        assert!(holds == (11..=30).contains(&tick), "{tick} {mode:?}");
    }
    // At most a few ticks later than `land_after_s`.
    let lands = (61..200).find(|&tick| {
        guard.handle_setpoint(time(tick), velocity(DVec3::X)).unwrap();
        guard.tick(time(tick), &unsure(tick, 0.5)).0 == GuardOutput::Land
    });
    let land_after_s = arena(room(), 3.0, 4.0).pose_ages.land_after_s;
    let took_s = time(lands.unwrap()).seconds_since(time(61));
    assert!((land_after_s..land_after_s + 0.05).contains(&took_s), "{took_s}");
}

#[test]
fn a_stale_pose_holds_then_lands() {
    let mut guard = guard();
    for tick in 1..=102 {
        guard.handle_setpoint(time(tick), velocity(DVec3::X)).unwrap();
        let (output, mode) = guard.tick(time(tick), &at_rest(1));
        match tick {
            1..=26 => assert_eq!(mode, GuardMode::Following),
            27..=101 => assert_eq!(mode, GuardMode::Holding(HoldReason::PoseStale)),
            _ => assert!(matches!(mode, GuardMode::Landing(LandReason::PoseLost(_)))),
        }
        if tick == 101 {
            assert_eq!(output_velocity(output), DVec3::ZERO);
        }
    }
}

/// The usual delay and gaps of a source delay hold and land by exactly that time.
#[test]
fn allows_the_usual_latency_of_a_pose_source() {
    let PoseAges { hold_after_s, land_after_s } = arena(room(), 3.0, 4.0).pose_ages;
    for allowance_s in [0.0, 0.1, 0.3] {
        let mut guard = guard();
        let late = VehicleMotion { allowance_s, ..at_rest(1) };
        for tick in 1..=130 {
            guard.handle_setpoint(time(tick), velocity(DVec3::X)).unwrap();
            let overdue_s = time(tick).seconds_since(time(1)) - allowance_s;
            let (_, mode) = guard.tick(time(tick), &late);
            let follows = mode == GuardMode::Following;
            let lands = matches!(mode, GuardMode::Landing(LandReason::PoseLost(_)));
            assert_eq!(follows, overdue_s <= hold_after_s, "{overdue_s} {mode:?}");
            assert_eq!(lands, overdue_s > land_after_s, "{overdue_s} {mode:?}");
        }
    }
}

#[test]
fn lands_outside_the_fence() {
    let mut guard = guard();
    guard.handle_setpoint(time(1), velocity(DVec3::X)).unwrap();
    let out = VehicleMotion { p_world_m: DVec3::new(4.95, 0.0, 2.0), ..at_rest(1) };
    let (_, mode) = guard.tick(time(1), &out);
    assert!(
        matches!(mode, GuardMode::Landing(LandReason::OutsideFence(m)) if (m - 0.07).abs() < 1e-9)
    );
}

#[test]
fn lands_inside_a_no_fly_box_and_slides_around_it() {
    let mut arena = arena(room(), 3.0, 4.0);
    let pillar = Volume::aabb(DVec3::new(1.0, -0.5, 0.0), DVec3::new(1.5, 0.4, 4.0));
    arena.no_fly.push(pillar).unwrap();
    let mut guard = Guard::new(&arena, &at_rest(0), QUICK, time(0), 7);
    let inside = VehicleMotion { p_world_m: DVec3::new(0.95, 0.0, 2.0), ..at_rest(1) };
    let (output, mode) = guard.tick(time(1), &inside);
    assert_eq!(output, GuardOutput::Land);
    assert!(
        matches!(mode, GuardMode::Landing(LandReason::InNoFly(m)) if (m - 0.07).abs() < 1e-9),
        "{mode:?}"
    );
    // Straight towards the box: stops before it. Past its edge: slides around it.
    let mut guard = Guard::new(&arena, &at_rest(0), QUICK, time(0), 7);
    let mut vehicle = Vehicle::new(DVec3::Z * 2.0, 4.0);
    let mut fly = |v_mps, ticks: std::ops::Range<usize>| {
        for tick in ticks {
            guard.handle_setpoint(time(tick), velocity(v_mps)).unwrap();
            let v = output_velocity(guard.tick(time(tick), &vehicle.motion(time(tick))).0);
            vehicle.fly(v);
        }
        vehicle.p_m
    };
    let p_m = fly(DVec3::X * 3.0, 1..200);
    assert!((p_m - DVec3::new(0.68, 0.0, 2.0)).length() < 0.03, "{p_m}");
    let p_m = fly(DVec3::new(2.0, 1.0, 0.0), 200..400);
    assert!(p_m.x > 2.0 && p_m.y > 0.7, "{p_m}");
}

#[test]
fn stops_above_the_floor() {
    // The fence reaches below the floor, as in every arena, because vehicles land there.
    let deep = Volume::aabb(DVec3::new(-5.0, -3.0, -0.5), DVec3::new(5.0, 3.0, 4.0));
    let mut guard = Guard::new(&arena(deep, 3.0, 4.0), &at_rest(0), QUICK, time(0), 7);
    let mut vehicle = Vehicle::new(DVec3::Z * 2.0, 4.0);
    for tick in 1..200 {
        guard.handle_setpoint(time(tick), velocity(DVec3::new(0.2, 0.0, -3.0))).unwrap();
        let v = output_velocity(guard.tick(time(tick), &vehicle.motion(time(tick))).0);
        vehicle.fly(v);
    }
    assert!((0.12..0.2).contains(&vehicle.p_m.z) && vehicle.v_mps.x > 0.1, "{}", vehicle.p_m);
}

#[test]
fn heading_axes_turn_with_the_nose() {
    let mut guard = guard();
    let mut v = DVec3::ZERO;
    for tick in 1..100 {
        let north = VehicleMotion {
            rotation: DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2),
            ..at_rest(tick)
        };
        guard
            .handle_setpoint(
                time(tick),
                Setpoint::Velocity { v_mps: DVec3::X, axes: Axes::Heading, yaw: YawTarget::Keep },
            )
            .unwrap();
        v = output_velocity(guard.tick(time(tick), &north).0);
    }
    assert!((v - DVec3::Y).length() < 1e-9, "{v}");
}

#[test]
fn keep_holds_the_current_heading() {
    let mut guard = guard();
    let yaw_after = |guard: &mut Guard, tick, yaw, yaw_rad| {
        guard.handle_setpoint(time(tick), Setpoint::velocity(DVec3::X, yaw)).unwrap();
        match guard
            .tick(
                time(tick),
                &VehicleMotion { rotation: DQuat::from_rotation_z(yaw_rad), ..at_rest(tick) },
            )
            .0
        {
            GuardOutput::Guided(guided) => guided.yaw,
            GuardOutput::Land => panic!("landed"),
        }
    };
    assert_eq!(yaw_after(&mut guard, 1, YawTarget::Keep, 0.5), YawTarget::Angle(0.3), "at start");
    assert_eq!(
        yaw_after(&mut guard, 2, YawTarget::Rate(9.0), 0.5),
        YawTarget::Rate(MAX_YAW_RATE_RADPS)
    );
    assert_eq!(yaw_after(&mut guard, 3, YawTarget::Keep, 0.7), YawTarget::Angle(0.7));
    assert_eq!(yaw_after(&mut guard, 4, YawTarget::Keep, 0.9), YawTarget::Angle(0.7));
    let YawTarget::Angle(yaw) = yaw_after(&mut guard, 5, YawTarget::Angle(4.0), 0.9) else {
        panic!()
    };
    assert!((yaw - (4.0 - 2.0 * std::f64::consts::PI)).abs() < 1e-12);
    assert_eq!(yaw_after(&mut guard, 6, YawTarget::Keep, 1.1), YawTarget::Angle(1.1));
}

#[test]
fn a_point_is_reached_and_held() {
    let mut guard = guard();
    let mut vehicle = Vehicle::new(DVec3::Z * 2.0, 4.0);
    let p_world_m = DVec3::new(3.0, -1.5, 1.0);
    for tick in 1..800 {
        guard
            .handle_setpoint(time(tick), Setpoint::Position { p_world_m, yaw: YawTarget::Keep })
            .unwrap();
        let v = output_velocity(guard.tick(time(tick), &vehicle.motion(time(tick))).0);
        vehicle.fly(v);
    }
    assert!((vehicle.p_m - p_world_m).length() < 0.01, "{}", vehicle.p_m);
}

#[test]
fn slides_along_a_wall_instead_of_stopping() {
    let mut guard = guard();
    let mut vehicle = Vehicle::new(DVec3::new(-4.0, 0.0, 2.0), 4.0);
    for tick in 1..200 {
        guard.handle_setpoint(time(tick), velocity(DVec3::new(1.0, 3.0, 0.0))).unwrap();
        let v = output_velocity(guard.tick(time(tick), &vehicle.motion(time(tick))).0);
        vehicle.fly(v);
    }
    assert!(vehicle.p_m.y > 2.5 && vehicle.p_m.y < 2.88, "{}", vehicle.p_m);
    assert!(vehicle.v_mps.x > 0.8, "{}", vehicle.v_mps);
}

#[test]
fn an_orderly_end_brakes_before_it_lands() {
    let mut guard = guard();
    let moving = |tick, v| VehicleMotion { v_world_mps: DVec3::X * v, ..at_rest(tick) };
    guard.handle_setpoint(time(1), velocity(DVec3::X * 2.0)).unwrap();
    guard.tick(time(1), &moving(1, 2.0));
    guard.brake_and_land(time(2));
    let (output, mode) = guard.tick(time(2), &moving(2, 2.0));
    assert_eq!(mode, GuardMode::Holding(HoldReason::Ending));
    assert!(output_velocity(output).length() < 0.1);
    assert_eq!(guard.tick(time(3), &moving(3, 0.2)).0, GuardOutput::Land);

    // A vehicle that does not stop is also landed.
    let mut other = self::guard();
    other.brake_and_land(time(2));
    assert_ne!(other.tick(time(101), &moving(101, 2.0)).0, GuardOutput::Land);
    assert_eq!(other.tick(time(102), &moving(102, 2.0)).0, GuardOutput::Land);
}

#[test]
fn an_offset_starts_at_the_vehicles_position() {
    let mut guard = guard();
    let mut vehicle = Vehicle::new(DVec3::new(1.0, -1.0, 2.0), 4.0);
    let offset = |axes| Setpoint::Offset { d_m: DVec3::X * 0.5, axes, yaw: YawTarget::Keep };
    guard.handle_setpoint(time(0), offset(Axes::Heading)).unwrap();
    let from_m = vehicle.p_m;
    for tick in 1..400 {
        guard.request.at = time(tick);
        vehicle.fly(output_velocity(guard.tick(time(tick), &vehicle.motion(time(tick))).0));
    }
    let ahead = DVec3::new(0.3_f64.cos(), 0.3_f64.sin(), 0.0);
    assert!((vehicle.p_m - from_m - ahead * 0.5).length() < 0.02, "{}", vehicle.p_m);
}

/// Flies a trajectory to its end: one setpoint, then replies without a setpoint.
#[test]
fn flies_a_trajectory_while_the_plugin_replies() {
    let corners = [DVec3::new(2.0, 0.0, 2.0), DVec3::new(2.0, 2.0, 2.0), DVec3::new(0.0, 0.0, 1.0)];
    let points = corners.map(|p_m| Waypoint { p_m, speed_mps: 1.5 });
    let path = Path::Waypoints(points.into_iter().collect());
    let trajectory = Setpoint::Trajectory(Trajectory { path, ..Trajectory::default() });
    let mut guard = guard();
    let mut vehicle = Vehicle::new(DVec3::Z * 2.0, 4.0);
    guard.handle_setpoint(time(0), trajectory).unwrap();
    let mut nearest_m = [f64::INFINITY; 3];
    let mut tick = 0;
    let end = loop {
        tick += 1;
        guard.handle_empty_reply(time(tick));
        let (output, mode) = guard.tick(time(tick), &vehicle.motion(time(tick)));
        if mode != GuardMode::Following {
            break mode;
        }
        vehicle.fly(output_velocity(output));
        for (nearest_m, corner_m) in nearest_m.iter_mut().zip(corners) {
            *nearest_m = nearest_m.min((vehicle.p_m - corner_m).length());
        }
    };
    // After the end: the plugin sends nothing new, and the usual deadline applies.
    assert_eq!(end, GuardMode::Holding(HoldReason::NoSetpoint));
    assert!(nearest_m.iter().all(|&m| m < 0.25), "{nearest_m:?}");
    assert!((vehicle.p_m - corners[2]).length() < 0.15, "{}", vehicle.p_m);

    // If the plugin stops replying, the trajectory is not continued.
    let mut silent = self::guard();
    let path = Path::Waypoints(points.into_iter().collect());
    let again = Setpoint::Trajectory(Trajectory { path, ..Trajectory::default() });
    silent.handle_setpoint(time(0), again).unwrap();
    silent.tick(time(1), &at_rest(1));
    assert_eq!(silent.tick(time(27), &at_rest(27)).1, GuardMode::Holding(HoldReason::NoSetpoint));
}

#[test]
fn attitude_rates_tilt_and_accelerate_only_where_the_course_allows() {
    let rates = |pitch_radps, thrust| Setpoint::AttitudeRate {
        omega_body_radps: DVec3::Y * pitch_radps,
        thrust,
    };
    let mut strict = arena(room(), 3.0, 4.0);
    strict.setpoints = SetpointKinds::USUAL;
    let mut forbidden = Guard::new(&strict, &at_rest(0), QUICK, time(0), 7);
    let allowed = SetpointKinds::USUAL;
    let refused = InvalidSetpoint::NotAllowed { asked: SetpointKind::AttitudeRate, allowed };
    assert_eq!(forbidden.handle_setpoint(time(1), rates(0.0, 1.0)), Err(refused));

    // Nose down for 0.2 s at 1 rad/s, then zero rates: accelerates forward by g tan(0.2).
    let mut guard = guard();
    let mut v = DVec3::ZERO;
    for tick in 1..=40 {
        let (pitch_radps, thrust) =
            if tick <= 10 { (1.0, 1.0) } else { (0.0, 1.0 / 0.2_f64.cos()) };
        guard.handle_setpoint(time(tick), rates(pitch_radps, thrust)).unwrap();
        let before = v;
        let flying = VehicleMotion { v_world_mps: v, ..at_rest(tick) };
        v = output_velocity(guard.tick(time(tick), &flying).0);
        if tick == 40 {
            let a = (v - before) / TICK_S;
            let ahead = DQuat::from_rotation_z(0.3) * DVec3::X;
            assert!((a - ahead * GRAVITY_MPS2 * 0.2_f64.tan()).length() < 1e-6, "{a}");
        }
    }
}

#[test]
fn rejects_setpoints_that_the_course_does_not_allow() {
    let mut course = arena(room(), 3.0, 4.0);
    course.setpoints = [SetpointKind::Position].into_iter().collect();
    let mut guard = Guard::new(&course, &at_rest(0), QUICK, time(0), 7);
    let position = Setpoint::Position { p_world_m: DVec3::Z, yaw: YawTarget::Keep };
    assert_eq!(guard.handle_setpoint(time(1), position), Ok(()));
    let refused =
        guard.handle_setpoint(time(2), Setpoint::velocity(DVec3::X, YawTarget::Keep)).unwrap_err();
    let text = "this course does not allow velocity; it allows position";
    assert_eq!(refused.to_string(), text);
    // A rejected setpoint does not reset the deadline: the setpoint before it stays in force.
    for always in [Setpoint::Hold, Setpoint::TakeOff, Setpoint::Land] {
        assert_eq!(guard.handle_setpoint(time(3), always), Ok(()));
    }
}

#[test]
fn positions_drift_if_the_pose_is_withheld() {
    let mut course = arena(room(), 3.0, 4.0);
    (course.ground_truth, course.setpoints) = (false, SetpointKinds::BY_OWN_SENSES);
    let fly = |seed| {
        let mut guard = Guard::new(&course, &at_rest(0), QUICK, time(0), seed);
        let mut vehicle = Vehicle::new(DVec3::Z * 2.0, 4.0);
        let d_m = DVec3::X * 2.0;
        let ahead = Setpoint::Offset { d_m, axes: Axes::Heading, yaw: YawTarget::Keep };
        for tick in 1..600 {
            // Sent once, because a new offset would start at the vehicle's new position.
            if tick == 1 {
                guard.handle_setpoint(time(tick), ahead.clone()).unwrap();
            }
            guard.request.at = time(tick);
            vehicle.fly(output_velocity(guard.tick(time(tick), &vehicle.motion(time(tick))).0));
        }
        vehicle.p_m
    };
    let goal_m = at_rest(0).p_world_m + DQuat::from_rotation_z(0.3) * DVec3::X * 2.0;
    let missed: Vec<f64> = (0..6).map(|seed| (fly(seed) - goal_m).length()).collect();
    assert!(missed.iter().all(|missed_m| (0.001..0.04).contains(missed_m)), "{missed:?}");
    assert_ne!(fly(1), fly(2));

    let mut guard = Guard::new(&course, &at_rest(0), QUICK, time(0), 7);
    let position = Setpoint::Position { p_world_m: DVec3::Z, yaw: YawTarget::Keep };
    let refused = guard.handle_setpoint(time(1), position).unwrap_err();
    assert!(matches!(refused, InvalidSetpoint::NotAllowed { .. }), "{refused}");
    let refused = guard.handle_setpoint(time(1), velocity(DVec3::X)).unwrap_err();
    assert_eq!(refused, InvalidSetpoint::WorldAxes);
    assert!(refused.to_string().contains("give axes \"heading\""), "{refused}");
}

#[test]
fn take_off_returns_to_the_initial_height() {
    let mut guard = guard();
    let mut vehicle = Vehicle::new(DVec3::new(1.0, 1.0, 0.5), 4.0);
    for tick in 1..600 {
        guard.handle_setpoint(time(tick), Setpoint::TakeOff).unwrap();
        vehicle.fly(output_velocity(guard.tick(time(tick), &vehicle.motion(time(tick))).0));
    }
    assert!((vehicle.p_m - DVec3::new(1.0, 1.0, 2.0)).length() < 0.02, "{}", vehicle.p_m);
}

#[test]
fn landing_is_final() {
    let mut guard = guard();
    guard.land();
    for tick in 1..50 {
        guard.handle_setpoint(time(tick), velocity(DVec3::X)).unwrap();
        let (output, mode) = guard.tick(time(tick), &at_rest(tick));
        assert_eq!((output, mode), (GuardOutput::Land, GuardMode::Landing(LandReason::Ordered)));
    }
}

#[test]
fn rejects_arenas_that_the_guard_cannot_enforce() {
    assert_eq!(check_arena(&arena(room(), 3.0, 4.0)), Ok(()));
    assert!(check_arena(&arena(room(), f64::NAN, 4.0)).unwrap_err().contains("limits"));
    assert!(check_arena(&arena(room(), 3.0, 0.0)).unwrap_err().contains("limits"));
    let mut low = arena(room(), 3.0, 4.0);
    low.limits.max_altitude_m = Some(0.9);
    assert!(check_arena(&low).unwrap_err().contains("max_altitude_m = 0.9"));
    low.limits = Limits { max_tilt_deg: Some(f64::NAN), ..Limits::new(3.0, 4.0) };
    assert!(check_arena(&low).unwrap_err().contains("max_tilt_deg"));
    let tiny = Volume::aabb(DVec3::ZERO, DVec3::splat(0.2));
    assert!(check_arena(&arena(tiny, 3.0, 4.0)).unwrap_err().contains("too small"));
    let bad = Volume::Sphere { center_m: DVec3::ZERO, radius_m: -1.0 };
    let mut holed = arena(room(), 3.0, 4.0);
    holed.no_fly.push(bad).unwrap();
    assert!(check_arena(&holed).unwrap_err().contains("no_fly"));
    assert!(check_arena(&arena(bad, 3.0, 4.0)).unwrap_err().contains("geofence"));
}
