//! The chain of links between a pose and a motor, broken at each of its joints in flight, at three speeds. The
//! vehicle is watched from outside, by the motion capture's own packets: whatever is lost, it is down inside the
//! fence, within 5 s of the last good pose where somebody of ours is left to order LAND, within 9 s where only the
//! autopilot is, whose failsafes hover for 4 s first. How far it drifts meanwhile depends on whether it still knows
//! where it is. What comes back in time costs a pause and no landing.
//!
//! Real processes in real time; the table of `docs/guides/failsafe.md` is `failsafe`'s, on a virtual clock. Durations are the simulator's, so that a busy machine does not make the vehicle look slow.

#[path = "../flights/lab.rs"]
mod lab;

use std::sync::Mutex;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use glam::Vec3;
use lab::{Flight, Lab, Plan, Sight};
use vizflyt_protocol::mavlink::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage};
use vizflyt_protocol::mavlink::{CopterMode, MAX_PACKET, MavHeader, encode};
use vizflyt_splat::{format, ply};

/// What is lost.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Loss {
    /// The runtime is killed.
    Runtime,
    /// The runtime is stopped, as one that hangs.
    Stopped,
    /// The runtime and its guardian are killed.
    Jetson,
    /// MAVLink stops both ways: Wi-Fi. [s]
    Mavlink(f64),
    /// The bridge is stopped, as one that hangs.
    BridgeHangs,
    /// The bridge is killed, and started again after so long. [s]
    Bridge(f64),
    /// The motion capture sees nothing. [s]
    Poses(f64),
    /// The server is killed.
    Server,
    /// The autopilot reboots.
    Autopilot,
    /// Runtime, guardian, poses and MAVLink.
    All,
}

/// For ever, as far as a flight goes. [s]
const FOR_EVER: f64 = 1e6;

/// Who is left to bring it down.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Left {
    /// Runtime, guardian or bridge orders LAND.
    Ours,
    /// The autopilot has to find out.
    Autopilot,
    /// It flies on.
    FliesOn,
}

/// A row of the table.
#[derive(Debug)]
struct Case {
    loss: Loss,
    /// How the row reads.
    name: &'static str,
    /// Who notices, and what it does.
    does: &'static str,
    /// Whether its MAVLink goes through a bridge.
    bridge: bool,
    left: Left,
}

/// Flown at each of [`SPEEDS`].
const AT_ALL_SPEEDS: [Case; 11] = [
    Case {
        loss: Loss::Runtime,
        name: "the runtime is killed",
        does: "guardian: LAND at once",
        bridge: false,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Stopped,
        name: "the runtime is stopped",
        does: "guardian: LAND after 0.5 s",
        bridge: false,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Runtime,
        name: "the runtime is killed, behind a bridge",
        does: "guardian: LAND at once",
        bridge: true,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Server,
        name: "the server is killed",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Poses(FOR_EVER),
        name: "the pose is gone",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Mavlink(FOR_EVER),
        name: "Wi-Fi dies, behind a bridge",
        does: "bridge: LAND after 1 s",
        bridge: true,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Jetson,
        name: "the Jetson is off, behind a bridge",
        does: "bridge: LAND after 1 s",
        bridge: true,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Jetson,
        name: "the Jetson is off",
        does: BY_AUTOPILOT,
        bridge: false,
        left: Left::Autopilot,
    },
    Case {
        loss: Loss::Mavlink(FOR_EVER),
        name: "Wi-Fi dies",
        does: BY_AUTOPILOT,
        bridge: false,
        left: Left::Autopilot,
    },
    Case {
        loss: Loss::BridgeHangs,
        name: "the bridge hangs",
        does: BY_AUTOPILOT,
        bridge: true,
        left: Left::Autopilot,
    },
    Case {
        loss: Loss::All,
        name: "all at once",
        does: BY_AUTOPILOT,
        bridge: false,
        left: Left::Autopilot,
    },
];

const BY_AUTOPILOT: &str = "autopilot: stops by GUID_TIMEOUT, LAND by FS_GCS_TIMEOUT";

/// Flown at the least of [`SPEEDS`].
const AT_ONE_SPEED: [Case; 6] = [
    Case {
        loss: Loss::Autopilot,
        name: "the autopilot reboots in flight",
        does: "nobody can: motors stop, it falls",
        bridge: false,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Mavlink(1.0),
        name: "Wi-Fi is away for 1 s",
        does: "autopilot: stops by GUID_TIMEOUT, flies on",
        bridge: false,
        left: Left::FliesOn,
    },
    Case {
        loss: Loss::Bridge(1.0),
        name: "the bridge loses power for 1 s",
        does: "autopilot: stops by GUID_TIMEOUT, flies on",
        bridge: true,
        left: Left::FliesOn,
    },
    Case {
        loss: Loss::Poses(0.2),
        name: "the pose stalls for 200 ms",
        does: "runtime: holds after 0.15 s, flies on",
        bridge: false,
        left: Left::FliesOn,
    },
    Case {
        loss: Loss::Poses(1.0),
        name: "the pose stalls for 1 s",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        left: Left::Ours,
    },
    Case {
        loss: Loss::Bridge(FOR_EVER),
        name: "the bridge loses power",
        does: BY_AUTOPILOT,
        bridge: true,
        left: Left::Autopilot,
    },
];

