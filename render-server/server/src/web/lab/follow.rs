//! Automatic part of a lab day, at 50 Hz: measures the live checks, observes trials of the stop button and the check of
//! axes by hand, and keeps flying vehicles apart.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::{MissedTickBehavior, interval};
use vizflyt_protocol::messages::{EventKind, FlightPhase};
use vizflyt_protocol::time::ServerTime;

use super::keep::{Keeper, Lab};
use crate::clock;
use crate::flights::events::Origin;
use crate::flights::lab_day::checks::{self, Traffic};
use crate::flights::lab_day::formation::{Airborne, SeparationWatch, TooClose};
use crate::flights::lab_day::pose_window::PoseWindow;
use crate::flights::lab_day::stop_trial::{Seen, StopTrial};
use crate::flights::lab_day::{CheckId, Finding};
use crate::flights::vehicle::VehicleFlight;
use crate::stream::Rooms;
use vizflyt_process::lock;

/// Follows all vehicles until the server stops.
pub(crate) async fn follow(rooms: Rooms, lab: Arc<Lab>) {
    let vehicles = &rooms.flights.vehicles;
    let mut watches: Vec<_> = vehicles.iter().map(|vehicle| VehicleWatch::of(vehicle)).collect();
    let mut separation = SeparationWatch::default();
    let mut keeper = Keeper::default();
    let mut looks = interval(Duration::from_millis(20));
    looks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    for n in 1_u64.. {
        looks.tick().await;
        let now = clock::now();
        keep_apart(&rooms, &lab, &mut separation);
        watch_hands(&rooms, &lab);
        for (vehicle, watch) in vehicles.iter().zip(&mut watches) {
            watch.look(&rooms, vehicle, now, &lab);
            if n.is_multiple_of(MEASURE_LOOKS) {
                watch.measure(&rooms, vehicle, now, &lab);
            }
        }
        if n.is_multiple_of(MEASURE_LOOKS) {
            keeper.begin(&lab);
        }
    }
}

/// Returns the vehicles in the air that have a current pose.
pub(in crate::web) fn airborne(rooms: &Rooms) -> Vec<Airborne> {
    let now = clock::now();
    let seen = rooms.flights.vehicles.iter().filter_map(|vehicle| {
        let took_off = vehicle.flight().took_off.filter(|_| vehicle.under_way())?;
        let pose = rooms.localization.vehicles[vehicle.index].sample()?;
        let is_fresh = now.seconds_since(pose.stamp) < FRESH_S;
        is_fresh.then(|| Airborne {
            vehicle: vehicle.index,
            p_world_m: pose.world_from_body.translation_m,
            took_off_s: took_off.as_ns() as f64 * 1e-9,
        })
    });
    seen.collect()
}

/// Lands vehicles that have come too close to each other.
fn keep_apart(rooms: &Rooms, lab: &Lab, watch: &mut SeparationWatch) {
    let Some(least_m) = lab.look(|day| day.separation_m) else { return };
    let vehicles = &rooms.flights.vehicles;
    for TooClose { first, later, apart_m, land } in watch.judge(least_m, &airborne(rooms)) {
        let (first, later) = (&vehicles[first].name, &vehicles[later].name);
        let who = if land.len() > 1 { "both land" } else { "lands" };
        for vehicle in land.iter().filter_map(|&index| vehicles.get(index)) {
            let landed = if land.len() > 1 { String::new() } else { format!("{} ", vehicle.name) };
            let text = format!(
                "{first} and {later}, which took off later, are {apart_m:.2} m apart, less than {least_m} m: \
                 {landed}{who}"
            );
            vehicle.publish(EventKind::EmergencyStop, &text);
            lab.change(|day, now_unix_ms| day.tell(text, now_unix_ms));
        }
    }
}

/// Passes the pose of the hand-held vehicle to the check of its axes.
fn watch_hands(rooms: &Rooms, lab: &Lab) {
    let mut guided = lock(&lab.guided);
    let Some(check) = guided.as_mut() else { return };
    let Some(pose) = rooms.localization.vehicles[check.vehicle].sample() else { return };
    if let Some(finding) = check.handle_pose(&pose) {
        let (name, by) = (&rooms.flights.vehicles[check.vehicle].name, check.by.clone());
        lab.change(|day, now| day.record(name, CheckId::Axes, finding, &by, now));
        *guided = None;
    }
}

/// State of one vehicle.
struct VehicleWatch {
    poses: PoseWindow,
    traffic: VecDeque<Traffic>,
    /// Index of the first unprocessed event.
    event: u64,
    trial: Option<(StopTrial, String)>,
}

