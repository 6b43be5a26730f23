//! Safety chain in flight: a wall that exists only in the twin causes LAND, and the remaining programs keep the fence
//! if the server, the runtime or the guard fails.
//!
//! The tests observe the vehicle from outside, by the packets of the motion capture and the vehicle's heartbeats. They
//! print their measurements: `cargo test -p vizflyt-e2e --test flights chain -- --nocapture`. Time limits allow for a
//! loaded machine; `docs/BENCHMARKS.md` has the times of an idle one.

use std::path::Path;
use std::time::{Duration, Instant};

use crate::lab::{Flight, LOCALIZATION, Lab, Plan};
use glam::{DVec3, Quat, Vec3};
use serde_json::Value;
use vizflyt_e2e::Load;
use vizflyt_protocol::mavlink::dialect::{HEARTBEAT_DATA, MavMessage};
use vizflyt_protocol::mavlink::{
    CopterMode, GuidedMotion, GuidedSetpoint, MAX_PACKET, MavHeader, encode, guided_to_mavlink,
};
use vizflyt_protocol::messages::YawTarget;
use vizflyt_splat::{format, ply};

/// Number of vehicles that fly into the wall; each is a sample of the chain's time.
const VEHICLES: usize = 3;
/// Position of the wall. [m, world]
const WALL_X_M: f64 = 2.0;
/// Time limit, far above the chain's time on an idle machine. [s]
const LAND_WITHIN_S: f64 = 1.0;
/// Timeout, more than twice of what any wait needs.
const PATIENCE: Duration = Duration::from_mins(2);
/// Maximum distance by which a vehicle may overshoot the arena's fence if only the autopilot brakes it, half a second
/// later. [m]
const COAST_M: f64 = 0.8;

/// Adds a wall across the room, of flat splats 3 cm apart.
fn furnish(folder: &Path) {
    let path = folder.join("scene.ply");
    let mut scene = format::read(&path).expect("the generated scene reads").splats;
    let coefficients = scene.sh.len() / scene.means_m.len();
    let wall = (-60..60).flat_map(|y| (0..100).map(move |z| (y, z)));
    for (y, z) in wall {
        scene.means_m.push(Vec3::new(WALL_X_M as f32, 0.03 * y as f32, 0.03 * z as f32));
        scene.scales_m.push(Vec3::new(0.004, 0.03, 0.03));
        scene.rotations.push(Quat::IDENTITY);
        scene.opacities.push(0.95);
        scene.sh.extend(std::iter::repeat_n(0.3, coefficients));
    }
    ply::write(&path, &scene).expect("the scene is written");
}

#[test]
fn collision_with_a_wall_of_the_twin_causes_land() {
    let lab = Lab::open_in(VEHICLES, furnish);
    let load = Load::start();
    let plan = Plan { how: "forward", ..Plan::default() };
    let mut flights: Vec<_> = (0..VEHICLES).map(|index| lab.fly(index, plan)).collect();
    let mut took_ms = Vec::new();
    for flight in &mut flights {
        let Some(lines) = flight.until_unless_busy("collision", &load) else { return };
        let (_, line) = lines.last().expect("the line of the collision");
        let at_m = collision(line);
        // The first packet with the vehicle where the server reports the collision, or 5 mm before: a fused pose
        // results from several packets.
        let (track, _) = flight.so_far();
        let shown = track.iter().find(|sight| sight.p_m.x >= at_m.x - 5e-3 && sight.p_m.z > 0.3);
        let shown = shown.expect("the motion capture saw it there").at;
        wait("LAND", || flight.ordered_to_land().is_some());
        let ordered = flight.ordered_to_land().expect("LAND was ordered");
        let took = ordered.saturating_duration_since(shown);
        assert!((at_m.x - (WALL_X_M - 0.12)).abs() < 0.1, "touched at {at_m}");
        assert!(took.as_secs_f64() < LAND_WITHIN_S, "LAND came {took:?} after the pose");
        took_ms.push(took.as_secs_f64() * 1e3);
    }
    took_ms.sort_by(f64::total_cmp);
    println!("collision to LAND, from the packet that shows it: {took_ms:.1?} ms");
    for flight in flights {
        let seen = flight.wait();
        assert_eq!(seen.report["outcome"], "collided", "{}", seen.report);
        assert_eq!(seen.count("\"collision\""), 0, "reported once, and then nothing counts");
        let (height_m, _) = seen.end();
        assert!(height_m < 0.1, "down, at {height_m} m");
        let furthest_m = seen.track.iter().map(|sight| sight.p_m.x).fold(0.0, f64::max);
        assert!(furthest_m < WALL_X_M + 0.3, "it went on to {furthest_m} m");
    }
}

