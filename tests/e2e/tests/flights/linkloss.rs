//! Loss of a process, with real processes in real time: the remaining ones land the vehicle inside the fence. The
//! vehicle is observed from outside, by the motion capture's packets. Limits on landing time and drift are tested by
//! `tables::failsafe`, which flies every loss on a virtual clock.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::lab::{Flight, Lab, Plan};
use glam::Vec3;
use nix::sys::signal::Signal;
use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_splat::{format, ply};

/// Lost process, and the reaction.
#[derive(Clone, Copy, Debug)]
enum Loss {
    /// The runtime is killed: the guardian lands at once.
    RuntimeKilled,
    /// The runtime is stopped, as if it hangs: the guardian lands after 0.5 s.
    RuntimeStopped,
    /// The guardian is killed: the runtime lands at once.
    GuardianKilled,
    /// The guardian is stopped, as if it hangs: the runtime kills it and lands after 0.3 s.
    GuardianStopped,
    /// The server is killed: the runtime lands after 0.5 s.
    ServerKilled,
}

/// Request to the plugin, and the resulting speed. [m/s]
const SPEED: (&str, f64) = ("world:1:0", 1.0);
/// Maximum height of a vehicle that is down. [m]
const DOWN_M: f64 = 0.05;
/// The room's fence. [m, world]
const FENCE_X_M: (f64, f64) = (0.0, 11.0);
/// Minimum number of the guardian's poses until the vehicle is down: 50 per second on an idle machine.
const GUARDIAN_POSES: u32 = 10;
/// Timeout, more than twice of what any wait needs.
const PATIENCE: Duration = Duration::from_mins(2);

#[test]
fn vehicle_lands_after_the_loss_of_a_process() {
    let lab = Mutex::new(open(2));
    std::thread::scope(|scope| {
        scope.spawn(|| check_lands(&lab, 0, Loss::RuntimeKilled));
        scope.spawn(|| check_lands(&lab, 1, Loss::RuntimeStopped));
    });
    drop(lab);
    let lab = Mutex::new(open(3));
    std::thread::scope(|scope| {
        scope.spawn(|| check_lands(&lab, 0, Loss::GuardianKilled));
        scope.spawn(|| check_lands(&lab, 1, Loss::GuardianStopped));
    });
    check_lands(&lab, 2, Loss::ServerKilled);
}

/// Opens a lab with an empty room: no collision, and the goal is not reached.
fn open(vehicles: usize) -> Lab {
    Lab::open_in(vehicles, |folder| {
        let path = folder.join("scene.ply");
        let mut scene = format::read(&path).expect("the generated scene reads").splats;
        let is_in_the_way = |p_m: &Vec3| {
            (0.2..10.9).contains(&p_m.x) && p_m.y.abs() < 1.9 && (0.1..3.0).contains(&p_m.z)
        };
        for (mean_m, opacity) in scene.means_m.iter().zip(&mut scene.opacities) {
            if is_in_the_way(mean_m) {
                *opacity = 0.0;
            }
        }
        ply::write(&path, &scene).expect("the scene is written");
        let arena = folder.join("arena.toml");
        let text = std::fs::read_to_string(&arena).expect("the arena reads");
        let text = text.replace("radius_m = 0.6", "radius_m = 0.01");
        std::fs::write(&arena, text).expect("the arena is written");
    })
}

/// Causes the loss for a flying vehicle: it must land inside the fence.
fn check_lands(lab: &Mutex<Lab>, index: usize, loss: Loss) {
    let parameters = vizflyt_e2e::airframe_parameters();
    let vehicle: Vec<String> =
        parameters.iter().map(|(name, value)| format!("--param={name}={value}")).collect();
    // With a pilot's radio.
    let vehicle: Vec<&str> = vehicle.iter().map(String::as_str).chain(["--radio"]).collect();
    let (how, speed_mps) = SPEED;
    let plan = Plan { how, vehicle: &vehicle, ..Plan::default() };
    let mut flight = lab.lock().expect("no thread panics with the lock").fly(index, plan);
    flight.until("\"phase\":\"flying\"");
    let start = flight.now().p_m;
    let way_m = speed_mps.mul_add(1.2, 0.2);
    wait(loss, "its path", || (flight.now().p_m - start).truncate().length() > way_m);
    let last_good = flight.now();
    match loss {
        Loss::RuntimeKilled => flight.kill_runtime(),
        Loss::RuntimeStopped => flight.stop_runtime(),
        Loss::GuardianKilled => flight.signal_guardian(Signal::SIGKILL),
        Loss::GuardianStopped => flight.signal_guardian(Signal::SIGSTOP),
        Loss::ServerKilled => lab.lock().expect("no thread panics with the lock").kill_server(),
    }
    wait(loss, "the floor", || flight.now().p_m.z < DOWN_M);
    check_landed(&flight, loss, last_good.at);
    if matches!(loss, Loss::GuardianKilled | Loss::GuardianStopped) {
        let report = flight.wait().report;
        assert_eq!(report["reason"], "the guardian process failed", "{loss:?}: {report}");
    }
}

/// Asserts that LAND was entered after the loss, and that the vehicle never left the fence.
fn check_landed(flight: &Flight, loss: Loss, lost_at: Instant) {
    let (track, modes) = flight.so_far();
    let land = CopterMode::Land as u32;
    let landed = modes.iter().any(|&(at, mode)| mode == land && at >= lost_at);
    assert!(landed, "{loss:?}: down without LAND, {modes:?}");
    let outside = track.iter().find(|sight| !(FENCE_X_M.0..FENCE_X_M.1).contains(&sight.p_m.x));
    assert!(outside.is_none(), "{loss:?}: left the fence: {outside:?}");
    let poses = flight.guardian_poses();
    if matches!(loss, Loss::RuntimeKilled | Loss::RuntimeStopped) {
        assert!(poses > GUARDIAN_POSES, "{loss:?}: {poses} poses by the guardian's own feed");
    }
}

fn wait(loss: Loss, what: &str, done: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !done() {
        assert!(Instant::now() < deadline, "{loss:?}: waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}
