//! The chain of links between a pose and a motor, broken at each of its joints in flight. The vehicle
//! is watched from outside, by the motion capture's own packets: whatever is lost, it is down inside the fence, within 5 s
//! of the last good pose where somebody of ours is left to order LAND, within 9 s where only the autopilot is, whose
//! failsafes hover for 4 s first; it has drifted by 1 m at most; what comes back in time costs a pause and no landing.
//!
//! Prints the table of `docs/guides/failsafe.md`; with `VIZFLYT_LINKLOSS=write` writes it there.
//! Durations are the simulator's, so that a busy machine does not make the vehicle look slow.

#[path = "../lab/mod.rs"]
mod lab;
mod table;

use std::sync::Mutex;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use lab::{Flight, Lab, Plan, Sight};
use vizflyt_protocol::mavlink::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage};
use vizflyt_protocol::mavlink::{CopterMode, MAX_PACKET, MavHeader, encode};

/// What is lost.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Loss {
    /// The runtime is killed.
    Runtime,
    /// MAVLink stops both ways: Wi-Fi. [s]
    Mavlink(f64),
    /// The bridge is killed, and started again after so long. [s]
    Bridge(f64),
    /// The motion capture sees nothing. [s]
    Poses(f64),
    /// The server is killed.
    Server,
    /// The autopilot reboots.
    Autopilot,
}

/// For ever, as far as a flight goes. [s]
const FOR_EVER: f64 = 1e6;

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
    /// Whether the vehicle comes down; else it flies on.
    lands: bool,
}

impl Case {
    fn down_within_s(&self) -> f64 {
        if self.does.starts_with("autopilot") { DOWN_BY_AUTOPILOT_WITHIN_S } else { DOWN_WITHIN_S }
    }
}

const CASES: [Case; 13] = [
    Case {
        loss: Loss::Runtime,
        name: "the runtime is killed",
        does: "autopilot: stops by GUID_TIMEOUT, LAND by FS_GCS_TIMEOUT",
        bridge: false,
        lands: true,
    },
    Case {
        loss: Loss::Mavlink(FOR_EVER),
        name: "Wi-Fi dies",
        does: "autopilot: as above; runtime: LAND, unheard",
        bridge: false,
        lands: true,
    },
    Case {
        loss: Loss::Mavlink(1.0),
        name: "Wi-Fi is away for 1 s",
        does: "autopilot: stops by GUID_TIMEOUT, flies on",
        bridge: false,
        lands: false,
    },
    Case {
        loss: Loss::Poses(0.2),
        name: "the pose stalls for 200 ms",
        does: "runtime: holds after 0.15 s, flies on",
        bridge: false,
        lands: false,
    },
    Case {
        loss: Loss::Poses(1.0),
        name: "the pose stalls for 1 s",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        lands: true,
    },
    Case {
        loss: Loss::Poses(5.0),
        name: "the pose stalls for 5 s",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        lands: true,
    },
    Case {
        loss: Loss::Poses(FOR_EVER),
        name: "the pose is gone",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        lands: true,
    },
    Case {
        loss: Loss::Autopilot,
        name: "the autopilot reboots in flight",
        does: "nobody can: motors stop, it falls",
        bridge: false,
        lands: true,
    },
    Case {
        loss: Loss::Runtime,
        name: "the runtime is killed, behind a bridge",
        does: "bridge: LAND after 1 s",
        bridge: true,
        lands: true,
    },
    Case {
        loss: Loss::Mavlink(FOR_EVER),
        name: "Wi-Fi dies, behind a bridge",
        does: "bridge: LAND after 1 s; runtime: LAND, unheard",
        bridge: true,
        lands: true,
    },
    Case {
        loss: Loss::Bridge(FOR_EVER),
        name: "the bridge dies",
        does: "autopilot: stops by GUID_TIMEOUT, LAND by FS_GCS_TIMEOUT",
        bridge: true,
        lands: true,
    },
    Case {
        loss: Loss::Bridge(1.0),
        name: "the bridge loses power for 1 s",
        does: "autopilot: stops by GUID_TIMEOUT, flies on",
        bridge: true,
        lands: false,
    },
    Case {
        loss: Loss::Server,
        name: "the server is killed",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        lands: true,
    },
];

