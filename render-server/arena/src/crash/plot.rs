//! Drawings of a crash card: clearance and speed over time, and the top view, as SVG.
//!
//! The page defines the colours of the classes `axis`, `scale`, `zero`, `way`, `speed`, `solid`, `gate`, `end`.

use std::fmt::Write;

use glam::{DVec2, DVec3};
use vizflyt_protocol::time::ServerTime;

use crate::verdict::Sample;
use crate::{ArenaConfig, ObstacleSlice};

/// Draws clearance and speed over the time before `at`, which is 0.
pub fn clearance(samples: &[Sample], at: ServerTime) -> String {
    let seconds = samples.first().map_or(1.0, |first| at.seconds_since(first.stamp)).max(0.1);
    let most = |of: fn(&Sample) -> f64| samples.iter().map(of).fold(0.5, f64::max);
    let most_m = most(|sample| sample.clearance_m.min(2.0));
    let most_mps = most(|sample| sample.v_world_mps.length());
    let least_m = samples.iter().map(|sample| sample.clearance_m).fold(0.0, f64::min).max(-0.5);
    let (plot_w, plot_h) = (WIDTH - 2.0 * MARGIN, HEIGHT - 2.0 * MARGIN);
    let x = |sample: &Sample| {
        MARGIN + plot_w * (1.0 - at.seconds_since(sample.stamp).clamp(0.0, seconds) / seconds)
    };
    let y_of = |share: f64| MARGIN + plot_h * (1.0 - share.clamp(0.0, 1.0));
    let span_m = most_m - least_m;
    let clearance = line(samples, |s| (x(s), y_of((s.clearance_m - least_m) / span_m)));
    let speed = line(samples, |s| (x(s), y_of(s.v_world_mps.length() / most_mps)));
    let (zero_y, right, bottom) = (y_of(-least_m / span_m), WIDTH - MARGIN, HEIGHT - MARGIN);
    format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"clearance and speed before the \
         end\"><path class=\"axis\" d=\"M{MARGIN} {MARGIN}V{bottom}H{right}V{MARGIN}\"/>\
         <path class=\"zero\" d=\"M{MARGIN} {zero_y:.1}H{right}\"/>\
         <path class=\"speed\" d=\"{speed}\"/><path class=\"way\" d=\"{clearance}\"/>\
         <text x=\"{MARGIN}\" y=\"{top:.1}\">clearance, to {most_m:.2} m</text>\
         <text x=\"{right}\" y=\"{top:.1}\" text-anchor=\"end\">speed, to {most_mps:.1} m/s</text>\
         <text x=\"{MARGIN}\" y=\"{below:.1}\">{seconds:.1} s before</text>\
         <text x=\"{right}\" y=\"{below:.1}\" text-anchor=\"end\">the end</text>\
         <text x=\"{beside:.1}\" y=\"{zero_text:.1}\" text-anchor=\"end\">0</text></svg>",
        top = MARGIN - 10.0,
        below = bottom + 18.0,
        beside = MARGIN - 6.0,
        zero_text = zero_y + 4.0,
    )
}

