//! The losses of a process, with real processes in real time: whoever is left lands the vehicle inside the fence. The
//! vehicle is watched from outside, by the motion capture's own packets. How soon it is down and how far it drifts is
//! held by `failsafe`, which flies every loss on a virtual clock.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::lab::{Flight, Lab, Plan, Sight};
use glam::Vec3;
use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_splat::{format, ply};

/// Lost process.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Loss {
    /// The runtime is killed.
    Runtime,
    /// The runtime is stopped, as one that hangs.
    Stopped,
    /// The server is killed.
    Server,
}

/// A row of the table.
#[derive(Debug)]
struct Case {
    loss: Loss,
    /// How the row reads.
    name: &'static str,
    /// Who notices, and what it does.
    does: &'static str,
}

/// The losses that are a process's own.
const CASES: [Case; 3] = [
    Case { loss: Loss::Runtime, name: "the runtime is killed", does: "guardian: LAND at once" },
    Case {
        loss: Loss::Stopped,
        name: "the runtime is stopped",
        does: "guardian: LAND after 0.5 s",
    },
    Case {
        loss: Loss::Server,
        name: "the server is killed",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
    },
];

/// [m/s], and what asks the plugin for it.
const SPEED: (f64, &str) = (1.0, "world:1:0");

/// One flight: a row at a speed.
#[derive(Clone, Copy, Debug)]
struct Run {
    case: &'static Case,
    speed_mps: f64,
    /// What is asked of the plugin.
    how: &'static str,
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
fn vehicle_lands_after_the_loss_of_a_process() {
    let (speed_mps, how) = SPEED;
    let runs = CASES.iter().map(|case| Run { case, speed_mps, how }).collect::<Vec<_>>();
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
        let (stands_s, lands_s, drift_m) = (row.stands_s, row.lands_s, row.drift_m);
        println!(
            "{}, {speed_mps} m/s: {}; stands {stands_s:?}, LAND {lands_s:?}, drift {drift_m:.2} m",
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
            let plan = Plan { how: run.how, vehicle: &vehicle, ..Plan::default() };
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
    if matches!(run.case.loss, Loss::Runtime | Loss::Stopped) {
        assert!(poses > 40, "{}: {poses} poses by the guardian's own feed", run.case.name);
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

/// Lets the loss happen.
fn strike(lab: &Mutex<Lab>, flight: &mut Flight, loss: Loss) {
    match loss {
        Loss::Runtime => flight.kill_runtime(),
        Loss::Stopped => flight.stop_runtime(),
        Loss::Server => lab.lock().expect("nobody panics with it").kill_server(),
    }
}

/// Watches the rest of a flight.
fn judge(run: Run, flight: &Flight, last_good: Sight) -> Row {
    let case = run.case;
    let since_s = |sight: &Sight| sight.stamp_s - last_good.stamp_s;
    let is_down = |sight: &Sight| sight.p_m.z < DOWN_M;
    wait(case.name, || is_down(&flight.now()));
    let (track, modes) = flight.so_far();
    let lost: Vec<_> = track.iter().filter(|sight| sight.stamp_s >= last_good.stamp_s).collect();
    let down = lost.iter().find(|sight| is_down(sight));
    let until_s = down.map_or(f64::INFINITY, |sight| since_s(sight));
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
        stands_s: stands_s(&lost, &last_good),
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
    /// Returns what breaks the promise. How soon and how near is `failsafe`'s matter: here the computer may be busy.
    fn complaint(&self) -> Option<String> {
        let name = self.run.case.name;
        match (self.lands_s, self.down_s) {
            (Some(_), Some(_)) => None,
            found => Some(format!("{name}: LAND and down after {found:?} s")),
        }
    }
}