/// Reads the position of the body's centre from a line of the runtime. [m, world]
fn collision(line: &Value) -> DVec3 {
    fn find(value: &Value) -> Option<&Value> {
        match value {
            Value::Object(map) => {
                map.get("p_world_m").or_else(|| map.values().find_map(|value| find(value)))
            }
            Value::Array(list) => list.iter().find_map(find),
            _ => None,
        }
    }
    let numbers = find(line).and_then(Value::as_array).expect("a place");
    let number = |n: usize| numbers[n].as_f64().expect("a number");
    DVec3::new(number(0), number(1), number(2))
}

/// A localization with a constant delay of 0.14 s and 5 % lost poses, in a flight up to the fence.
#[test]
fn keeps_the_fence_with_a_late_localization() {
    let lab = Lab::open_with(1, &format!("{LOCALIZATION}latency_ms = 140\n"));
    let vehicle = ["--airframe", "--mocap-delay-ms=140", "--mocap-drop-percent=5"];
    let more = ["--seconds=8"];
    let flight =
        lab.fly(0, Plan { how: "forward", vehicle: &vehicle, more: &more, ..Plan::default() });
    let seen = flight.wait();
    let furthest_m = seen.track.iter().map(|sight| sight.p_m.x).fold(0.0, f64::max);
    println!("0.14 s late: {:.2} m inside the fence at the least", FENCE_X_M - furthest_m);
    assert!((FENCE_X_M - 1.0..FENCE_X_M).contains(&furthest_m), "{furthest_m} m");
    assert_eq!(seen.count("the pose is older") + seen.count("pose_lost"), 0, "{:#?}", seen.lines);
    assert_eq!(seen.report["outcome"], "landed", "{}", seen.report);
}

#[test]
fn runtime_keeps_the_fence_without_the_server() {
    let mut lab = Lab::open(1);
    let Some(mut flight) = outward(&lab) else { return };
    lab.kill_server();
    drop(lab);
    ends_inside(&mut flight, "the server is killed", 0.0);
}

#[test]
fn guardian_lands_the_vehicle_without_the_runtime() {
    let lab = Lab::open(1);
    let Some(mut flight) = outward(&lab) else { return };
    flight.kill_runtime();
    ends_inside(&mut flight, "the runtime is killed", 0.0);
}

#[test]
fn autopilot_lands_the_vehicle_without_runtime_and_guardian() {
    let lab = Lab::open(1);
    let Some(mut flight) = outward(&lab) else { return };
    flight.switch_off();
    ends_inside(&mut flight, "the computer is off", COAST_M);
}

#[test]
fn autopilot_keeps_its_own_fence_without_a_guard() {
    let lab = Lab::open(1);
    let Some(mut flight) = outward(&lab) else { return };
    flight.switch_off();
    fly_on(&flight);
    let reached_m = flight.now().p_m.x - START_X_M;
    println!(
        "without a guard: the autopilot's fence of {FENCE_RADIUS_M} m acts at {reached_m:.2} m"
    );
    assert!(reached_m > FENCE_RADIUS_M - 0.3, "at {reached_m} m something else landed it");
    ends_inside(&mut flight, "no guard", COAST_M);
}

/// Flies on until the autopilot lands: a program without a fence has taken over on the same link.
fn fly_on(flight: &Flight) {
    let started = Instant::now();
    let mut sequence = 0;
    while !is_landing(flight) {
        assert!(started.elapsed() < PATIENCE, "it flies on: {:?}", flight.now());
        let motion = GuidedMotion::Velocity(DVec3::X);
        let setpoint = GuidedSetpoint { motion, yaw: YawTarget::Angle(0.0) };
        let target = guided_to_mavlink(&setpoint, (1, 1), 0);
        send(flight, &MavMessage::SET_POSITION_TARGET_LOCAL_NED(target), &mut sequence);
        if sequence % 20 == 1 {
            send(flight, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()), &mut sequence);
        }
        // Rate of the setpoints.
        std::thread::sleep(Duration::from_millis(25));
    }
}

/// Adds a pillar across the room that exists only in `arena.toml`.
fn forbid(folder: &Path) {
    let path = folder.join("arena.toml");
    let text = std::fs::read_to_string(&path).expect("the arena reads");
    let text = format!(
        "{text}\n[[no_fly]]\nname = \"pillar\"\nmin_m = [{NO_FLY_X_M}, -2.0, -0.5]\nmax_m = [3.0, 2.0, 3.65]\n"
    );
    std::fs::write(&path, text).expect("the arena is written");
}

