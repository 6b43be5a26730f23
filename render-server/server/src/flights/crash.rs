//! Crash cards: what a live flight that failed looked like at its end, kept for the page.
//!
//! ```text
//! previews --> RecentPreviews: two seconds of them, by camera ----\
//! pose thread --> samples of the flight, with clearance ---> follow (a task for each vehicle) --> card
//! referee, runtime --> the event that decided the flight /
//! ```
//! At most one card a vehicle, that of its last failed flight, and two seconds of previews (2 MB a
//! camera). Cause and drawings are the autograder's ([`vizflyt_arena::crash`]).

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::Serialize;
use tracing::warn;
use vizflyt_arena::crash::{Flight, Seen, plot, probable_cause, since};
use vizflyt_arena::verdict::{Sample, Verdict};
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_protocol::messages::{Event, EventKind};
use vizflyt_protocol::time::ServerTime;

use crate::flights::vehicle::Vehicle;
use crate::lock::lock;
use crate::web::previews::Preview;

/// The newest previews of a vehicle, by camera.
#[derive(Debug, Default)]
pub struct RecentPreviews(Vec<VecDeque<Shot>>);

/// A preview, and the instant that it shows.
#[derive(Clone, Debug)]
pub struct Shot {
    shown: ServerTime,
    preview: Arc<Preview>,
}

impl RecentPreviews {
    /// Makes room for all that this many cameras will ever keep.
    pub fn of(cameras: usize) -> Self {
        Self((0..cameras).map(|_| VecDeque::with_capacity(MOST_SHOTS)).collect())
    }

    /// Adds a camera's preview, in place of the oldest where there is no room.
    pub fn add(&mut self, camera: usize, shown: ServerTime, preview: Arc<Preview>) {
        let Some(kept) = self.0.get_mut(camera) else { return };
        if kept.len() == MOST_SHOTS {
            kept.pop_front();
        }
        kept.push_back(Shot { shown, preview });
    }

    /// Returns what each camera showed in the last [`SHOWN_S`] until `at`, oldest first.
    fn until(&self, at: ServerTime) -> Vec<Vec<Shot>> {
        let is_shown = |shot: &&Shot| (0.0..=SHOWN_S).contains(&at.seconds_since(shot.shown));
        self.0.iter().map(|kept| kept.iter().filter(is_shown).cloned().collect()).collect()
    }
}

/// What a failed flight looked like at its end.
#[derive(Debug, Serialize)]
pub struct CrashCard {
    /// Counts the vehicle's cards, from 1.
    pub id: u64,
    /// Whose.
    vehicle: String,
    /// The arena's name.
    course: String,
    /// The end, UTC. [ms since 1970]
    ended_unix_ms: u64,
    /// What decided the flight.
    event: Event,
    /// What the flight was worth.
    verdict: Verdict,
    /// What it probably failed of, in words.
    cause: String,
    /// What the cameras showed, oldest first.
    images: Vec<CardImages>,
    /// Where it was in its last seconds.
    samples: Vec<CardSample>,
    /// SVG of clearance and speed in its last seconds.
    clearance_svg: String,
    /// SVG of the place from above, with the way flown.
    top_svg: String,
    /// At which height the obstacles of that are. [m, world]
    top_height_m: f64,
    /// What happened, up to the end.
    events: Vec<CardEvent>,
    /// The last lines that the plugin printed.
    printed: Vec<String>,
    #[serde(skip)]
    shots: Vec<Vec<Shot>>,
}

/// The images of a camera.
#[derive(Debug, Serialize)]
struct CardImages {
    camera: String,
    /// When they were, before the end. [s]
    before_s: Vec<f64>,
}

/// Where it was at one moment.
#[derive(Debug, Serialize)]
struct CardSample {
    /// Before the end. [s]
    before_s: f64,
    /// [m, world]
    p_world_m: [f64; 3],
    /// [m/s, world]
    v_world_mps: [f64; 3],
    /// From x, counter-clockwise. [rad, world]
    yaw_rad: f64,
    /// From the body's surface to the nearest obstacle; absent where there is none. [m]
    clearance_m: Option<f64>,
}

