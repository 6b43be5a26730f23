//! Checks of a lab day, and evaluation of their measurements. Pure.

use serde::{Deserialize, Serialize};
use vizflyt_arena::pose::PoseQuality;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::{ArenaInfo, ClockState, Guarded, VehicleState};

use super::pose_window::PoseWindow;

/// Id of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)] // Why: `CHECKS` describes each.
pub enum CheckId {
    Net,
    People,
    Localization,
    Axes,
    Network,
    Clocks,
    Latency,
    Parameters,
    Battery,
    Pack,
    Fence,
    Stop,
}

/// Source of a check's evidence.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum How {
    /// A person inspects and signs.
    Signed,
    /// The server measures it automatically, once a second.
    Live,
    /// `vizflyt doctor` sends it.
    Brought,
    /// A person moves the vehicle, and the server evaluates the poses.
    Guided,
    /// A person presses the stop button, and the server measures the reaction.
    Pressed,
}

/// Description of a check.
#[derive(Clone, Copy, Debug)]
pub struct CheckInfo {
    pub id: CheckId,
    /// Short name.
    pub title: &'static str,
    /// Source of its evidence.
    pub how: How,
    /// Whether the check is for the room instead of each vehicle.
    pub of_room: bool,
    /// Instruction for the user.
    pub ask: &'static str,
}

/// All checks, in the usual order before flights.
pub const CHECKS: [CheckInfo; 12] = [
    info(
        CheckId::Net,
        "net closed",
        How::Signed,
        true,
        "walk around it: closed, anchored, no hole; sign",
    ),
    info(
        CheckId::People,
        "people outside",
        How::Signed,
        true,
        "nobody in the net, the pilot has the transmitter; sign",
    ),
    info(
        CheckId::Localization,
        "localization live",
        How::Live,
        false,
        "stand the vehicle in the net, still",
    ),
    info(
        CheckId::Axes,
        "axes of localization",
        How::Guided,
        false,
        "begin, then do what is asked with the vehicle in your hands",
    ),
    info(
        CheckId::Network,
        "network",
        How::Live,
        false,
        "start the vehicle's runtime: vizflyt fly PLUGIN --wait",
    ),
    info(
        CheckId::Clocks,
        "clocks",
        How::Live,
        false,
        "start the vehicle's runtime: vizflyt fly PLUGIN --wait",
    ),
    info(
        CheckId::Latency,
        "camera latency",
        How::Live,
        false,
        "start the vehicle's runtime: vizflyt fly PLUGIN --wait",
    ),
    info(
        CheckId::Parameters,
        "autopilot's parameters",
        How::Brought,
        false,
        "on the vehicle's computer, before its runtime: vizflyt doctor vehicle --arena arena.toml --report PAGE",
    ),
    info(CheckId::Battery, "battery", How::Live, false, "power the vehicle and start its runtime"),
    info(
        CheckId::Pack,
        "LiPo and frame",
        How::Signed,
        false,
        "pack not swollen and tight, propellers and screws whole; sign",
    ),
    info(
        CheckId::Fence,
        "fence in three places",
        How::Live,
        false,
        "start the vehicle's runtime, after vizflyt doctor vehicle --report",
    ),
    info(
        CheckId::Stop,
        "STOP tried",
        How::Pressed,
        false,
        "with the vehicle on the ground and its runtime waiting, press STOP",
    ),
];

const fn info(
    id: CheckId,
    title: &'static str,
    how: How,
    of_room: bool,
    ask: &'static str,
) -> CheckInfo {
    CheckInfo { id, title, how, of_room, ask }
}

impl CheckId {
    /// Returns the description of the check.
    pub fn info(self) -> &'static CheckInfo {
        // `CHECKS` has the order of the variants; a test checks this.
        &CHECKS[self as usize]
    }

    /// Returns the validity of its evidence. [s]
    pub fn valid_s(self) -> f64 {
        match self.info().how {
            How::Live => LIVE_S,
            How::Signed | How::Brought | How::Guided | How::Pressed => DAY_S,
        }
    }
}

/// Result of a check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Finding {
    /// Whether the check passed.
    pub ok: bool,
    /// Measured values with units.
    pub evidence: String,
    /// Instruction if it failed; else empty.
    pub todo: String,
}

impl Finding {
    /// Returns a finding that passes if `todo` is empty.
    pub fn of(evidence: String, todo: &[String]) -> Self {
        Self { ok: todo.is_empty(), evidence, todo: todo.join("; ") }
    }
}

