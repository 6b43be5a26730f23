//! The pose thread: measurements of all drivers in, poses, track and events out.
//!
//! ```text
//! source, IMUs -> a Referee for each vehicle (filter, rules) -> pose, track, events
//!                                                           \-> newest motions (mailbox)
//! ```
//! Budget: 20 us a pose, at 200 Hz for each vehicle, bounded by the referee's swept query. It is a
//! plain thread: tokio's timers are a millisecond late.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tracing::{trace_span, warn};
use vizflyt_arena::Referee;
use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_arena::neighbours::Neighbour;
use vizflyt_arena::pose::{Motion, Rejected};
use vizflyt_protocol::messages::PoseSample;

use crate::clock;
use crate::flights::events::Origin;
use crate::flights::vehicle::Vehicle;
use crate::hub::Hub;
use crate::lock::lock;
use crate::mailbox::Mailbox;
use crate::poses::drivers::{PoseSource, SourceCounters};

/// The newest poses on their way to the render thread, by vehicle.
pub type NewestPoses = [Option<Localized>; MAX_VEHICLES];

/// Where a vehicle is, and whereto it moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Localized {
    /// The newest believed pose.
    pub sample: PoseSample,
    /// How it moves by all that was read.
    pub motion: Motion,
}

impl Localized {
    /// Makes that of a vehicle that stands still.
    pub fn still(sample: PoseSample) -> Self {
        Self { sample, motion: Motion::at_rest(sample.stamp, sample.world_from_body) }
    }
}

/// Takes poses from `source` until the server stops; `referees` has one for each vehicle.
pub fn run(
    hub: &Arc<Hub>,
    source: &mut dyn PoseSource,
    referees: &mut [Referee],
    newest: &Mailbox<NewestPoses>,
) {
    let flights = hub.vehicles.iter().map(|vehicle| vehicle.flights());
    let mut watches: Vec<_> =
        flights.map(|flights| VehicleWatch { flights, ..VehicleWatch::default() }).collect();
    let mut quality_told = Instant::now();
    while !hub.stop.is_set() {
        let due = referees.iter().filter_map(Referee::poll_timeout).min();
        let due = due.map_or(PATIENCE, |due| {
            Duration::from_secs_f64(due.seconds_since(clock::now()).clamp(0.0, 1.0))
        });
        let measured = source.receive(due.min(PATIENCE));
        for ((vehicle, referee), watch) in hub.vehicles.iter().zip(&mut *referees).zip(&mut watches)
        {
            // A new runtime on the ground is a new flight: course and timer start afresh.
            let flights = vehicle.flights();
            if flights != watch.flights {
                watch.flights = flights;
                referee.restart();
            }
        }
        for (vehicle, referee) in hub.vehicles.iter().zip(&mut *referees) {
            while let Some(reading) = vehicle.next_feeling() {
                referee.handle_imu(&reading);
            }
        }
        // While packets keep coming, time is theirs: after a pause they arrive in a burst, each
        // old by now but followed by a newer one, and that is not a lost pose, of any vehicle.
        let mut judged_at = None;
        let mut believed = NewestPoses::default();
        for measured in measured {
            let index = measured.vehicle;
            let _span = trace_span!("pose", stamp_ns = measured.stamp.as_ns()).entered();
            let judging = referees[index].is_judging();
            match referees[index].handle_measurement(&measured.weighed()) {
                Ok(sample) => {
                    judged_at = judged_at.max(Some(sample.stamp));
                    believed[index] =
                        referees[index].motion().map(|motion| Localized { sample, motion });
                    introduce(hub, referees, index);
                    let vehicle = &hub.vehicles[index];
                    vehicle.pose.send_replace(Some(sample));
                    lock(&vehicle.track).add(&sample);
                    let referee = &referees[index];
                    // What ends the flight belongs to it.
                    let ends = judging && !referee.is_judging();
                    if ends || referee.is_judging() {
                        let clearance_m = referee.clearance_m(sample.world_from_body.translation_m);
                        let least_m = referee.least_clearance_m();
                        let mut samples = lock(&vehicle.samples);
                        if ends {
                            samples.end(&sample, clearance_m, least_m);
                        } else {
                            samples.add(&sample, clearance_m, least_m);
                        }
                    }
                }
                // Two frames of one burst may bear the same stamp: no fault of anyone's.
                Err(Rejected::Stale) => {
                    watches[index].rejected += 1;
                    judged_at = judged_at.max(Some(measured.stamp));
                }
                Err(reason) => {
                    let name = hub.source_names.get(usize::from(measured.source));
                    watches[index].rejected(&hub.vehicles[index], name, reason);
                }
            }
            hub.stats.pose.add(measured.arrival, clock::now());
        }
        if believed.iter().any(Option::is_some) {
            publish(newest, &believed);
        }
        let judged_at = judged_at.unwrap_or_else(clock::now);
        let mut all = SourceCounters::default();
        for ((vehicle, referee), watch) in hub.vehicles.iter().zip(&mut *referees).zip(&watches) {
            referee.handle_timeout(judged_at);
            while let Some(event) = referee.poll_event() {
                vehicle.log(Origin::Server, event);
            }
            let own = source.counters(vehicle.index);
            let own = SourceCounters { rejected: watch.rejected, ..own };
            *lock(&vehicle.source) = own;
            if quality_told.elapsed() > QUALITY_EVERY {
                tell_quality(hub, vehicle, referee);
            }
            all = all.and(own);
        }
        while let Some(warning) = source.next_warning() {
            warn!("{warning}");
            hub.note(&warning);
        }
        *lock(&hub.source) = all;
        if quality_told.elapsed() > QUALITY_EVERY {
            quality_told = Instant::now();
        }
    }
}

