//! Card of a flight: for a failed flight its last seconds, for a finished one the whole flight.

use std::fmt::Write;

use anyhow::{Context, Result};
use vizflyt_arena::crash::{plot, since};
use vizflyt_arena::verdict::Sample;
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_protocol::messages::{EventKind, OutcomeKind};
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::encode_jpeg;

use super::super::document::{Run, SignedFile};
use super::super::folder::{IMAGES, LOGS, ReportFolder};
use super::super::trial::{TrialImage, TrialResult};
use super::escape;

/// JPEG quality of the images. [0 to 100]
const QUALITY: u8 = 85;
/// Length of the plots of clearance and speed for a failed flight. [s]
const PLOTTED_S: f64 = 4.0;
/// Maximum number of listed events of a failed, and of a finished flight.
const EVENTS: usize = 12;
const EVENTS_OF_FINISHED: usize = 60;

/// Returns the base name of a flight's files.
pub(crate) fn name(run: &Run) -> String {
    format!("{}-{}", run.variant, run.seed)
}

/// Writes the images of a flight into the report's folder; returns its card as HTML, and the image
/// files. `log`: whether the report has the flight's log.
pub(crate) fn write(
    folder: &ReportFolder,
    arena: &ArenaConfig,
    field: &DistanceField,
    run: &Run,
    flown: &TrialResult,
    log: bool,
) -> Result<(String, Vec<SignedFile>)> {
    let mut card = head(run);
    let mut files = Vec::new();
    let at = flown.verdict.ended;
    let is_finished = run.outcome == OutcomeKind::Finished;
    if let Some(at) = at {
        let way = since(&flown.samples, at, f64::INFINITY);
        let (strip, images) = if is_finished {
            let shots = whole(flown);
            strip(folder, run, &shots, "the flight", |stamp| after_take_off(run, at, stamp))?
        } else {
            let shots: Vec<&TrialImage> = flown.shots.iter().collect();
            let ago = |stamp| format!("{:+.1} s", -at.seconds_since(stamp));
            strip(folder, run, &shots, "last images", ago)?
        };
        card += &strip;
        files = images;
        let shown = if is_finished {
            since(&flown.samples, at, run.seconds)
        } else {
            since(&flown.samples, at, PLOTTED_S)
        };
        let height_m = if is_finished { middle_height_m(shown) } else { shown.last().map(height) };
        let height_m = height_m.unwrap_or(arena.takeoff_height_m);
        let (when, end) = if is_finished {
            ("from take-off to the finish", "position at the finish")
        } else {
            ("in the last seconds", "last position")
        };
        let _ = write!(
            card,
            "<div class=\"plots\"><figure>{}<figcaption>Clearance of the body (blue) and speed (orange) \
             {when}</figcaption></figure><figure>{}<figcaption>Top view: obstacles at a \
             height of {height_m:.2} m, flown path, and {end}, with heading</figcaption>\
             </figure></div>",
            plot::clearance(shown, at),
            plot::top_view(arena, &field.obstacle_slice(height_m), shown, way)
        );
    }
    let events = flown.events.iter().filter(|event| event.kind != EventKind::PluginOutput);
    let events: Vec<_> = events.filter(|event| at.is_none_or(|at| event.stamp <= at)).collect();
    let most = if is_finished { EVENTS_OF_FINISHED } else { EVENTS };
    let mut story = String::new();
    for event in events.iter().skip(events.len().saturating_sub(most)) {
        let before_s = at.map_or(0.0, |at| at.seconds_since(event.stamp));
        let _ = writeln!(story, "{:>8.2} s  {}", -before_s, escape(event.text.as_str()));
    }
    let _ = write!(card, "<details><summary>Events</summary><pre>{story}</pre></details>");
    if !flown.lines.is_empty() {
        let lines: Vec<String> = flown.lines.iter().map(|line| escape(line)).collect();
        let _ = write!(
            card,
            "<details><summary>Output of the plugin</summary><pre>{}</pre></details>",
            lines.join("\n")
        );
    }
    if log {
        let path = escape(&log_path(run));
        let _ = write!(
            card,
            "<p class=\"faint\">Flight log: <a href=\"{path}\">{path}</a>, for Foxglove and \
             <code>vizflyt replay {path}</code></p>"
        );
    }
    Ok((card + "</section>\n", files))
}

/// Returns the path of a flight's log in the report.
pub(crate) fn log_path(run: &Run) -> String {
    format!("{LOGS}/{}.mcap", name(run))
}

/// Returns the images of a whole flight, including the last one.
fn whole(flown: &TrialResult) -> Vec<&TrialImage> {
    let mut shots: Vec<&TrialImage> = flown.keyframes.iter().collect();
    let last = flown.shots.back();
    shots.extend(last.filter(|last| shots.last().is_none_or(|shot| shot.stamp < last.stamp)));
    shots
}

