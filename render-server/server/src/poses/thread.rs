//! Pose thread: processes measurements of all drivers into poses, track and events.
//!
//! ```text
//! source, IMUs -> a Referee for each vehicle (filter, rules) -> pose, track, events
//!                                                           \-> the newest pose and motion
//! ```
//! Budget: 20 us a pose, at 200 Hz for each vehicle; the referee's swept query bounds it. It is a plain thread
//! because tokio's timers are a millisecond late.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tracing::{trace_span, warn};
use vizflyt_arena::Referee;
use vizflyt_arena::neighbours::Neighbour;
use vizflyt_arena::pose::Rejected;
use vizflyt_protocol::messages::PoseSample;
use vizflyt_protocol::time::ServerTime;

use super::Localization;
use super::drivers::{Measurement, PoseSource, SourceCounters};
use super::margin::MarginWatch;
use super::newest::Localized;
use crate::clock;
use crate::flights::Flights;
use crate::flights::events::Origin;
use crate::flights::vehicle::VehicleFlight;
use crate::stop::Stop;
use vizflyt_process::lock;

/// Inputs and outputs of the pose thread.
#[derive(Debug)]
pub struct PoseThread {
    /// Receives poses, quality and counters.
    pub localization: Arc<Localization>,
    /// Receives events, track and samples.
    pub flights: Arc<Flights>,
    /// Referees by index of the vehicle.
    pub referees: Vec<Referee>,
    /// Whether the vehicles see and collide with each other.
    pub neighbours: bool,
}

impl PoseThread {
    /// Processes measurements from `source` until the server stops.
    pub fn run(mut self, source: &mut dyn PoseSource, stop: &Stop) {
        let mut watches: Vec<_> =
            self.flights.vehicles.iter().map(|vehicle| VehicleWatch::of(vehicle)).collect();
        let mut quality_due = Instant::now() + QUALITY_EVERY;
        while !stop.is_set() {
            let due = self.referees.iter().filter_map(Referee::poll_timeout).min();
            let due = due.map_or(PATIENCE, |due| {
                Duration::from_secs_f64(due.seconds_since(clock::now()).clamp(0.0, 1.0))
            });
            let measured = source.receive(due.min(PATIENCE));
            self.follow_flights(&mut watches);
            self.take_imu();
            // While packets keep arriving, their stamps are the current time. After a pause packets arrive in a
            // burst: each is old, but followed by a newer one, and no vehicle has lost a pose.
            let mut judged_at = None;
            for measurement in measured {
                let stamp = self.take(measurement, &mut watches);
                judged_at = judged_at.max(stamp);
                self.localization.durations.add(measurement.arrival, clock::now());
            }
            self.judge(judged_at.unwrap_or_else(clock::now));
            self.count(source, &watches);
            while let Some(warning) = source.next_warning() {
                warn!("{warning}");
                self.flights.note(&warning);
            }
            if Instant::now() >= quality_due {
                quality_due = Instant::now() + QUALITY_EVERY;
                self.publish_quality(&mut watches);
            }
        }
    }

    /// Restarts course and timer when a new flight has begun; passes events of runtime and users to the
    /// referee.
    fn follow_flights(&mut self, watches: &mut [VehicleWatch]) {
        let vehicles = self.flights.vehicles.iter().zip(&mut self.referees).zip(watches);
        for ((vehicle, referee), watch) in vehicles {
            let flights = vehicle.flights();
            if flights != watch.flights {
                watch.flights = flights;
                referee.restart();
            }
            // Only log lines of plugins are dropped from the event log.
            let events = vehicle.events.read(&mut watch.event).unwrap_or_else(|lagged| {
                watch.event = lagged.oldest;
                vehicle.events.read(&mut watch.event).unwrap_or_default()
            });
            for entry in &events {
                referee.handle_event(&entry.event);
            }
        }
    }

