//! Pauses: a process, or the whole machine, is not scheduled for a while. The vehicle flies on, and no pose is faster
//! than the vehicle.

use glam::DVec3;
use vizflyt_guardian::pulse::SILENCE_S;
use vizflyt_protocol::messages::FlightPhase;

use super::plugin::Deed;
use super::rig::{Place, Plan, Process, Rig};
use super::runtime::Settings;

/// Durations of the pauses. [s]
const PAUSES_S: [f64; 4] = [0.05, 0.1, 0.2, 0.4];
const PROCESSES: [Process; 6] = [
    Process::Simulator,
    Process::Server,
    Process::Bridge,
    Process::Guardian,
    Process::Runtime,
    Process::All,
];
const SPEED_MPS: f64 = 1.0;
/// Error of a speed due to noise and the turn of a manoeuvre. [m/s]
const NOISE_MPS: f64 = 0.3;
/// Times of the pauses: during the take-off, the acceleration, and the flight. [s]
const AFTER_S: [(FlightPhase, f64); 3] =
    [(FlightPhase::TakingOff, 1.0), (FlightPhase::Flying, 0.3), (FlightPhase::Flying, 2.0)];
/// Time for which the vehicle is observed after a pause. [s]
const WATCH_S: f64 = 1.6;
/// Maximum time until the vehicle flies. [s]
const READY_S: f64 = 60.0;

/// One flight with pauses of one process.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Run {
    process: Process,
    pause_s: f64,
    seed: u64,
}

/// Returns all flights.
pub(crate) fn runs() -> Vec<Run> {
    let all = PROCESSES.iter().flat_map(|&process| PAUSES_S.map(|pause_s| (process, pause_s)));
    let runs = (1..).zip(all).map(|(seed, (process, pause_s))| Run { process, pause_s, seed });
    // A guardian that is silent for longer has failed: the table of losses.
    runs.filter(|run| run.process != Process::Guardian || run.pause_s < SILENCE_S).collect()
}

/// Flies a run; returns its hash and what was wrong.
pub(crate) fn fly(place: &Place, params: &[(String, f32)], run: Run) -> (u64, Option<String>) {
    let Run { process, pause_s, seed } = run;
    let deeds = [Deed::World(DVec3::X * SPEED_MPS)];
    let settings = Settings { deeds: &deeds, restarts: 0, time_limit_s: 0.0 };
    let (params, bridge) = (params.to_vec(), process == Process::Bridge);
    let mut rig = Rig::new(&Plan { place, params, radio: true, bridge, seed, settings });
    let what = format!("{process:?} paused for {pause_s} s");
    for (phase, after_s) in AFTER_S {
        let reached =
            |rig: &Rig| rig.runtime().phase() == phase || rig.runtime().outcome().is_some();
        rig.until(&what, READY_S, reached);
        let since_s = rig.now_s();
        rig.until(&what, READY_S, |rig| rig.now_s() > since_s + after_s);
        rig.pause(process, pause_s);
        if phase == FlightPhase::Flying {
            rig.until(&what, READY_S, |rig| rig.now_s() > since_s + after_s + pause_s + WATCH_S);
        }
    }
    let outcome = rig.runtime().outcome();
    let (true_mps, pose_mps) = (rig.seen.fastest_mps, rig.seen.fastest_pose_mps);
    let is_wrong = outcome.is_some()
        || !rig.seen.orders.is_empty()
        || rig.runtime().phase() != FlightPhase::Flying
        || pose_mps > true_mps + NOISE_MPS;
    let complaint = is_wrong.then(|| {
        format!(
            "{what}: {outcome:?}, LAND {:?}, poses at {pose_mps:.2} m/s, vehicle at {true_mps:.2} m/s: {}",
            rig.seen.orders,
            rig.story()
        )
    });
    (rig.hash(), complaint)
}
