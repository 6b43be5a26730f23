//! Losses in flight: each part of the chain between pose and motor fails.

use vizflyt_guardian::watch::COMPONENT_ID as GUARDIAN;
use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::messages::FlightPhase;
use vizflyt_runtime::link::COMPONENT_ID as RUNTIME;

use glam::DVec3;
use vizflyt_bridge::bridge::COMPONENT_ID as BRIDGE;

use super::plugin::Deed;
use super::rig::{Capture, Place, Plan, Rig, Sight};
use super::runtime::Settings;

/// Lost program or link.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Loss {
    /// The runtime is killed.
    Runtime,
    /// The runtime is stopped, as if it hangs.
    Stopped,
    /// The guardian is killed.
    Guardian,
    /// The guardian is stopped, as if it hangs, and then continued. [s]
    GuardianStopped(f64),
    /// The runtime and its guardian are killed.
    Jetson,
    /// MAVLink stops in both directions, as on a loss of Wi-Fi. [s]
    Mavlink(f64),
    /// The bridge is stopped, as if it hangs.
    BridgeHangs,
    /// The bridge is without power. [s]
    Bridge(f64),
    /// The motion capture sends no poses. [s]
    Poses(f64),
    /// The motion capture sends something other than the vehicle's pose.
    Capture(Capture),
    /// The server is killed.
    Server,
    /// The autopilot reboots.
    Autopilot,
    /// Loss of runtime, guardian, poses and MAVLink.
    All,
}

/// Longer than any flight. [s]
const FOR_EVER: f64 = 1e6;

/// What lands the vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
enum By {
    /// The first LAND that reaches the autopilot comes from this component.
    Order(u8),
    /// A failsafe of the autopilot.
    Autopilot,
    /// Gravity.
    Gravity,
    /// Nothing: the vehicle flies on.
    FliesOn,
}

/// A row of the table.
#[derive(Debug)]
pub(crate) struct Case {
    loss: Loss,
    /// Name in the table.
    pub(crate) name: &'static str,
    /// Reaction, with the part that reacts.
    pub(crate) does: &'static str,
    /// MAVLink goes through a bridge.
    bridge: bool,
    by: By,
    /// Maximum time from the loss to LAND. [s]
    land_within_s: f64,
}

/// Losses at each of [`SPEEDS_MPS`].
const AT_ALL_SPEEDS: [Case; 16] = [
    Case {
        loss: Loss::Runtime,
        name: "the runtime is killed",
        does: "guardian: LAND at once",
        bridge: false,
        by: By::Order(GUARDIAN),
        land_within_s: 0.02,
    },
    Case {
        loss: Loss::Stopped,
        name: "the runtime is stopped",
        does: "guardian: LAND after 0.5 s",
        bridge: false,
        by: By::Order(GUARDIAN),
        land_within_s: 0.55,
    },
    Case {
        loss: Loss::Runtime,
        name: "the runtime is killed, behind a bridge",
        does: "guardian: LAND at once",
        bridge: true,
        by: By::Order(GUARDIAN),
        land_within_s: 0.02,
    },
    Case {
        loss: Loss::Guardian,
        name: "the guardian is killed",
        does: "runtime: LAND at once",
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.02,
    },
    Case {
        loss: Loss::GuardianStopped(FOR_EVER),
        name: "the guardian is stopped",
        does: "runtime: LAND after 0.3 s",
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.4,
    },
    Case {
        loss: Loss::GuardianStopped(1.0),
        name: "the guardian is stopped and continued after 1 s",
        does: "runtime: LAND after 0.3 s",
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.4,
    },
    Case {
        loss: Loss::Guardian,
        name: "the guardian is killed, behind a bridge",
        does: "runtime: LAND at once",
        bridge: true,
        by: By::Order(RUNTIME),
        land_within_s: 0.02,
    },
    Case {
        loss: Loss::GuardianStopped(FOR_EVER),
        name: "the guardian is stopped, behind a bridge",
        does: "runtime: LAND after 0.3 s",
        bridge: true,
        by: By::Order(RUNTIME),
        land_within_s: 0.4,
    },
    Case {
        loss: Loss::Server,
        name: "the server is killed",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.55,
    },
    Case {
        loss: Loss::Poses(FOR_EVER),
        name: "the pose is gone",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.55,
    },
    Case {
        loss: Loss::Mavlink(FOR_EVER),
        name: "Wi-Fi dies, behind a bridge",
        does: "bridge: LAND after 1 s",
        bridge: true,
        by: By::Order(BRIDGE),
        land_within_s: 1.05,
    },
    Case {
        loss: Loss::Jetson,
        name: "the Jetson is off, behind a bridge",
        does: "bridge: LAND after 1 s",
        bridge: true,
        by: By::Order(BRIDGE),
        land_within_s: 1.05,
    },
    Case {
        loss: Loss::Jetson,
        name: "the Jetson is off",
        does: BY_AUTOPILOT,
        bridge: false,
        by: By::Autopilot,
        land_within_s: 2.1,
    },
    Case {
        loss: Loss::Mavlink(FOR_EVER),
        name: "Wi-Fi dies",
        does: BY_AUTOPILOT,
        bridge: false,
        by: By::Autopilot,
        land_within_s: 2.1,
    },
    Case {
        loss: Loss::BridgeHangs,
        name: "the bridge hangs",
        does: BY_AUTOPILOT,
        bridge: true,
        by: By::Autopilot,
        land_within_s: 2.1,
    },
    Case {
        loss: Loss::All,
        name: "all at once",
        does: BY_AUTOPILOT,
        bridge: false,
        by: By::Autopilot,
        land_within_s: 2.1,
    },
];