/// Draws the top view around the last part of the path.
pub fn top_view(
    arena: &ArenaConfig,
    slice: &ObstacleSlice,
    samples: &[Sample],
    way: &[Sample],
) -> String {
    let (least, greatest) = window(arena, samples);
    let size = greatest - least;
    let scale = WIDTH / size.x;
    let height = size.y * scale;
    // x points right, y up.
    let place = |p: DVec3| ((p.x - least.x) * scale, (greatest.y - p.y) * scale);
    let mut solid = String::new();
    for row in 0..slice.rows {
        let y_m = slice.min_m[1] + row as f64 * slice.cell_m;
        if y_m + slice.cell_m < least.y || y_m > greatest.y {
            continue;
        }
        let mut column = 0;
        while column < slice.columns {
            let begin = column;
            while column < slice.columns && slice.is_occupied(column, row) {
                column += 1;
            }
            let (from_m, to_m) = (
                (slice.min_m[0] + begin as f64 * slice.cell_m).max(least.x),
                (slice.min_m[0] + column as f64 * slice.cell_m).min(greatest.x),
            );
            if to_m > from_m {
                let (x, y) = place(DVec3::new(from_m, y_m + slice.cell_m, 0.0));
                let (w, h) = ((to_m - from_m) * scale, slice.cell_m * scale);
                let _ = write!(solid, "M{x:.1} {y:.1}h{w:.1}v{h:.1}h-{w:.1}z");
            }
            column += 1;
        }
    }
    let mut gates = String::new();
    for stage in &arena.stages {
        let across = DVec3::Z.cross(stage.normal).normalize_or(DVec3::Y) * (stage.width_m / 2.0);
        let ((x1, y1), (x2, y2)) = (place(stage.center_m - across), place(stage.center_m + across));
        let _ = write!(gates, "<path class=\"gate\" d=\"M{x1:.1} {y1:.1}L{x2:.1} {y2:.1}\"/>");
    }
    if let Some(goal) = arena.goal {
        let ((x, y), r) = (place(goal.position_m), goal.radius_m * scale);
        let _ = write!(
            gates,
            "<circle class=\"gate\" fill=\"none\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{r:.1}\"/>"
        );
    }
    let path = line(way, |sample| place(sample.p_world_m));
    let end = samples.last().map_or(String::new(), |last| {
        let ((x, y), r) = (place(last.p_world_m), (arena.body_radius_m * scale).max(3.0));
        let nose = DVec3::new(last.yaw_rad.cos(), last.yaw_rad.sin(), 0.0) * (r / scale + 0.25);
        let (nx, ny) = place(last.p_world_m + nose);
        format!(
            "<circle class=\"end\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{r:.1}\"/>\
             <path class=\"zero\" d=\"M{x:.1} {y:.1}L{nx:.1} {ny:.1}\"/>"
        )
    });
    let (metre, bar_y) = (scale, height - 10.0);
    format!(
        "<svg viewBox=\"0 0 {WIDTH} {height:.0}\" role=\"img\" aria-label=\"the place from above\">\
         <path class=\"solid\" d=\"{solid}\"/>{gates}<path class=\"way\" d=\"{path}\"/>{end}\
         <path class=\"scale\" d=\"M10 {bar_y:.1}h{metre:.1}\"/>\
         <text x=\"10\" y=\"{text_y:.1}\">1 m</text></svg>",
        text_y = bar_y - 5.0,
    )
}

/// Returns the corners of the top view. [m, world]
fn window(arena: &ArenaConfig, samples: &[Sample]) -> (DVec2, DVec2) {
    let points = || samples.iter().map(|sample| sample.p_world_m.truncate());
    let start = arena.spawn.position_m.truncate();
    let least = points().reduce(DVec2::min).unwrap_or(start) - AROUND_M;
    let greatest = points().reduce(DVec2::max).unwrap_or(start) + AROUND_M;
    let grow = ((DVec2::splat(MIN_VIEW_M) - (greatest - least)) / 2.0).max(DVec2::ZERO);
    (least - grow, greatest + grow)
}

/// Returns the path through samples, thinned; it contains both ends.
fn line(samples: &[Sample], place: impl Fn(&Sample) -> (f64, f64)) -> String {
    let every = samples.len().div_ceil(MAX_POINTS).max(1);
    let mut path = String::new();
    for (index, sample) in samples.iter().enumerate() {
        if index % every == 0 || index + 1 == samples.len() {
            let (x, y) = place(sample);
            let command = if path.is_empty() { 'M' } else { 'L' };
            let _ = write!(path, "{command}{x:.1} {y:.1}");
        }
    }
    path
}

/// Size of a drawing. [user units]
const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 220.0;
/// Margin around a plot, for labels. [user units]
const MARGIN: f64 = 34.0;
/// Maximum number of points of a path: finer than a pixel for any flight, and 16 KB.
const MAX_POINTS: usize = 1200;
/// Margin of the top view around the last part of the path. [m]
const AROUND_M: f64 = 2.5;
/// Minimum size of the top view. [m]
const MIN_VIEW_M: f64 = 6.0;