/// Evaluates the poses of the last seconds; `None` before the first. `quality` is the filter's; `now_s` is on
/// the clock of the window.
pub fn localization(
    now_s: f64,
    window: &PoseWindow,
    quality: &PoseQuality,
    arena: &ArenaInfo,
) -> Option<Finding> {
    let seen = window.summary(now_s)?;
    let PoseQuality { rate_hz, position_sigma_mm: sigma_mm, .. } = *quality;
    let hold_s = arena.pose_ages.hold_after_s + f64::from(seen.allowance_s);
    if seen.age_s > hold_s.max(SILENT_S) {
        return Some(Finding {
            ok: false,
            evidence: format!("no pose for {:.1} s", seen.age_s),
            todo:
                "is the localization on, and the vehicle in sight? then docs/guides/localization.md"
                    .to_owned(),
        });
    }
    let mut todo = Vec::new();
    if seen.gap_s > hold_s {
        todo.push(format!(
            "a gap of {:.0} ms holds the vehicle (hold_after_s): look for lost markers or packets",
            seen.gap_s * 1e3
        ));
    }
    if 3.0 * sigma_mm > KEPT_FREE_MM {
        todo.push(format!("three sigmas do not fit into the {KEPT_FREE_MM:.0} mm that the guard keeps free: calibrate \
             the localization"));
    }
    let jitter = match seen.jitter_mm {
        Some(jitter_mm) => {
            if jitter_mm > MAX_JITTER_MM {
                todo.push(format!("at rest it trembles by more than {MAX_JITTER_MM:.0} mm: look for reflections and \
                     loose markers"));
            }
            format!("{jitter_mm:.1} mm rms at rest")
        }
        None => "moving, so no jitter at rest".to_owned(),
    };
    let evidence = format!(
        "{rate_hz:.0} Hz, longest gap {:.0} ms, sigma {sigma_mm:.1} mm, {jitter}",
        seen.gap_s * 1e3
    );
    Some(Finding::of(evidence, &todo))
}

/// State of a connection at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Traffic {
    /// Time. [s]
    pub at_s: f64,
    /// Smoothed round-trip time. [ms]
    pub rtt_ms: f64,
    /// Packets sent so far.
    pub sent: u64,
    /// Packets lost so far.
    pub lost: u64,
    /// Bytes sent so far. [bytes]
    pub bytes: u64,
}

/// Evaluates the network between two times; `None` if too few packets were sent.
pub fn network(before: &Traffic, now: &Traffic) -> Option<Finding> {
    let seconds = now.at_s - before.at_s;
    let sent = now.sent.checked_sub(before.sent)?;
    if seconds <= 0.0 || sent < MIN_PACKETS {
        return None;
    }
    // The lost packets may have been sent before the interval.
    let lost = now.lost.saturating_sub(before.lost).min(sent);
    let lost_percent = 100.0 * lost as f64 / sent as f64;
    let mbit_s = now.bytes.saturating_sub(before.bytes) as f64 * 8e-6 / seconds;
    let mut todo = Vec::new();
    if now.rtt_ms > MAX_RTT_MS {
        todo.push(format!("a round trip takes more than {MAX_RTT_MS:.0} ms: by cable, or 5 GHz with no other sender on \
             the channel (docs/guides/network.md)"));
    }
    if lost_percent > MAX_LOST_PERCENT {
        todo.push(format!(
            "more than {MAX_LOST_PERCENT:.0} % of the packets are lost: look at cable, switch and \
             channel (docs/guides/network.md)"
        ));
    }
    let evidence = format!(
        "round trip {:.1} ms, {lost_percent:.2} % of {sent} packets lost, {mbit_s:.1} Mbit/s in {seconds:.0} s",
        now.rtt_ms
    );
    Some(Finding::of(evidence, &todo))
}

/// Evaluates the synchronization of the two clocks.
pub fn clocks(clock: &ClockState) -> Finding {
    let mut todo = Vec::new();
    if !(clock.error_bound_ms <= MAX_CLOCK_MS) {
        todo.push(format!(
            "ages of images may be off by more than {MAX_CLOCK_MS:.0} ms: a slow or uneven network \
             (docs/guides/network.md)"
        ));
    }
    let evidence = format!(
        "offset {:.3} s, uncertain by {:.2} ms, drift {:.1} ppm, set {} times",
        clock.offset_ns as f64 * 1e-9,
        clock.error_bound_ms,
        clock.drift_ppm,
        clock.steps
    );
    Finding::of(evidence, &todo)
}

/// Evaluates the age of images, from the pose to the plugin, of `images` images in `seconds`; `None` without
/// images.
pub fn latency(p50_ms: f32, p99_ms: f32, images: u64, seconds: f32) -> Option<Finding> {
    if images == 0 {
        return None;
    }
    let mut todo = Vec::new();
    if !(f64::from(p99_ms) <= MAX_AGE_MS) {
        todo.push(format!(
            "images older than {MAX_AGE_MS:.0} ms slow the vehicle down: vizflyt stats says which \
             stage takes the time (docs/guides/timing.md)"
        ));
    }
    let evidence = format!(
        "images are {p50_ms:.0} ms old (median), {p99_ms:.0} ms (99 %), {images} in {seconds:.0} s"
    );
    Some(Finding::of(evidence, &todo))
}