#[derive(Debug, Serialize)]
struct CardEvent {
    /// Before the end. [s]
    before_s: f64,
    text: String,
}

impl CrashCard {
    /// Returns an image of a camera, both by their number; `None` if there is none.
    pub fn image(&self, camera: usize, number: usize) -> Option<&Arc<Preview>> {
        Some(&self.shots.get(camera)?.get(number)?.preview)
    }
}

/// Makes the cards of a vehicle's failed flights until the task is dropped.
pub(crate) async fn follow(vehicle: Arc<Vehicle>, arena: ArenaConfig, field: Arc<DistanceField>) {
    let (arena, mut count) = (Arc::new(arena), 0);
    let mut log = vehicle.events.subscribe();
    let mut telemetry = vehicle.telemetry.subscribe();
    // The end that was dealt with last, and its card while it may still be taken back.
    let (mut known, mut waiting) = (None, None);
    loop {
        tokio::select! {
            _ = log.changed() => log.mark_unchanged(),
            _ = telemetry.changed() => telemetry.mark_unchanged(),
        }
        let flight = vehicle.flight();
        let Some(event) =
            flight.outcome.filter(|event| flight.took_off.is_some() && is_failure(event))
        else {
            waiting = None;
            continue;
        };
        let end = (vehicle.flights(), event.stamp);
        if known != Some(end) {
            known = Some(end);
            tokio::time::sleep(IMAGES_LATE).await;
            if vehicle.flights() != end.0 {
                // The next flight has begun: nothing of this one is left.
                continue;
            }
            count += 1;
            let (vehicle, arena, field) = (vehicle.clone(), arena.clone(), field.clone());
            let event = event.clone();
            let made = move || card(count, &vehicle, &arena, &field, event);
            waiting = tokio::task::spawn_blocking(made).await.ok();
            if waiting.is_none() {
                warn!("a crash card could not be made");
            }
        }
        // A pose that comes back before the landing decides nothing.
        let is_settled =
            !matches!(event.kind, EventKind::PoseLost { .. }) || vehicle.flight().landed.is_some();
        if is_settled && let Some(card) = waiting.take() {
            vehicle.crash.send_replace(Some(Arc::new(card)));
        }
    }
}

/// Whether a flight that this decided wants a card.
fn is_failure(event: &Event) -> bool {
    use EventKind::{Collision, EmergencyStop, Geofence, PluginFailed, PoseLost, TimeLimit};
    matches!(
        event.kind,
        Collision { .. }
            | Geofence { .. }
            | PoseLost { .. }
            | EmergencyStop
            | PluginFailed
            | TimeLimit
    )
}