/// [m/s], and what asks the plugin for it.
const SPEEDS: [(f64, &str); 3] = [(0.35, "world:0.35:0"), (1.0, "world:1:0"), (2.5, "world:2.5:0")];

/// One flight: a row at a speed.
#[derive(Clone, Copy, Debug)]
struct Run {
    case: &'static Case,
    speed_mps: f64,
    /// What is asked of the plugin.
    how: &'static str,
}

impl Run {
    /// From 1.2 m. [s]
    fn down_within_s(self) -> f64 {
        if self.case.left == Left::Autopilot { 9.0 } else { 5.0 }
    }

    /// From where it was at the last good pose. [m]
    fn drift_within_m(self) -> f64 {
        match (self.case.left, self.case.loss) {
            // Blind for eight seconds.
            (Left::Autopilot, _) => 2.0 + 0.8 * self.speed_mps,
            // The bridge waits for a second.
            (_, Loss::Jetson | Loss::Mavlink(_)) => 0.5 + self.speed_mps,
            _ => 0.5 + 0.8 * self.speed_mps,
        }
    }
}

/// Vehicles that fly at a time; where the server is lost, each has its own.
const TOGETHER: usize = 4;
/// Parameters of the vehicle that are flown with as `hardware/airframe` has them: the runtime cannot act
/// for an autopilot that does not receive it.
const PARAMETERS: [&str; 26] = [
    "FS_GCS_ENABLE",
    "FS_GCS_TIMEOUT",
    "FS_THR_ENABLE",
    "FS_EKF_ACTION",
    "FS_CRASH_CHECK",
    "FS_OPTIONS",
    "GUID_TIMEOUT",
    "FENCE_ENABLE",
    "FENCE_TYPE",
    "FENCE_ACTION",
    "FENCE_ALT_MAX",
    "FENCE_RADIUS",
    "BATT_MONITOR",
    "BATT_LOW_VOLT",
    "BATT_FS_LOW_ACT",
    "WP_SPD",
    "WP_SPD_UP",
    "WP_SPD_DN",
    "WP_ACC",
    "WP_ACC_Z",
    "PSC_JERK_NE",
    "PSC_JERK_D",
    "WP_YAW_BEHAVIOR",
    "LAND_SPD_MS",
    "LAND_SPD_HIGH_MS",
    "LAND_ALT_LOW_M",
];
/// Down means this near the floor. [m]
const DOWN_M: f64 = 0.05;
/// How long a vehicle that shall fly on is watched after the loss is over. [s]
const WATCH_S: f64 = 3.0;
/// The room's fence. [m, world]
const FENCE_X_M: (f64, f64) = (0.0, 11.0);
/// A limit on waiting; nothing takes half as long.
const PATIENCE: Duration = Duration::from_mins(2);

/// A flight as measured.
#[derive(Debug)]
struct Row {
    run: Run,
    /// From the loss until it stood, or came straight down. [s]
    stands_s: Option<f64>,
    /// From the loss until LAND was entered. [s]
    lands_s: Option<f64>,
    /// From the last good pose until it was down. [s]
    down_s: Option<f64>,
    /// Greatest horizontal distance from where it was at the last good pose, until it was down or
    /// the loss was over. [m]
    drift_m: f64,
}

#[test]
fn vehicle_lands_in_time_or_flies_on_after_any_loss() {
    let at_all = AT_ALL_SPEEDS
        .iter()
        .flat_map(|case| SPEEDS.iter().map(move |&(speed_mps, how)| Run { case, speed_mps, how }));
    let (speed_mps, how) = SPEEDS[0];
    let at_one = AT_ONE_SPEED.iter().map(|case| Run { case, speed_mps, how });
    let runs: Vec<_> = at_all.chain(at_one).collect();
    let (server, others): (Vec<Run>, Vec<Run>) =
        runs.iter().partition(|run| run.case.loss == Loss::Server);
    let mut rows = Vec::new();
    for batch in others.chunks(TOGETHER) {
        let lab = Mutex::new(open(batch.len()));
        rows.extend(fly(batch.iter().enumerate().map(|(index, run)| (&lab, index, *run))));
    }
    let labs: Vec<_> = server.iter().map(|_| Mutex::new(open(1))).collect();
    rows.extend(fly(labs.iter().zip(server).map(|(lab, run)| (lab, 0, run))));
    // In the order in which they stand above.
    let place = |row: &Row| {
        runs.iter().position(|run| {
            run.case.name == row.run.case.name && run.speed_mps == row.run.speed_mps
        })
    };
    rows.sort_by_key(place);
    for row in &rows {
        let Run { case, speed_mps, .. } = row.run;
        let (stands_s, lands_s) = (row.stands_s, row.lands_s);
        println!(
            "{}, {speed_mps} m/s: {}; stands {stands_s:?}, LAND {lands_s:?}",
            case.name, case.does
        );
    }
    let complaints: Vec<_> = rows.iter().filter_map(Row::complaint).collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
}

