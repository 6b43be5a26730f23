//! Crash cards: the last moments of a failed live flight, stored for the page.
//!
//! ```text
//! previews --> RecentPreviews: two seconds of them, by camera ----\
//! pose thread --> samples of the flight, with clearance ---> follow (a task for each vehicle) --> card
//! referee, runtime --> the event that decided the flight /
//! ```
//! There is at most one card per vehicle, of its last failed flight, and two seconds of previews (2 MB per
//! camera). Cause and plots are the autograder's ([`vizflyt_arena::crash`]).

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use tracing::warn;
use vizflyt_arena::crash::{ClearanceAhead, Flight, plot, probable_cause, since};
use vizflyt_arena::verdict::Sample;
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_protocol::messages::{Event, EventKind};
use vizflyt_protocol::time::ServerTime;

use super::crash_card::{CardEvent, CardImages, CardSample, CrashCard};
use super::vehicle::VehicleFlight;
use vizflyt_process::lock;

/// Makes the cards of a vehicle's failed flights until the task is dropped.
pub(crate) async fn follow(
    vehicle: Arc<VehicleFlight>,
    arena: ArenaConfig,
    field: Arc<DistanceField>,
) {
    let (arena, mut count) = (Arc::new(arena), 0);
    let mut log = vehicle.events.subscribe();
    let mut telemetry = vehicle.telemetry.subscribe();
    // Flight and end that were processed last. An earlier end that arrives later gets a separate card.
    let mut known: Option<(u64, ServerTime)> = None;
    loop {
        tokio::select! {
            _ = log.changed() => log.mark_unchanged(),
            _ = telemetry.changed() => telemetry.mark_unchanged(),
        }
        let flight = vehicle.flight();
        let Some((at, _)) = flight
            .end
            .decided()
            .filter(|(_, reason)| flight.took_off.is_some() && reason.is_failure())
        else {
            // An earlier event that arrived later was not a failure.
            if known.take_if(|(flight, _)| *flight == vehicle.flights()).is_some() {
                vehicle.crash.send_replace(None);
            }
            continue;
        };
        let end = (vehicle.flights(), at);
        if known == Some(end) {
            continue;
        }
        known = Some(end);
        tokio::time::sleep(IMAGES_LATE).await;
        if vehicle.flights() != end.0 {
            // The next flight has begun, and the data of this one are gone.
            continue;
        }
        count += 1;
        let made = {
            let (vehicle, arena, field) = (vehicle.clone(), arena.clone(), field.clone());
            move || card(count, &vehicle, &arena, &field, at)
        };
        if let Ok(card) = tokio::task::spawn_blocking(made).await {
            vehicle.crash.send_replace(Some(Arc::new(card)));
        } else {
            warn!("a crash card could not be made");
        }
    }
}

fn card(
    id: u64,
    vehicle: &VehicleFlight,
    arena: &ArenaConfig,
    field: &DistanceField,
    at: ServerTime,
) -> CrashCard {
    let shots = lock(&vehicle.previews).until(at);
    let samples = lock(&vehicle.samples).kept().to_vec();
    let events = vehicle.events_of_flight();
    let verdict = vehicle.verdict(arena);
    let front = shots.first().map_or(&[][..], Vec::as_slice);
    let seen: Vec<ClearanceAhead> = front
        .iter()
        .map(|shot| ClearanceAhead { stamp: shot.shown, ahead_m: shot.preview.ahead_m })
        .collect();
    let reported: Vec<&Event> = events.iter().filter(|event| event.stamp <= at).collect();
    let (printed, reported): (Vec<&Event>, Vec<&Event>) =
        reported.into_iter().partition(|event| event.kind == EventKind::PluginOutput);
    let delay_s = vehicle.telemetry.borrow().as_ref().map(|report| report.images);
    let delay_s = delay_s.filter(|images| images.delivered > 0);
    let flight = Flight {
        verdict: &verdict,
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
        events: reported[newest(&reported, EVENTS)..]
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
        title: verdict.end.title(),
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

/// Delay until the last image before the end has been rendered and shrunk.
const IMAGES_LATE: Duration = Duration::from_millis(300);
/// Length of the plot of clearance and speed. [s]
const PLOTTED_S: f64 = 4.0;
/// Default of the images' age at the reply, if the runtime has not reported it. [s]
const USUAL_DELAY_S: f64 = 0.04;
/// Maximum number of events shown.
const EVENTS: usize = 12;
/// Maximum number of the plugin's lines shown.
const LINES: usize = 30;