fn card(
    id: u64,
    vehicle: &Vehicle,
    arena: &ArenaConfig,
    field: &DistanceField,
    event: Event,
) -> CrashCard {
    let at = event.stamp;
    let shots = lock(&vehicle.shots).until(at);
    let samples = lock(&vehicle.samples).kept().to_vec();
    let events = vehicle.events_of_flight();
    let verdict = vehicle.verdict(arena);
    let front = shots.first().map_or(&[][..], Vec::as_slice);
    let seen: Vec<Seen> = front
        .iter()
        .map(|shot| Seen { stamp: shot.shown, ahead_m: shot.preview.ahead_m })
        .collect();
    let told: Vec<&Event> = events.iter().filter(|event| event.stamp <= at).collect();
    let (printed, told): (Vec<&Event>, Vec<&Event>) =
        told.into_iter().partition(|event| event.kind == EventKind::PluginOutput);
    let delay_s = vehicle.telemetry.borrow().as_ref().map(|report| report.images);
    let delay_s = delay_s.filter(|images| images.delivered > 0);
    let flight = Flight {
        verdict: &verdict,
        events: &events,
        samples: &samples,
        asked: None,
        seen: &seen,
        last_line: printed.last().map(|event| event.text.as_str()),
        delay_s: delay_s.map_or(USUAL_DELAY_S, |images| f64::from(images.age_ms_p50) * 1e-3),
    };
    let cause = probable_cause(arena, field, &flight);
    let last = since(&samples, at, PLOTTED_S);
    let top_height_m = last.last().map_or(arena.takeoff_height_m, |sample| sample.p_world_m.z);
    let before_s = |stamp: ServerTime| (at.seconds_since(stamp) * 1e3).round() / 1e3;
    let newest = |all: &[&Event], most: usize| all.len().saturating_sub(most);
    let cameras = vehicle.arena.cameras.iter().zip(&shots);
    CrashCard {
        id,
        vehicle: vehicle.name.to_string(),
        course: arena.name.clone(),
        ended_unix_ms: SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .map_or(0, |since| since.as_millis() as u64),
        cause: cause.unwrap_or_else(|| verdict.reason.clone()),
        images: cameras
            .map(|(camera, shots)| CardImages {
                camera: camera.name.to_string(),
                before_s: shots.iter().map(|shot| before_s(shot.shown)).collect(),
            })
            .collect(),
        samples: last.iter().map(|sample| line(sample, before_s(sample.stamp))).collect(),
        clearance_svg: plot::clearance(last, at),
        top_svg: plot::top_view(
            arena,
            &field.obstacle_slice(top_height_m),
            last,
            since(&samples, at, f64::INFINITY),
        ),
        top_height_m,
        events: told[newest(&told, EVENTS)..]
            .iter()
            .map(|event| CardEvent {
                before_s: before_s(event.stamp),
                text: event.text.as_str().to_owned(),
            })
            .collect(),
        printed: printed[newest(&printed, LINES)..]
            .iter()
            .map(|event| event.text.as_str().to_owned())
            .collect(),
        event,
        verdict,
        shots,
    }
}

fn line(sample: &Sample, before_s: f64) -> CardSample {
    CardSample {
        before_s,
        p_world_m: sample.p_world_m.to_array(),
        v_world_mps: sample.v_world_mps.to_array(),
        yaw_rad: sample.yaw_rad,
        clearance_m: sample.clearance_m.is_finite().then_some(sample.clearance_m),
    }
}

/// Images are shown over so long. [s]
const SHOWN_S: f64 = 2.0;
/// Previews kept of a camera: [`SHOWN_S`] and [`IMAGES_LATE`] at
/// [`PREVIEW_HZ`](crate::web::previews::PREVIEW_HZ).
const MOST_SHOTS: usize = 36;
/// The last image before the end is drawn, taken and shrunk by then.
const IMAGES_LATE: Duration = Duration::from_millis(300);
/// Clearance and speed are plotted over so long. [s]
const PLOTTED_S: f64 = 4.0;
/// Age of an image when its answer counts, where the runtime has not said it. [s]
const USUAL_DELAY_S: f64 = 0.04;
/// Events that are shown.
const EVENTS: usize = 12;
/// Lines of the plugin that are shown.
const LINES: usize = 30;

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(s: f64) -> ServerTime {
        ServerTime::ZERO.plus_seconds(s)
    }

    #[test]
    fn two_seconds_of_previews_are_kept_and_no_more_memory_is_taken() {
        let mut shots = RecentPreviews::of(2);
        let room = shots.0[1].capacity();
        for k in 0..200_u32 {
            let preview = Arc::new(Preview { colour: vec![k as u8], ..Preview::default() });
            shots.add(1, shown(f64::from(k) / 15.0), preview.clone());
            // A camera that is not there is nobody's.
            shots.add(7, shown(f64::from(k) / 15.0), preview);
        }
        assert_eq!((shots.0[1].len(), shots.0[1].capacity()), (MOST_SHOTS, room));
        // The end was 0.3 s ago: what came after it is not shown, what came in time is.
        let end = shown(199.0 / 15.0 - IMAGES_LATE.as_secs_f64());
        let found = shots.until(end);
        let times: Vec<f64> = found[1].iter().map(|shot| end.seconds_since(shot.shown)).collect();
        assert!(found[0].is_empty() && (29..=31).contains(&times.len()), "{times:?}");
        assert!(times[0] > 1.9 && times.iter().all(|s| (0.0..=SHOWN_S).contains(s)), "{times:?}");
    }
}