/// Vehicles that fly at a time; the server is the last row's, alone.
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
/// The promise: where somebody of ours orders LAND, and where the autopilot has to find out. [s], [m]
const DOWN_WITHIN_S: f64 = 5.0;
const DOWN_BY_AUTOPILOT_WITHIN_S: f64 = 9.0;
const MAX_DRIFT_M: f64 = 1.0;
/// How long a vehicle that shall fly on is watched after the loss is over. [s]
const WATCH_S: f64 = 3.0;
/// The room's fence, which the lab draws in. [m, world]
const FENCE_X_M: (f64, f64) = (0.0, 2.6);
/// A limit on waiting; nothing takes half as long.
const PATIENCE: Duration = Duration::from_mins(2);

/// A row as measured.
#[derive(Debug)]
struct Row {
    case: &'static Case,
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
    let mut rows = Vec::new();
    let (last, others) = CASES.split_last().expect("there are rows");
    for batch in others.chunks(TOGETHER) {
        let mut lab = Lab::open(TOGETHER);
        rows.extend(fly(&mut lab, batch));
    }
    let mut lab = Lab::open(1);
    rows.extend(fly(&mut lab, std::slice::from_ref(last)));
    let found = table::write(&rows);
    println!("{found}");
    let complaints: Vec<_> = rows.iter().filter_map(Row::complaint).collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
    if std::env::var("VIZFLYT_LINKLOSS").is_ok_and(|what| what == "write") {
        table::replace(&found);
    }
    table::compare(&rows);
}

/// Flies some cases at once, each with a thread that strikes it.
fn fly(lab: &mut Lab, cases: &'static [Case]) -> Vec<Row> {
    let vehicle = vehicle();
    let vehicle: Vec<&str> = vehicle.iter().map(String::as_str).collect();
    let start = |(index, case): (usize, &Case)| {
        let plan =
            Plan { how: "forward", vehicle: &vehicle, bridge: case.bridge, ..Plan::default() };
        lab.fly(index, plan)
    };
    let flights: Vec<_> = cases.iter().enumerate().map(start).collect();
    let lab = Mutex::new(lab);
    std::thread::scope(|scope| {
        let lab = &lab;
        let flights: Vec<_> = cases
            .iter()
            .zip(flights)
            .map(|(case, flight)| scope.spawn(move || fly_one(lab, case, flight)))
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

/// Strikes a vehicle half a metre into its flight, at 0.5 m/s.
fn fly_one(lab: &Mutex<&mut Lab>, case: &'static Case, mut flight: Flight) -> Row {
    flight.until("\"phase\":\"flying\"");
    let start = flight.now().p_m;
    wait(case.name, || (flight.now().p_m - start).truncate().length() > 0.4);
    let last_good = flight.now();
    strike(lab, &mut flight, case.loss);
    judge(case, flight, last_good)
}

fn wait(what: &str, done: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !done() {
        assert!(Instant::now() < deadline, "{what}: waited in vain");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Lets the loss happen, and end if it does, on the simulator's clock.
fn strike(lab: &Mutex<&mut Lab>, flight: &mut Flight, loss: Loss) {
    let since_s = flight.now().stamp_s;
    match loss {
        Loss::Runtime => flight.kill_runtime(),
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
fn judge(case: &'static Case, flight: Flight, last_good: Sight) -> Row {
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
        if case.lands {
            is_down(&now) || since_s(&now) > 2.0 * DOWN_BY_AUTOPILOT_WITHIN_S
        } else {
            since_s(&now) > over_s + WATCH_S
        }
    });
    let (track, modes) = flight.so_far();
    let lost: Vec<_> = track.iter().filter(|sight| sight.stamp_s >= last_good.stamp_s).collect();
    let down = lost.iter().find(|sight| is_down(sight));
    let until_s = match (case.lands, down) {
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
        case,
        // One that flies on stands later too, at the end of its way.
        stands_s: stands_s(&lost, &last_good).filter(|&s| case.lands || s <= over_s),
        lands_s: landed.map(|&(at, _)| at_s(at)),
        down_s: down.map(|sight| since_s(sight)),
        drift_m,
    };
    // The runtime's own end is its own test's matter; a killed one has none.
    drop(flight);
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
        let name = self.case.name;
        if !(self.drift_m <= MAX_DRIFT_M) {
            return Some(format!("{name}: drifted by {:.2} m", self.drift_m));
        }
        match (self.case.lands, self.down_s) {
            (true, None) => Some(format!("{name}: it did not come down")),
            (true, Some(down_s)) if !(down_s <= self.case.down_within_s()) => {
                Some(format!("{name}: down after {down_s:.2} s"))
            }
            (false, Some(_)) => Some(format!("{name}: it landed")),
            (false, None) if self.lands_s.is_some() => Some(format!("{name}: it began to land")),
            _ => None,
        }
    }
}