/// Opens a lab whose room is free from end to end: nothing is hit, no goal is reached.
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

/// Flies some at once, each with a thread that strikes it: lab, vehicle's index, run.
fn fly<'a>(runs: impl Iterator<Item = (&'a Mutex<Lab>, usize, Run)>) -> Vec<Row> {
    let vehicle = vehicle();
    let vehicle: Vec<&str> = vehicle.iter().map(String::as_str).collect();
    let flights: Vec<_> = runs
        .map(|(lab, index, run)| {
            let plan = Plan {
                how: run.how,
                vehicle: &vehicle,
                bridge: run.case.bridge,
                ..Plan::default()
            };
            (lab, run, lab.lock().expect("nobody panics with it").fly(index, plan))
        })
        .collect();
    std::thread::scope(|scope| {
        let flights: Vec<_> = flights
            .into_iter()
            .map(|(lab, run, flight)| scope.spawn(move || fly_one(lab, run, flight)))
            .collect();
        flights.into_iter().map(|flight| flight.join().expect("a flight's thread")).collect()
    })
}

/// Returns the simulator's arguments for a vehicle set up by the files in `hardware/airframe`, with a pilot.
fn vehicle() -> Vec<String> {
    let path = vizflyt_e2e::root().join("hardware/airframe/whippet-copter-4.8.param");
    let text = std::fs::read_to_string(path).expect("the vehicle's parameters are there");
    let values: Vec<_> = text
        .lines()
        .filter_map(|line| line.split_once(','))
        .filter(|(name, _)| PARAMETERS.contains(name))
        .map(|(name, value)| format!("--param={name}={value}"))
        .collect();
    assert_eq!(values.len(), PARAMETERS.len(), "hardware/airframe lacks one of {PARAMETERS:?}");
    values.into_iter().chain(["--radio".to_owned()]).collect()
}

/// Strikes a vehicle that flies at its speed.
fn fly_one(lab: &Mutex<Lab>, run: Run, mut flight: Flight) -> Row {
    flight.until("\"phase\":\"flying\"");
    let start = flight.now().p_m;
    let way_m = run.speed_mps.mul_add(1.2, 0.2);
    wait(run.case.name, || (flight.now().p_m - start).truncate().length() > way_m);
    let last_good = flight.now();
    strike(lab, &mut flight, run.case.loss);
    let row = judge(run, &flight, last_good);
    // The runtime's own end is its own test's matter; a killed one has none.
    let poses = flight.guardian_poses();
    match run.case.loss {
        Loss::Runtime | Loss::Stopped => {
            assert!(poses > 40, "{}: {poses} poses by the guardian's own feed", run.case.name);
        }
        _ => {}
    }
    row
}

fn wait(what: &str, done: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !done() {
        assert!(Instant::now() < deadline, "{what}: waited in vain");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Lets the loss happen, and end if it does, on the simulator's clock.
fn strike(lab: &Mutex<Lab>, flight: &mut Flight, loss: Loss) {
    let since_s = flight.now().stamp_s;
    match loss {
        Loss::Runtime => flight.kill_runtime(),
        Loss::Stopped => flight.stop_runtime(),
        Loss::Jetson => flight.switch_off(),
        Loss::BridgeHangs => flight.stop_bridge(),
        Loss::All => {
            flight.switch_off();
            flight.cuts().poses.store(true, Ordering::Relaxed);
            flight.cuts().mavlink.store(true, Ordering::Relaxed);
        }
        Loss::Server => lab.lock().expect("nobody panics with it").kill_server(),
        Loss::Mavlink(seconds) => {
            flight.cuts().mavlink.store(true, Ordering::Relaxed);
            wait("the cut", || seconds == FOR_EVER || flight.now().stamp_s - since_s >= seconds);
            flight.cuts().mavlink.store(seconds == FOR_EVER, Ordering::Relaxed);
        }
        Loss::Bridge(seconds) => {
            flight.kill_bridge();
            if seconds < FOR_EVER {
                wait("the power cut", || flight.now().stamp_s - since_s >= seconds);
                flight.restart_bridge();
            }
        }
        Loss::Poses(seconds) => {
            flight.cuts().poses.store(true, Ordering::Relaxed);
            wait("the stall", || seconds == FOR_EVER || flight.now().stamp_s - since_s >= seconds);
            flight.cuts().poses.store(seconds == FOR_EVER, Ordering::Relaxed);
        }
        Loss::Autopilot => {
            let reboot = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
                command: MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
                param1: 1.0,
                // While armed it must be forced, as a fault would.
                param6: 20_190_226.0,
                target_system: 1,
                target_component: 1,
                ..Default::default()
            });
            let header = MavHeader { system_id: 254, component_id: 1, sequence: 0 };
            flight.tell_vehicle(encode(header, &reboot, &mut [0; MAX_PACKET]));
        }
    }
}