const HOLDS_AND_LANDS: &str = "runtime: holds after 0.15 s, LAND after 0.5 s";
const BY_AUTOPILOT: &str = "autopilot: stops by GUID_TIMEOUT, LAND by FS_GCS_TIMEOUT";

/// Losses at the lowest of [`SPEEDS_MPS`].
const AT_ONE_SPEED: [Case; 10] = [
    Case {
        loss: Loss::Autopilot,
        name: "the autopilot reboots in flight",
        does: "none possible: motors stop, it falls",
        bridge: false,
        by: By::Gravity,
        land_within_s: 0.0,
    },
    Case {
        loss: Loss::GuardianStopped(0.2),
        name: "the guardian is stopped for 200 ms",
        does: "none: it flies on",
        bridge: false,
        by: By::FliesOn,
        land_within_s: 0.0,
    },
    Case {
        loss: Loss::Mavlink(1.0),
        name: "Wi-Fi is away for 1 s",
        does: "autopilot: stops by GUID_TIMEOUT, flies on",
        bridge: false,
        by: By::FliesOn,
        land_within_s: 0.0,
    },
    Case {
        loss: Loss::Bridge(1.0),
        name: "the bridge loses power for 1 s",
        does: "autopilot: stops by GUID_TIMEOUT, flies on",
        bridge: true,
        by: By::FliesOn,
        land_within_s: 0.0,
    },
    Case {
        loss: Loss::Poses(0.2),
        name: "the pose stalls for 200 ms",
        does: "runtime: holds after 0.15 s, flies on",
        bridge: false,
        by: By::FliesOn,
        land_within_s: 0.0,
    },
    Case {
        loss: Loss::Poses(1.0),
        name: "the pose stalls for 1 s",
        does: "runtime: holds after 0.15 s, LAND after 0.5 s",
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.55,
    },
    Case {
        loss: Loss::Bridge(FOR_EVER),
        name: "the bridge loses power",
        does: BY_AUTOPILOT,
        bridge: true,
        by: By::Autopilot,
        land_within_s: 2.1,
    },
    Case {
        loss: Loss::Capture(Capture::Repeats),
        name: "the pose repeats",
        does: HOLDS_AND_LANDS,
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.55,
    },
    Case {
        loss: Loss::Capture(Capture::Origin),
        name: "the pose is the origin: the vehicle is not visible",
        does: HOLDS_AND_LANDS,
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.55,
    },
    Case {
        loss: Loss::Capture(Capture::SecondSender),
        name: "a second program sends poses of the vehicle",
        does: HOLDS_AND_LANDS,
        bridge: false,
        by: By::Order(RUNTIME),
        land_within_s: 0.55,
    },
];

/// Speeds at the time of the loss. [m/s]
const SPEEDS_MPS: [f64; 3] = [0.35, 1.0, 2.5];

/// One flight: a loss at a speed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Run {
    pub(crate) case: &'static Case,
    pub(crate) speed_mps: f64,
    /// Seed of noise and delays.
    seed: u64,
}

/// Maximum height of a vehicle that is down. [m]
const DOWN_M: f64 = 0.05;
/// Time after the end of the loss for which a vehicle that flies on is observed. [s]
const WATCH_S: f64 = 3.0;
/// Maximum time until a vehicle is down. [s]
const LONGEST_S: f64 = 20.0;
/// Maximum time until a vehicle flies. [s]
const READY_S: f64 = 60.0;
/// Minimum number of the guardian's poses until the vehicle is down: 50 per second.
const GUARDIAN_POSES: u32 = 80;