/// Evaluates the battery's state reported by the autopilot.
pub fn battery(state: &VehicleState) -> Finding {
    let (volts, fraction) = (f64::from(state.battery_v), f64::from(state.battery_fraction));
    match (volts > 0.0, fraction >= 0.0) {
        (false, false) => Finding {
            ok: false,
            evidence: "the autopilot reports no battery".to_owned(),
            todo: "set BATT_MONITOR (vizflyt doctor vehicle), then power it by its pack".to_owned(),
        },
        (_, true) => {
            let low = fraction < LEAST_CHARGE;
            let todo =
                low.then(|| format!("less than {:.0} %: take a full pack", LEAST_CHARGE * 100.0));
            let volts = if volts > 0.0 { format!("{volts:.2} V, ") } else { String::new() };
            Finding::of(format!("{volts}{:.0} % left", fraction * 100.0), todo.as_slice())
        }
        (true, false) => Finding::of(format!("{volts:.2} V, charge not reported"), &[]),
    }
}

/// Parameter of the autopilot's fence, as read by `vizflyt doctor vehicle`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FenceParameter {
    /// Name in ArduCopter.
    pub name: String,
    /// Value in the autopilot; absent if it has none.
    pub has: Option<f64>,
    /// Value required by the arena.
    pub right: f64,
}

/// Checks that arena, guard and autopilot have the same fence. `parameters` are the autopilot's; `None` if they
/// were not sent.
pub fn fence(arena: &ArenaInfo, guard: &Guarded, parameters: Option<&[FenceParameter]>) -> Finding {
    let mut todo = Vec::new();
    let no_fly = arena.no_fly.len();
    if guard.geofence != arena.geofence
        || usize::from(guard.no_fly) != no_fly
        || guard.floor_z_m != arena.floor_z_m
    {
        todo.push(
            "the guard keeps another fence than this arena's: start the runtime again".to_owned(),
        );
    }
    if guard.limits.stricter(&arena.limits) != guard.limits {
        todo.push(
            "the guard allows more than the arena's limits: start the runtime again".to_owned(),
        );
    }
    let mut autopilot = match guard.polygons {
        Some(count) => format!("{count} polygons accepted"),
        None if matches!(arena.geofence, Volume::Cuboid { .. }) => {
            todo.push(
                "the autopilot has not accepted the net as polygons: see the page's events"
                    .to_owned(),
            );
            "no polygons".to_owned()
        }
        None => "no polygons, because the fence is not a box".to_owned(),
    };
    match parameters {
        None => {
            todo.push("FENCE_* of the autopilot are not known: vizflyt doctor vehicle --arena arena.toml --report PAGE"
                    .to_owned(),
            );
        }
        Some(parameters) => {
            let mut wrong = Vec::new();
            for FenceParameter { name, has, right } in parameters {
                let value = has.map_or("absent".to_owned(), |has| format!("{has:.2}"));
                autopilot = format!("{autopilot}, {name} {value}");
                if !has.is_some_and(|has| (has - right).abs() <= 1e-3 * right.abs().max(1.0)) {
                    wrong.push(format!("{name} must be {right:.2}"));
                }
            }
            if !wrong.is_empty() {
                let wrong = wrong.join(", ");
                todo.push(format!("{wrong}: vizflyt doctor vehicle --arena arena.toml --apply"));
            }
        }
    }
    let evidence = format!(
        "arena: {}, {no_fly} no-fly boxes; guard: {}, {} no-fly boxes, {:.1} m/s; autopilot: {autopilot}",
        extent(&arena.geofence),
        extent(&guard.geofence),
        guard.no_fly,
        guard.limits.max_speed_mps
    );
    Finding::of(evidence, &todo)
}

fn extent(volume: &Volume) -> String {
    match *volume {
        Volume::Cuboid { half_m, .. } => {
            let size_m = half_m * 2.0;
            format!("{:.2} x {:.2} x {:.2} m", size_m.x, size_m.y, size_m.z)
        }
        Volume::Sphere { radius_m, .. } => format!("a sphere of {radius_m:.2} m"),
        Volume::Capsule { radius_m, .. } => format!("a capsule of {radius_m:.2} m"),
        Volume::HalfSpace { .. } => "a half space".to_owned(),
    }
}

/// Validity of live evidence after its last measurement. [s]
const LIVE_S: f64 = 60.0;
/// Validity of evidence from people: a day in the lab. [s]
const DAY_S: f64 = 12.0 * 3600.0;
/// Time without a pose after which only the silence is reported. [s]
const SILENT_S: f64 = 1.0;
/// Distance that the guard keeps to the fence (docs/guides/safety.md). [mm]
const KEPT_FREE_MM: f64 = 200.0;
/// Maximum jitter at rest: motion capture has a tenth of it, tags a half. [mm]
const MAX_JITTER_MM: f64 = 10.0;
/// Maximum round trip: a tenth of the image age at which flight slows down, in both directions. [ms]
const MAX_RTT_MS: f64 = 20.0;
/// Maximum packet loss; lost data are sent again a round trip later. [%]
const MAX_LOST_PERCENT: f64 = 1.0;
/// Minimum packets for a measurement of a loss of 1 %.
const MIN_PACKETS: u64 = 100;
/// Maximum error of image ages. [ms]
const MAX_CLOCK_MS: f32 = 5.0;
/// Maximum image age: above it the guard slows the vehicle down (docs/guides/safety.md). [ms]
const MAX_AGE_MS: f64 = 150.0;
/// Minimum charge: about what a flight of five minutes uses.
const LEAST_CHARGE: f64 = 0.5;