/// Returns the time of an image, and the stages passed by then.
fn after_take_off(run: &Run, ended: ServerTime, stamp: ServerTime) -> String {
    let at_s = (run.seconds - ended.seconds_since(stamp)).max(0.0);
    let passed = |stage: &&vizflyt_arena::verdict::StageVerdict| {
        stage.passed_s.is_some_and(|passed_s| passed_s <= at_s)
    };
    let passed = run.stages.iter().filter(passed).count();
    match run.stages.len() {
        0 => format!("{at_s:.1} s"),
        stages => format!("{at_s:.1} s, {passed} of {stages} stages"),
    }
}

fn height(sample: &Sample) -> f64 {
    sample.p_world_m.z
}

/// Returns the median height of a path. [m]
fn middle_height_m(way: &[Sample]) -> Option<f64> {
    let mut heights: Vec<f64> = way.iter().map(height).collect();
    heights.sort_by(f64::total_cmp);
    heights.get(heights.len() / 2).copied()
}

/// Returns the card of a flight from another computer's shard, of which only the grade is
/// available.
pub(crate) fn without_images(run: &Run) -> String {
    head(run)
        + "<p class=\"faint\">Merged from parts: its images, clearance, map and log are in the report of \
           the part that flew it, if that was given <code>--report</code>; or fly this seed again.</p>\
           </section>\n"
}

/// Returns the head of a card: flight, outcome, and reason.
fn head(run: &Run) -> String {
    let Run { seed, variant, outcome, .. } = run;
    // Text of a shard is untrusted: its variant must be escaped.
    let variant = escape(variant);
    let cause = run
        .cause
        .as_deref()
        .map_or(String::new(), |cause| format!("<p class=\"cause\">{}</p>", escape(cause)));
    let stages = match run.stages.len() {
        0 => String::new(),
        stages => format!(", {} of {stages} stages", run.stages_passed),
    };
    let odometry = run.odometry.map_or(String::new(), |odometry| format!("; {}", odometry.text()));
    format!(
        "<section class=\"card\" id=\"{variant}-{seed}\"><h3>Seed {seed}, {variant}: \
         <span class=\"outcome {outcome}\">{}</span></h3>{cause}\
         <p class=\"faint\">{}; {:.1} s after take-off{stages}{odometry}</p>",
        outcome.name().replace('_', " "),
        escape(&run.reason),
        run.seconds
    )
}

/// Writes images; returns them as HTML, side by side, and their files.
fn strip(
    folder: &ReportFolder,
    run: &Run,
    shots: &[&TrialImage],
    label: &str,
    caption: impl Fn(ServerTime) -> String,
) -> Result<(String, Vec<SignedFile>)> {
    if shots.is_empty() {
        return Ok(("<p class=\"faint\">No image was answered.</p>".to_owned(), Vec::new()));
    }
    let mut files = Vec::new();
    let whole = if run.outcome == OutcomeKind::Finished { " whole" } else { "" };
    let mut strip = format!("<div class=\"strip{whole}\" tabindex=\"0\" aria-label=\"{label}\">");
    for (index, shot) in shots.iter().enumerate() {
        let path = format!("{IMAGES}/{}-{index:02}.jpg", name(run));
        let (width, height) = shot.size_px;
        let mut bytes = Vec::new();
        encode_jpeg(&shot.rgb, width, height, QUALITY, &mut bytes)
            .with_context(|| format!("cannot encode {path}"))?;
        files.push(folder.write(&path, &bytes)?);
        let caption = caption(shot.stamp);
        let _ = write!(
            strip,
            "<figure><img src=\"{path}\" width=\"{width}\" height=\"{height}\" \
             alt=\"{caption}\" loading=\"lazy\"><figcaption>{caption}</figcaption></figure>"
        );
    }
    Ok((strip + "</div>", files))
}

#[cfg(test)]
mod tests {
    use vizflyt_protocol::messages::OutcomeKind;

    use super::super::super::document::tests::run;
    use super::*;

    #[test]
    fn escapes_the_plugins_markup_without_images() {
        let mut failed = run(3, OutcomeKind::Collided);
        failed.reason = "bad <script>".to_owned();
        let card = without_images(&failed);
        assert!(card.starts_with("<section class=\"card\" id=\"day-3\">"), "{card}");
        assert!(card.contains("too fast") && card.contains("bad &lt;script&gt;"), "{card}");
        assert!(
            card.contains("report of the part that flew it") && !card.contains("<img"),
            "{card}"
        );
    }
}