/// Measured result of a flight.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    pub(crate) run: Run,
    /// Time from the loss until the vehicle stopped, or only descended. [s]
    pub(crate) stands_s: Option<f64>,
    /// Time from the loss to LAND. [s]
    pub(crate) lands_s: Option<f64>,
    /// Time from the last good pose until the vehicle was down. [s]
    pub(crate) down_s: Option<f64>,
    /// Maximum horizontal distance from the position of the last good pose, until the vehicle was down or the loss
    /// ended. [m]
    pub(crate) drift_m: f64,
    /// Component that first ordered LAND.
    ordered_by: Option<u8>,
    guardian_poses: u32,
    /// The vehicle stayed inside the room's fence.
    is_inside: bool,
    pub(crate) hash: u64,
}

/// Returns all flights, in the order of the table.
pub(crate) fn runs() -> Vec<Run> {
    let at_all =
        AT_ALL_SPEEDS.iter().flat_map(|case| SPEEDS_MPS.map(|speed_mps| (case, speed_mps)));
    let at_one = AT_ONE_SPEED.iter().map(|case| (case, SPEEDS_MPS[0]));
    let seeded = |(seed, (case, speed_mps))| Run { case, speed_mps, seed };
    (1..).zip(at_all.chain(at_one)).map(seeded).collect()
}

/// Flies a run: causes the loss at the run's speed, and observes the rest of the flight.
pub(crate) fn fly(place: &Place, params: &[(String, f32)], run: Run) -> Row {
    let Run { case, speed_mps, seed } = run;
    let deeds = [Deed::World(DVec3::X * speed_mps)];
    let settings = Settings { deeds: &deeds, restarts: 0, time_limit_s: 0.0 };
    let (params, bridge) = (params.to_vec(), case.bridge);
    let mut rig = Rig::new(&Plan { place, params, radio: true, bridge, seed, settings });
    rig.until(case.name, READY_S, |rig| rig.runtime().phase() == FlightPhase::Flying);
    let start_m = rig.sight().p_m;
    let way_m = speed_mps.mul_add(1.2, 0.2);
    rig.until(case.name, READY_S, |rig| (rig.sight().p_m - start_m).truncate().length() > way_m);
    let last_good = rig.sight();
    let over_s = strike(&mut rig, case);
    let since_s = |rig: &Rig| rig.now_s() - last_good.at_s;
    let lands = case.by != By::FliesOn;
    // A landing vehicle is observed until it is down or overdue; one that flies on, for a while.
    rig.until(case.name, 2.0 * LONGEST_S, |rig| {
        if lands {
            rig.sight().p_m.z < DOWN_M || since_s(rig) > LONGEST_S
        } else {
            since_s(rig) > over_s + WATCH_S
        }
    });
    measure(place, run, &rig, last_good, over_s)
}

/// Causes the loss, and ends it if it is temporary; returns its duration, 0 if permanent. [s]
fn strike(rig: &mut Rig, case: &Case) -> f64 {
    let since_s = rig.now_s();
    let lasts_s = match case.loss {
        Loss::Mavlink(seconds)
        | Loss::Bridge(seconds)
        | Loss::Poses(seconds)
        | Loss::GuardianStopped(seconds)
            if seconds < FOR_EVER =>
        {
            seconds
        }
        _ => 0.0,
    };
    match case.loss {
        Loss::Runtime => rig.kill_runtime(),
        Loss::Stopped => rig.stop_runtime(),
        Loss::Guardian => rig.kill_guardian(),
        Loss::GuardianStopped(_) => rig.stop_guardian(true),
        Loss::Jetson => rig.switch_off(),
        Loss::BridgeHangs => rig.hang_bridge(),
        Loss::Server => rig.kill_server(),
        Loss::Autopilot => rig.reboot_autopilot(),
        Loss::Mavlink(_) => rig.wires.cut_mavlink(true),
        Loss::Bridge(_) => rig.kill_bridge(),
        Loss::Poses(_) => rig.wires.capture.is_cut = true,
        Loss::Capture(capture) => rig.capture = capture,
        Loss::All => {
            rig.switch_off();
            rig.wires.capture.is_cut = true;
            rig.wires.cut_mavlink(true);
        }
    }
    if lasts_s > 0.0 {
        rig.until(case.name, 2.0 * lasts_s, |rig| rig.now_s() - since_s >= lasts_s);
        match case.loss {
            Loss::Bridge(_) => rig.restart_bridge(),
            Loss::Poses(_) => rig.wires.capture.is_cut = false,
            Loss::GuardianStopped(_) => rig.stop_guardian(false),
            _ => rig.wires.cut_mavlink(false),
        }
    }
    lasts_s
}