/// Watches the rest of a flight.
fn judge(run: Run, flight: &Flight, last_good: Sight) -> Row {
    let case = run.case;
    let lands = case.left != Left::FliesOn;
    let over_s = match case.loss {
        Loss::Mavlink(seconds) | Loss::Bridge(seconds) | Loss::Poses(seconds)
            if seconds < FOR_EVER =>
        {
            seconds
        }
        _ => 0.0,
    };
    let since_s = |sight: &Sight| sight.stamp_s - last_good.stamp_s;
    let is_down = |sight: &Sight| sight.p_m.z < DOWN_M;
    // One that lands is watched until it is down, or ought to be; one that flies on for a while.
    wait(case.name, || {
        let now = flight.now();
        if lands { is_down(&now) || since_s(&now) > 20.0 } else { since_s(&now) > over_s + WATCH_S }
    });
    let (track, modes) = flight.so_far();
    let lost: Vec<_> = track.iter().filter(|sight| sight.stamp_s >= last_good.stamp_s).collect();
    let down = lost.iter().find(|sight| is_down(sight));
    let until_s = match (lands, down) {
        (true, Some(down)) => since_s(down),
        (true, None) => f64::INFINITY,
        (false, _) => over_s,
    };
    let drift_m = lost
        .iter()
        .filter(|sight| since_s(sight) <= until_s)
        .map(|sight| (sight.p_m - last_good.p_m).truncate().length())
        .fold(0.0, f64::max);
    let at_s = |at: Instant| {
        lost.iter().find(|sight| sight.at >= at).map_or(f64::NAN, |sight| since_s(sight))
    };
    let land = CopterMode::Land as u32;
    let landed = modes.iter().find(|&&(at, mode)| mode == land && at >= last_good.at);
    let row = Row {
        run,
        // One that flies on stands later too, at the end of its way.
        stands_s: stands_s(&lost, &last_good).filter(|&s| lands || s <= over_s),
        lands_s: landed.map(|&(at, _)| at_s(at)),
        down_s: down.map(|sight| since_s(sight)),
        drift_m,
    };
    let outside = track.iter().find(|sight| !(FENCE_X_M.0..FENCE_X_M.1).contains(&sight.p_m.x));
    let way: Vec<_> = lost.iter().step_by(40).map(|sight| (since_s(sight), sight.p_m)).collect();
    assert!(outside.is_none(), "{}: left the fence: {outside:?}; {way:?}, {row:?}", case.name);
    row
}

/// When the vehicle first moved along the ground by less than 3 cm in a fifth of a second.
fn stands_s(lost: &[&Sight], last_good: &Sight) -> Option<f64> {
    let mut later = 0;
    lost.iter().find_map(|sight| {
        while lost.get(later)?.stamp_s < sight.stamp_s + 0.2 {
            later += 1;
        }
        let moved_m = (lost[later].p_m - sight.p_m).truncate().length();
        (moved_m < 0.03).then_some(sight.stamp_s - last_good.stamp_s)
    })
}

impl Row {
    /// Returns what breaks the promise.
    fn complaint(&self) -> Option<String> {
        let Run { case, speed_mps, .. } = self.run;
        let (name, within_m) = (case.name, self.run.drift_within_m());
        if !(self.drift_m <= within_m) {
            let drift_m = self.drift_m;
            return Some(format!(
                "{name}, {speed_mps} m/s: drifted by {drift_m:.2} of {within_m:.2} m"
            ));
        }
        match (case.left, self.down_s) {
            (Left::FliesOn, Some(_)) => Some(format!("{name}: it landed")),
            (Left::FliesOn, None) if self.lands_s.is_some() => {
                Some(format!("{name}: it began to land"))
            }
            (Left::FliesOn, None) => None,
            (_, None) => Some(format!("{name}, {speed_mps} m/s: it did not come down")),
            (_, Some(down_s)) if !(down_s <= self.run.down_within_s()) => {
                Some(format!("{name}, {speed_mps} m/s: down after {down_s:.2} s"))
            }
            _ => None,
        }
    }
}
