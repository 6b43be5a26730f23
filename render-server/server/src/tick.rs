//! The two threads that drive everything: poses in, drawn ticks out.
//!
//! ```text
//! pose thread:   source -> Referee (gate, rules) -> Hub::pose, trail, events       200 Hz
//!                                                \-> newest pose (mailbox)
//! render thread: newest pose -> all cameras of the arena -> drawn ticks (mailbox)  as fast as
//!                the machine draws, at most --max-rate; rests while nobody wants images
//! ```
//! Budget of the pose thread: 20 us a pose, bounded by the referee's swept query. The render
//! thread is bounded by the renderer. Both are plain threads: tokio's timers are a millisecond
//! late, and drawing would block its workers.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tracing::{trace_span, warn};
use vizflyt_arena::Referee;
use vizflyt_arena::pose::Rejected;
use vizflyt_protocol::messages::PoseSample;
use vizflyt_splat::Camera;

use crate::clock;
use crate::drivers::{PoseSource, SourceCounters};
use crate::encode::{self, DrawnTick};
use crate::events::Origin;
use crate::hub::{Hub, lock};
use crate::mailbox::Mailbox;
use crate::render::Renderer;

/// Takes poses from `source` until the server stops.
pub fn poses(
    hub: &Arc<Hub>,
    source: &mut dyn PoseSource,
    mut referee: Referee,
    newest: &Mailbox<Option<PoseSample>>,
) {
    let mut flights = hub.flights();
    let (mut rejected, mut warned) = (0u64, None::<Instant>);
    while !hub.stop.is_set() {
        let due = referee.poll_timeout().map_or(PATIENCE, |due| {
            Duration::from_secs_f64(due.seconds_since(clock::now()).clamp(0.0, 1.0))
        });
        let measured = source.receive(due.min(PATIENCE));
        // While packets keep coming, time is theirs: after a pause they arrive in a burst, each
        // old by now but followed by a newer one, and that is not a lost pose.
        let mut judged_at = clock::now();
        // A new runtime on the ground is a new flight: course and timer start afresh.
        let now_flights = hub.flights();
        if now_flights != flights {
            flights = now_flights;
            referee.restart();
        }
        if let Some(measured) = measured {
            let _span = trace_span!("pose", stamp_ns = measured.stamp.as_ns()).entered();
            match referee.handle_measurement(measured.stamp, measured.world_from_body) {
                Ok(sample) => {
                    judged_at = sample.stamp;
                    hub.pose.send_replace(Some(sample));
                    newest.put(Some(sample));
                    lock(&hub.trail).add(&sample);
                }
                Err(reason) => {
                    rejected += 1;
                    // Two frames of one burst may bear the same stamp: no fault of anyone's.
                    let same = matches!(reason, Rejected::Stale);
                    if same {
                        judged_at = measured.stamp;
                    }
                    if !same && warned.is_none_or(|at| at.elapsed() > WARN_EVERY) {
                        warned = Some(Instant::now());
                        warn!("{reason}");
                        hub.note(&reason.to_string());
                    }
                }
            }
            hub.stats.pose.add(measured.arrival, clock::now());
        }
        referee.handle_timeout(judged_at);
        while let Some(event) = referee.poll_event() {
            hub.log(Origin::Server, event);
        }
        while let Some(warning) = source.next_warning() {
            warn!("{warning}");
            hub.note(&warning);
        }
        *lock(&hub.source) = SourceCounters { rejected, ..source.counters() };
    }
}

/// Draws the newest pose until the server stops.
///
/// # Errors
/// None; a camera that the renderer refuses is logged once and the tick left out.
pub fn draw(
    hub: &Arc<Hub>,
    renderer: &mut dyn Renderer,
    newest: &Mailbox<Option<PoseSample>>,
    drawn: &Mailbox<DrawnTick>,
    max_rate_hz: f64,
) {
    let least = Duration::from_secs_f64(1.0 / max_rate_hz);
    let mut cameras: Vec<Camera> = Vec::with_capacity(hub.arena.cameras.len());
    let (mut seq, mut due, mut refused) = (0u64, Instant::now(), false);
    while !hub.stop.is_set() {
        if !hub.outlet.wait_for_interest(PATIENCE) {
            continue;
        }
        if let Some(early) = due.checked_duration_since(Instant::now()) {
            std::thread::sleep(early);
        }
        let Some(Some(sample)) = newest.take(PATIENCE) else { continue };
        // From the tick before, so that the mean rate is kept; from now, after a rest.
        due = (due + least).max(Instant::now());
        seq += 1;
        let span = trace_span!("tick", seq, stamp_ns = sample.stamp.as_ns()).entered();
        cameras.clear();
        cameras.extend(hub.arena.cameras.iter().map(|camera| Camera {
            intrinsics: camera.intrinsics,
            world_from_cam: sample.world_from_body * camera.body_from_cam,
            near_m: NEAR_M,
            background: BACKGROUND,
        }));
        let mut tick = drawn.spare();
        tick.images.resize_with(cameras.len(), Default::default);
        tick.seq = seq;
        tick.pose = sample.stamp;
        tick.world_from_body = Some(sample.world_from_body);
        tick.render_start = clock::now();
        let result = trace_span!("render").in_scope(|| renderer.draw(&cameras, &mut tick.images));
        tick.render_end = clock::now();
        drop(span);
        match result {
            Ok(()) => {
                hub.stats.render.add(tick.render_start, tick.render_end);
                encode::count(hub, drawn.put(tick));
            }
            Err(error) => {
                if !std::mem::replace(&mut refused, true) {
                    warn!("tick {seq} is not drawn: {error}; more of these go unsaid");
                }
                drawn.recycle(tick);
            }
        }
    }
}

/// How long a stop may go unnoticed.
const PATIENCE: Duration = Duration::from_millis(100);
/// A source that sends nonsense does so 200 times a second.
const WARN_EVERY: Duration = Duration::from_secs(5);
/// Nearer splats would fill the image when the body brushes something; less than its radius. [m]
const NEAR_M: f32 = 0.05;
/// Where the twin ends: black, like the trainers' background.
const BACKGROUND: [f32; 3] = [0.0; 3];