/// Tells the other vehicles' referees where a vehicle is.
fn introduce(hub: &Hub, referees: &mut [Referee], index: usize) {
    if hub.dynamic_objects.vehicles < 2 {
        return;
    }
    let vehicle = &hub.vehicles[index];
    let (name, radius_m) = (vehicle.name.clone(), vehicle.arena.body_radius_m);
    let neighbour = referees[index].motion().map(|motion| Neighbour { name, motion, radius_m });
    let others = referees.iter_mut().enumerate().filter(|(other, _)| *other != index);
    for (_, referee) in others {
        referee.handle_neighbour(index, neighbour.clone());
    }
}

/// Tells the page how good a vehicle's localization is.
fn tell_quality(hub: &Hub, vehicle: &Vehicle, referee: &Referee) {
    let mut quality = referee.quality(clock::now());
    for source in &mut quality.sources {
        if let Some(name) = hub.source_names.get(usize::from(source.source)) {
            source.name.clone_from(name);
        }
    }
    *lock(&vehicle.quality) = quality;
}

/// What the pose thread remembers of one vehicle.
#[derive(Debug, Default)]
struct VehicleWatch {
    flights: u64,
    rejected: u64,
    warned: Option<(Instant, std::mem::Discriminant<Rejected>)>,
}

impl VehicleWatch {
    fn rejected(&mut self, vehicle: &Vehicle, source: Option<&String>, reason: Rejected) {
        self.rejected += 1;
        // What is wrong in another way than before is news.
        let kind = std::mem::discriminant(&reason);
        let told = self.warned.is_some_and(|(at, told)| told == kind && at.elapsed() < WARN_EVERY);
        let quiet = self.warned.is_some_and(|(at, _)| at.elapsed() < WARN_APART);
        if told || quiet {
            return;
        }
        self.warned = Some((Instant::now(), kind));
        let text = source.map_or_else(|| reason.to_string(), |name| format!("{name}: {reason}"));
        warn!("{}: {text}", vehicle.name);
        vehicle.note(&text);
    }
}

/// Puts `believed` where the render thread takes it from; what it has not taken yet of vehicles
/// without a new pose is still their newest.
fn publish(newest: &Mailbox<NewestPoses>, believed: &NewestPoses) {
    newest.put_over(*believed, |poses, older| {
        for (pose, older) in poses.iter_mut().zip(older) {
            *pose = pose.or(*older);
        }
    });
}

/// Takes the poses of `newer` into `poses`, where there are any.
pub fn merge(newer: &NewestPoses, poses: &mut NewestPoses) {
    for (pose, newer) in poses.iter_mut().zip(newer) {
        *pose = newer.or(*pose);
    }
}

/// How long a stop may go unnoticed.
const PATIENCE: Duration = Duration::from_millis(100);
/// A source that sends nonsense does so 200 times a second.
const WARN_EVERY: Duration = Duration::from_secs(5);
/// Several sources that send different nonsense take turns.
const WARN_APART: Duration = Duration::from_secs(1);
/// How often the page hears of the localization's quality.
const QUALITY_EVERY: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::time::ServerTime;

    #[test]
    fn what_waits_for_the_render_thread_is_every_vehicles_newest() {
        let poses = |at_ns: [Option<u64>; 3]| {
            let mut poses = NewestPoses::default();
            for (pose, at_ns) in poses.iter_mut().zip(at_ns) {
                *pose = at_ns.map(|ns| {
                    let stamp = ServerTime::from_ns(ns);
                    Localized::still(PoseSample::still(stamp, Pose::IDENTITY))
                });
            }
            poses
        };
        let stamps =
            |poses: &NewestPoses| poses.map(|pose| pose.map(|pose| pose.sample.stamp.as_ns()));
        let newest = Mailbox::default();
        publish(&newest, &poses([Some(1), Some(2), None]));
        publish(&newest, &poses([Some(3), None, None]));
        publish(&newest, &poses([None, None, Some(4)]));
        let mut taken = newest.take(Duration::ZERO).unwrap();
        assert_eq!(stamps(&taken)[..4], [Some(3), Some(2), Some(4), None]);
        merge(&poses([None, Some(5), None]), &mut taken);
        assert_eq!(stamps(&taken)[..4], [Some(3), Some(5), Some(4), None]);
    }
}
