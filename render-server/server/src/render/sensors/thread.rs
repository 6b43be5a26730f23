//! Thread of the sensors: newest motions in, newest readings out, at each sensor's rate.
//!
//! A separate thread with at most one core: images have priority. Readings that it cannot make in time are
//! skipped.

use std::thread::sleep;
use std::time::Duration;

use tracing::{trace_span, warn};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::sensor::SensorScene;

use super::measure::{Around, VehicleSensors};
use crate::clock;
use crate::render::demand::Demand;
use crate::render::inputs::Inputs;
use crate::render::schedule::Exposure;
use crate::stop::Stop;

/// Maximum delay until a stop, or new demand, is noticed.
const PATIENCE: Duration = Duration::from_millis(100);

/// Measures until the server stops: the due sensors of all vehicles with demand for images.
pub fn run<D: Demand + Sync>(inputs: Inputs<'_, D>, scene: &SensorScene, stop: &Stop) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let pool = match pool {
        Ok(pool) => pool,
        Err(error) => return warn!("no sensor measures: {error}"),
    };
    let Inputs { rendering, demand, .. } = inputs;
    let now = clock::now();
    let sensors = rendering.sensors.iter().enumerate();
    let seed = |vehicle: usize| rendering.seed.wrapping_add((vehicle as u64) << 32);
    let mut vehicles: Vec<_> = sensors
        .map(|(vehicle, sensors)| VehicleSensors::new(sensors.newest(), now, seed(vehicle)))
        .collect();
    while !stop.is_set() {
        let wanted = demand.wait_for_interest(PATIENCE);
        let mut next: Option<ServerTime> = None;
        for (vehicle, sensors) in vehicles.iter_mut().enumerate() {
            if !wanted[vehicle] {
                continue;
            }
            sensors.follow(rendering.sensors[vehicle].newest(), clock::now());
            pool.install(|| measure(inputs, scene, vehicle, sensors));
            next = next.into_iter().chain(sensors.next()).min();
        }
        if wanted.contains(&true) {
            let wait_ns = next.map_or(u64::MAX, |next| {
                next.as_ns().saturating_sub(clock::now().as_ns()).max(SHORTEST_NS)
            });
            sleep(Duration::from_nanos(wait_ns).min(PATIENCE));
        }
    }
}

/// Measures with the due sensors of one vehicle.
fn measure<D: Demand + Sync>(
    Inputs { rendering, localization, demand, .. }: Inputs<'_, D>,
    scene: &SensorScene,
    vehicle: usize,
    sensors: &mut VehicleSensors,
) {
    let poses = localization.newest();
    let Some(newest) = &poses[vehicle] else { return };
    let now = clock::now();
    let taken = sensors.take(now);
    let after_ns = demand.seen_after_s(vehicle).map(|s| (s * 1e9) as i64);
    for (index, _) in taken.iter().enumerate().filter(|(_, taken)| **taken) {
        let span = trace_span!("measure", vehicle, sensor = index).entered();
        let exposure = Exposure::new(rendering.predict, after_ns, newest, clock::now());
        let objects = &rendering.dynamic_objects;
        let mut place =
            |at, placements: &mut Vec<_>| objects.place(at, vehicle, &poses, placements);
        let pose = newest.sample.stamp;
        let mut around = Around { scene, motion: &newest.motion, pose, place: &mut place };
        let reading = sensors.measure(index, &exposure, &mut around);
        drop(span);
        if let Some(reading) = reading {
            rendering.sensors[vehicle].publish(reading);
        }
    }
}

/// Minimum sleep: without a pose, a sensor stays due. [ns]
const SHORTEST_NS: u64 = 1_000_000;