fn measure(place: &Place, run: Run, rig: &Rig, last_good: Sight, over_s: f64) -> Row {
    let lands = run.case.by != By::FliesOn;
    let since_s = |sight: &Sight| sight.at_s - last_good.at_s;
    let track = &rig.seen.track;
    let lost: Vec<_> = track.iter().filter(|sight| since_s(sight) >= 0.0).collect();
    let down_s = lost.iter().find(|sight| sight.p_m.z < DOWN_M).map(|sight| since_s(sight));
    let until_s = if lands { down_s.unwrap_or(f64::INFINITY) } else { over_s };
    let drift_m = lost
        .iter()
        .filter(|sight| since_s(sight) <= until_s)
        .map(|sight| (sight.p_m - last_good.p_m).truncate().length())
        .fold(0.0, f64::max);
    let after = |at_s: f64| (at_s >= last_good.at_s).then_some(at_s - last_good.at_s);
    let is_land = |&&(_, mode): &&(f64, CopterMode)| mode == CopterMode::Land;
    let fence = &place.arena.geofence;
    Row {
        run,
        // A vehicle that flies on also stops later, at the end of its path.
        stands_s: stands_s(&lost, &last_good).filter(|&s| lands || s <= over_s),
        lands_s: rig.seen.modes.iter().filter(is_land).find_map(|&(at_s, _)| after(at_s)),
        down_s,
        drift_m,
        ordered_by: rig.seen.orders.first().map(|&(_, component)| component),
        guardian_poses: rig.seen.guardian_poses,
        is_inside: track
            .iter()
            .all(|sight| (sight.p_m.cmpgt(fence.min_m) & sight.p_m.cmplt(fence.max_m)).all()),
        hash: rig.hash(),
    }
}

/// Returns when the vehicle first moved less than 3 cm horizontally in 0.2 s.
fn stands_s(lost: &[&Sight], last_good: &Sight) -> Option<f64> {
    let mut later = 0;
    lost.iter().find_map(|sight| {
        while lost.get(later)?.at_s < sight.at_s + 0.2 {
            later += 1;
        }
        let moved_m = (lost[later].p_m - sight.p_m).truncate().length();
        (moved_m < 0.03).then_some(sight.at_s - last_good.at_s)
    })
}

impl Run {
    /// Returns the maximum time until down, from 1.2 m. [s]
    fn down_within_s(self) -> f64 {
        if self.case.by == By::Autopilot { 9.0 } else { 5.0 }
    }

    /// Returns the maximum drift from the position of the last good pose. [m]
    fn drift_within_m(self) -> f64 {
        match (self.case.by, self.case.loss) {
            // Without control for eight seconds.
            (By::Autopilot, _) => 2.0 + 0.8 * self.speed_mps,
            // The bridge waits for a second.
            (_, Loss::Jetson | Loss::Mavlink(_)) => 0.5 + self.speed_mps,
            _ => 0.5 + 0.8 * self.speed_mps,
        }
    }
}

impl Row {
    /// Returns the violated requirement, if any.
    pub(crate) fn complaint(&self) -> Option<String> {
        let Run { case, speed_mps, .. } = self.run;
        let complain = |what: String| Some(format!("{}, {speed_mps} m/s: {what}", case.name));
        let within_m = self.run.drift_within_m();
        if !(self.drift_m <= within_m) {
            return complain(format!("drifted by {:.2} of {within_m:.2} m", self.drift_m));
        }
        if !self.is_inside {
            return complain("it left the fence".to_owned());
        }
        if case.by == By::FliesOn {
            let is_down = self.down_s.is_some() || self.lands_s.is_some();
            return if is_down { complain(format!("it landed: {self:?}")) } else { None };
        }
        if !self.down_s.is_some_and(|down_s| down_s <= self.run.down_within_s()) {
            return complain(format!("down after {:?} s", self.down_s));
        }
        if case.by != By::Gravity && !self.lands_s.is_some_and(|s| s <= case.land_within_s) {
            return complain(format!("LAND after {:?} s", self.lands_s));
        }
        let orders = if let By::Order(component) = case.by { Some(component) } else { None };
        if self.ordered_by != orders && case.by != By::Gravity {
            return complain(format!("LAND was ordered by {:?}", self.ordered_by));
        }
        let is_fed = !matches!(case.loss, Loss::Runtime | Loss::Stopped)
            || self.guardian_poses >= GUARDIAN_POSES;
        if is_fed {
            None
        } else {
            complain(format!("{} poses by the guardian", self.guardian_poses))
        }
    }
}

impl Row {
    /// Returns the row in the format of the guide's table.
    pub(crate) fn line(&self) -> String {
        let Run { case, speed_mps, .. } = self.run;
        let seconds =
            |value: Option<f64>| value.map_or("-".to_owned(), |seconds| format!("{seconds:.1} s"));
        let lands =
            if case.by == By::FliesOn { "flies on".to_owned() } else { seconds(self.lands_s) };
        format!(
            "| {} | {} | {speed_mps} m/s | {} | {lands} | {} | {:.2} m |",
            case.name,
            case.does,
            seconds(self.stands_s),
            seconds(self.down_s),
            self.drift_m
        )
    }
}