#[test]
fn autopilot_lands_at_a_no_fly_box_without_server_and_guard() {
    let mut lab = Lab::open_in(1, forbid);
    // Only the uploaded box: the autopilot's circle and ceiling are off.
    let Some(mut flight) = outward_with(&lab, &["--param=FENCE_TYPE=4"]) else { return };
    lab.kill_server();
    flight.switch_off();
    fly_on(&flight);
    let reached_m = flight.now().p_m.x;
    println!("a no-fly box from {NO_FLY_X_M} m: the autopilot's fence acts at {reached_m:.2} m");
    assert!(reached_m > NO_FLY_X_M - 0.4, "at {reached_m} m something else landed it");
    wait("the landing", || flight.now().p_m.z < 0.05);
    let (track, _) = flight.so_far();
    let furthest_m = track.iter().map(|sight| sight.p_m.x).fold(0.0, f64::max);
    assert!(furthest_m < NO_FLY_X_M + COAST_M, "it was at {furthest_m} m");
}

/// Returns a flight towards the fence.
fn outward(lab: &Lab) -> Option<Flight> {
    let fence = format!("--param=FENCE_RADIUS={FENCE_RADIUS_M}");
    outward_with(lab, &[&fence, "--param=FENCE_TYPE=3"])
}

/// Returns a flight towards the fence, with this kind of autopilot fence.
fn outward_with(lab: &Lab, fence: &[&str]) -> Option<Flight> {
    let vehicle = [
        "--airframe",
        "--param=FENCE_ENABLE=1",
        "--param=FENCE_ACTION=2",
        "--param=FENCE_ALT_MAX=3.2",
        "--param=FENCE_MARGIN=0.3",
        "--param=FS_GCS_ENABLE=5",
        "--param=FS_GCS_TIMEOUT=2",
        "--param=FS_OPTIONS=24",
    ];
    let vehicle = [fence, &vehicle].concat();
    let plan = Plan { how: "forward", vehicle: &vehicle, ..Plan::default() };
    let mut flight = lab.fly(0, plan);
    let load = Load::start();
    flight.until("\"phase\":\"flying\"");
    let is_out = || flight.now().p_m.x > START_X_M + 0.4;
    wait("the way to the fence", || is_out() || is_landing(&flight));
    if is_out() {
        return Some(flight);
    }
    assert!(load.is_too_high(), "it landed on its way to the fence: {:?}", flight.so_far().1);
    println!("the machine is too busy: a safety rule landed the vehicle before the test began");
    None
}

/// Waits until the vehicle is down, and asserts that it has not left the fence by more than `beyond_m`.
fn ends_inside(flight: &mut Flight, what: &str, beyond_m: f64) {
    wait(what, || flight.now().p_m.z < 0.05);
    let (track, modes) = flight.so_far();
    let furthest_m = track.iter().map(|sight| sight.p_m.x).fold(0.0, f64::max);
    println!("{what}: down, {:.2} m inside the fence at the least", FENCE_X_M - furthest_m);
    assert!(furthest_m < FENCE_X_M + beyond_m, "{what}: it was at {furthest_m} m");
    let land = CopterMode::Land as u32;
    assert!(modes.iter().any(|&(_, mode)| mode == land), "{what}: {modes:?}");
}

fn is_landing(flight: &Flight) -> bool {
    let (_, modes) = flight.so_far();
    modes.last().is_some_and(|&(_, mode)| mode == CopterMode::Land as u32)
}

fn send(flight: &Flight, message: &MavMessage, sequence: &mut u8) {
    let header = MavHeader { system_id: 255, component_id: 190, sequence: *sequence };
    *sequence = sequence.wrapping_add(1);
    flight.tell_vehicle(encode(header, message, &mut [0; MAX_PACKET]));
}

fn wait(what: &str, done: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !done() {
        assert!(Instant::now() < deadline, "{what}: waited in vain");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Start of the lab's vehicles, and the side of the room's fence in their direction of flight. [m, world]
const START_X_M: f64 = 0.9;
const FENCE_X_M: f64 = 2.6;
/// Start of the no-fly box. [m, world]
const NO_FLY_X_M: f64 = 2.4;
/// Radius of the autopilot's own fence around the start. [m]
const FENCE_RADIUS_M: f64 = 1.7;