impl VehicleWatch {
    fn of(vehicle: &VehicleFlight) -> Self {
        Self {
            poses: PoseWindow::default(),
            traffic: VecDeque::new(),
            event: vehicle.events.next_index(),
            trial: None,
        }
    }

    /// Processes pose, events and reports.
    fn look(&mut self, rooms: &Rooms, vehicle: &VehicleFlight, now: ServerTime, lab: &Lab) {
        if let Some(pose) = rooms.localization.vehicles[vehicle.index].sample() {
            self.poses.push(&pose);
        }
        let events = vehicle.events.read(&mut self.event).unwrap_or_else(|lagged| {
            self.event = lagged.oldest;
            vehicle.events.read(&mut self.event).unwrap_or_default()
        });
        for entry in events {
            let is_stop =
                entry.event.kind == EventKind::EmergencyStop && entry.origin == Origin::Server;
            // Pressing again belongs to the same trial.
            if is_stop && self.trial.is_none() && vehicle.runtime().is_some() {
                let trial = StopTrial::new(entry.index + 1, entry.event.stamp);
                self.trial = Some((trial, entry.event.text.as_str().to_owned()));
            }
        }
        let Some((trial, by)) = &mut self.trial else { return };
        let report = vehicle.telemetry.borrow().clone().unwrap_or_default();
        let (phase, armed) = (report.phase, report.vehicle.armed);
        trial.handle(now, Seen { received: *vehicle.received.borrow(), phase, armed });
        if let Some(finding) = trial.result(now) {
            lab.change(|day, now_unix_ms| {
                day.record(&vehicle.name, CheckId::Stop, finding, by, now_unix_ms)
            });
            self.trial = None;
        }
    }

    /// Measures all checks that are possible now.
    fn measure(&mut self, rooms: &Rooms, vehicle: &VehicleFlight, now: ServerTime, lab: &Lab) {
        use FlightPhase::{Connecting, Landed, Preparing, Waiting};
        let (name, index) = (&vehicle.name, vehicle.index);
        let found = |check, finding: Option<Finding>| {
            if let Some(finding) = finding {
                lab.measured(name, check, finding);
            }
        };
        let now_s = now.as_ns() as f64 * 1e-9;
        let quality = lock(&rooms.localization.vehicles[index].quality).clone();
        found(
            CheckId::Localization,
            checks::localization(now_s, &self.poses, &quality, &vehicle.arena),
        );
        let stream = &rooms.streaming.vehicles[index];
        let Some(connection) = vehicle.runtime().and_then(|_| stream.connection()) else {
            self.traffic.clear();
            return;
        };
        let traffic = Traffic {
            at_s: now_s,
            rtt_ms: connection.rtt_ms,
            sent: connection.packets_sent,
            lost: connection.packets_lost,
            bytes: connection.bytes_sent,
        };
        if self.traffic.back().is_some_and(|last| traffic.sent < last.sent) {
            self.traffic.clear();
        }
        self.traffic.push_back(traffic);
        if self.traffic.len() > TRAFFIC_KEPT {
            self.traffic.pop_front();
        }
        found(
            CheckId::Network,
            self.traffic.front().and_then(|before| checks::network(before, &traffic)),
        );
        let timing = stream.timing.borrow().clone().unwrap_or_default();
        found(CheckId::Clocks, timing.clock.as_ref().map(checks::clocks));
        let report = vehicle.telemetry.borrow().clone().unwrap_or_default();
        // Before preparation is complete, images are late and the autopilot has not answered yet.
        if matches!(report.phase, Connecting | Preparing) {
            return;
        }
        let (seen, age) = (&timing.waterfall, &timing.waterfall.age);
        found(CheckId::Latency, checks::latency(age.p50, age.p99, seen.images, timing.seconds));
        // The battery discharges in flight; the check is about its charge at take-off.
        if matches!(report.phase, Waiting | Landed) {
            found(CheckId::Battery, Some(checks::battery(&report.vehicle)));
        }
        let guarded = *vehicle.guarded.borrow();
        let fence = guarded.map(|guarded| {
            lab.look(|day| {
                checks::fence(&vehicle.arena, &guarded, day.fence(name, super::keep::unix_ms()))
            })
        });
        found(CheckId::Fence, fence);
    }
}

/// Checks are measured once per second.
const MEASURE_LOOKS: u64 = 50;
/// Maximum age of a vehicle's pose. [s]
const FRESH_S: f64 = 0.5;
/// Traffic is evaluated over five seconds.
const TRAFFIC_KEPT: usize = 6;