    fn take_imu(&mut self) {
        for (vehicle, referee) in self.localization.vehicles.iter().zip(&mut self.referees) {
            while let Some(reading) = vehicle.pop_imu() {
                referee.handle_imu(&reading);
            }
        }
    }

    /// Processes one measurement. Returns its stamp, unless its contents were rejected.
    fn take(
        &mut self,
        measurement: &Measurement,
        watches: &mut [VehicleWatch],
    ) -> Option<ServerTime> {
        let index = measurement.vehicle;
        let _span = trace_span!("pose", stamp_ns = measurement.stamp.as_ns()).entered();
        let referee = &mut self.referees[index];
        let was_judging = referee.is_judging();
        match referee.handle_measurement(&measurement.with_covariance()) {
            Ok(sample) => {
                let motion = referee.motion();
                self.share_neighbours(index);
                let still = Localized::still(sample);
                let newest = motion.map_or(still, |motion| Localized { sample, motion });
                self.localization.vehicles[index].newest.send_replace(Some(newest));
                self.localization.accepted.put(());
                self.record(index, &sample, was_judging);
                Some(sample.stamp)
            }
            // Two frames of one burst may have the same stamp; this is not an error.
            Err(Rejected::Stale) => {
                watches[index].rejected += 1;
                Some(measurement.stamp)
            }
            Err(reason) => {
                let name = self.localization.source_names.get(usize::from(measurement.source));
                watches[index].reject(&self.flights.vehicles[index], name, reason);
                None
            }
        }
    }

    /// Adds a pose to the track and, while the referee judges, to the samples of the flight.
    fn record(&self, index: usize, sample: &PoseSample, was_judging: bool) {
        let (vehicle, referee) = (&self.flights.vehicles[index], &self.referees[index]);
        lock(&vehicle.track).add(sample);
        // The pose that ends the flight belongs to it.
        let ends = was_judging && !referee.is_judging();
        if !(ends || referee.is_judging()) {
            return;
        }
        let clearance_m = referee.clearance_m(sample.world_from_body.translation_m);
        let least_m = referee.least_clearance_m();
        let mut samples = lock(&vehicle.samples);
        if ends {
            samples.end(sample, clearance_m, least_m);
        } else {
            samples.add(sample, clearance_m, least_m);
        }
    }

    /// Passes a vehicle's motion to the referees of the other vehicles.
    fn share_neighbours(&mut self, index: usize) {
        if !self.neighbours {
            return;
        }
        let vehicle = &self.flights.vehicles[index];
        let (name, radius_m) = (vehicle.name.clone(), vehicle.arena.body_radius_m);
        let motion = self.referees[index].motion();
        let neighbour = motion.map(|motion| Neighbour { name, motion, radius_m });
        let others = self.referees.iter_mut().enumerate().filter(|(other, _)| *other != index);
        for (_, referee) in others {
            referee.handle_neighbour(index, neighbour.clone());
        }
    }

    /// Lets the referees check time limits, and logs their events.
    fn judge(&mut self, at: ServerTime) {
        for (vehicle, referee) in self.flights.vehicles.iter().zip(&mut self.referees) {
            referee.handle_timeout(at);
            while let Some(event) = referee.poll_event() {
                vehicle.log(Origin::Server, event);
            }
        }
    }

    /// Publishes the counters of the source, per vehicle and in total.
    fn count(&self, source: &dyn PoseSource, watches: &[VehicleWatch]) {
        let mut all = SourceCounters::default();
        let vehicles = self.localization.vehicles.iter().zip(watches).enumerate();
        for (index, (vehicle, watch)) in vehicles {
            let own = SourceCounters { rejected: watch.rejected, ..source.counters(index) };
            *lock(&vehicle.counters) = own;
            all = all.and(own);
        }
        *lock(&self.localization.counters) = all;
    }

    /// Publishes the localization quality of each vehicle; warns of sources without a margin.
    fn publish_quality(&self, watches: &mut [VehicleWatch]) {
        let vehicles = self.localization.vehicles.iter().zip(&self.referees);
        let flights = self.flights.vehicles.iter().zip(watches);
        for ((vehicle, referee), (flight, watch)) in vehicles.zip(flights) {
            let now = clock::now();
            let mut quality = referee.quality(now);
            for source in &mut quality.sources {
                let name = self.localization.source_names.get(usize::from(source.source));
                if let Some(name) = name {
                    source.name.clone_from(name);
                }
                if let Some(text) = watch.margins.judge(now, source, &flight.arena.pose_ages) {
                    warn!("{}: {text}", flight.name);
                    flight.note(&text);
                }
            }
            *lock(&vehicle.quality) = quality;
        }
    }
}

/// State of the pose thread for one vehicle.
#[derive(Debug, Default)]
struct VehicleWatch {
    flights: u64,
    /// Index of the first event that the referee has not processed.
    event: u64,
    rejected: u64,
    margins: MarginWatch,
    outliers: OutlierCount,
    warned: Option<(Instant, std::mem::Discriminant<Rejected>)>,
}

impl VehicleWatch {
    fn of(vehicle: &VehicleFlight) -> Self {
        let event = vehicle.events.next_index();
        Self { flights: vehicle.flights(), event, ..Self::default() }
    }

    /// Counts a rejected measurement, and warns of it at a limited rate.
    fn reject(&mut self, vehicle: &VehicleFlight, source: Option<&String>, reason: Rejected) {
        self.rejected += 1;
        if matches!(reason, Rejected::Outlier(_)) && !self.outliers.add(Instant::now()) {
            return;
        }
        // A rejection for another reason is reported sooner.
        let kind = std::mem::discriminant(&reason);
        let repeated =
            self.warned.is_some_and(|(at, last)| last == kind && at.elapsed() < WARN_EVERY);
        let too_soon = self.warned.is_some_and(|(at, _)| at.elapsed() < WARN_APART);
        if repeated || too_soon {
            return;
        }
        self.warned = Some((Instant::now(), kind));
        let text = source.map_or_else(|| reason.to_string(), |name| format!("{name}: {reason}"));
        warn!("{}: {text}", vehicle.name);
        vehicle.note(&text);
    }
}

/// Outliers within [`WARN_EVERY`] after the first one.
#[derive(Debug, Default)]
struct OutlierCount {
    since: Option<Instant>,
    count: u32,
}

impl OutlierCount {
    /// Counts an outlier at `now`; returns whether there are more than a touch-down or a bump causes.
    fn add(&mut self, now: Instant) -> bool {
        if self.since.is_none_or(|since| now.duration_since(since) > WARN_EVERY) {
            (self.since, self.count) = (Some(now), 0);
        }
        self.count += 1;
        self.count > USUAL_OUTLIERS
    }
}

/// Maximum number of poses that a hard motion turns into outliers; the next pose confirms the motion.
const USUAL_OUTLIERS: u32 = 2;
/// Maximum delay until a stop is noticed.
const PATIENCE: Duration = Duration::from_millis(100);
/// Minimum time between equal warnings: a bad source sends 200 packets a second.
const WARN_EVERY: Duration = Duration::from_secs(5);
/// Minimum time between two warnings: several bad sources alternate.
const WARN_APART: Duration = Duration::from_secs(1);
/// The period at which the localization's quality is published.
const QUALITY_EVERY: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warns_of_a_bad_source_but_not_of_a_touch_down() {
        let (mut outliers, start) = (OutlierCount::default(), Instant::now());
        let mut add = |after_s| outliers.add(start + Duration::from_secs_f64(after_s));
        assert_eq!([0.0, 0.01].map(&mut add), [false; 2]);
        // The next landing, and then one that lasts.
        assert_eq!([9.0, 9.01, 9.02, 9.5].map(&mut add), [false, false, true, true]);
    }
}
