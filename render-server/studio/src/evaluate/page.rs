//! HTML page of an evaluation: both paths from above and from the side, and the error over time. One file, no script.

use std::fmt::Write as _;

use super::{Evaluation, Figures};

/// Returns the page.
pub(super) fn html(truth: &str, estimate: &str, evaluation: &Evaluation) -> String {
    let Evaluation { pairs, absolute, figures } = evaluation;
    let start_s = pairs.first().map_or(0.0, |pair| pair.estimate.at_s);
    let places = |k: usize, l: usize| {
        let truth =
            pairs.iter().map(|pair| (pair.truth.position_m[k], pair.truth.position_m[l])).collect();
        let estimate = pairs
            .iter()
            .map(|pair| (pair.estimate.position_m[k], pair.estimate.position_m[l]))
            .collect();
        [Line { class: "truth", points: truth }, Line { class: "estimate", points: estimate }]
    };
    let over_time = |of: fn(&super::Error) -> f64| {
        let points = pairs
            .iter()
            .zip(absolute)
            .map(|(pair, error)| (pair.estimate.at_s - start_s, of(error)));
        [Line { class: "estimate", points: points.collect() }]
    };
    let charts = [
        chart("From above", ("x [m]", "y [m]"), &places(0, 1), true),
        chart("From the side", ("x [m]", "z [m]"), &places(0, 2), true),
        chart(
            "Distance from the truth",
            ("time [s]", "[m]"),
            &over_time(|error| error.place_m),
            false,
        ),
        chart(
            "Attitude error",
            ("time [s]", "[deg]"),
            &over_time(|error| error.turn_rad.to_degrees()),
            false,
        ),
    ]
    .concat();
    format!(
        "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>Evaluation</title>\n<style>{STYLE}</style>\n\
         <h1>{} against {}</h1>\n{}<p><i class=\"truth\"></i> truth <i class=\"estimate\"></i> estimate</p>\n\
         <main>{charts}</main>\n{}</html>\n",
        escaped(estimate),
        escaped(truth),
        table(figures),
        drift(figures)
    )
}

fn table(figures: &Figures) -> String {
    let number = |value: Option<f64>, unit: &str| {
        value.map_or("–".to_owned(), |value| format!("{value:.4} {unit}"))
    };
    let rows = [
        ("Poses compared", figures.pairs.to_string()),
        ("Path, time", format!("{:.2} m, {:.1} s", figures.path_m, figures.seconds)),
        ("Alignment", format!("{}, scale {:.5}", figures.align, figures.scale)),
        ("Absolute error, rmse", number(Some(figures.ate_rmse_m), "m")),
        ("Absolute error, max", number(Some(figures.ate_max_m), "m")),
        ("Attitude, rmse", number(Some(figures.ate_rot_rmse_deg), "deg")),
        (
            "Relative error, rmse",
            number(figures.rpe_trans_rmse_m, &format!("m over {}", figures.delta)),
        ),
        (
            "Relative attitude, rmse",
            number(figures.rpe_rot_rmse_deg, &format!("deg over {}", figures.delta)),
        ),
    ];
    let rows = rows.map(|(name, value)| format!("<tr><th>{name}<td>{value}\n"));
    format!("<table>\n{}</table>\n", rows.concat())
}

fn drift(figures: &Figures) -> String {
    if figures.by_distance.is_empty() {
        return String::new();
    }
    let row = |row: &super::ByDistance| {
        format!(
            "<tr><td>{}<td>{:.4}<td>{:.2}<td>{:.3}<td>{}\n",
            row.distance_m, row.trans_rmse_m, row.trans_percent, row.rot_rmse_deg, row.steps
        )
    };
    let rows: String = figures.by_distance.iter().map(row).collect();
    format!(
        "<h2>Drift</h2>\n<table>\n<tr><th>over m<th>rmse m<th>%<th>deg<th>steps\n{rows}</table>\n"
    )
}

struct Line {
    class: &'static str,
    points: Vec<(f64, f64)>,
}

/// Draws lines into one chart; with `is_map`, both axes have the same scale.
fn chart(title: &str, (x_name, y_name): (&str, &str), lines: &[Line], is_map: bool) -> String {
    let points = || lines.iter().flat_map(|line| &line.points);
    let bounds = |values: &mut dyn Iterator<Item = f64>| {
        let (low, high) = values
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        let room = (0.04 * (high - low)).max(1e-3);
        (low - room, high + room)
    };
    let (mut x, mut y) = (bounds(&mut points().map(|p| p.0)), bounds(&mut points().map(|p| p.1)));
    if !is_map {
        y.0 = 0.0;
    }
    let (width, height) = (WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM);
    let mut scale = (width / (x.1 - x.0), height / (y.1 - y.0));
    if is_map {
        let one = scale.0.min(scale.1);
        scale = (one, one);
        let widen =
            |(low, high): (f64, f64), to: f64| (0.5 * (low + high - to), 0.5 * (low + high + to));
        (x, y) = (widen(x, width / one), widen(y, height / one));
    }
    let at = |(px, py): (f64, f64)| (LEFT + (px - x.0) * scale.0, TOP + (y.1 - py) * scale.1);
    let mut svg =
        format!("<figure><figcaption>{title}</figcaption><svg viewBox=\"0 0 {WIDTH} {HEIGHT}\">\n");
    for value in ticks(x) {
        let (px, _) = at((value, y.0));
        let bottom = HEIGHT - BOTTOM;
        let _ = writeln!(
            svg,
            "<path class=\"grid\" d=\"M{px:.1} {TOP}V{bottom}\"/><text x=\"{px:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            bottom + 16.0,
            label(value)
        );
    }
    for value in ticks(y) {
        let (_, py) = at((x.0, value));
        let _ = writeln!(
            svg,
            "<path class=\"grid\" d=\"M{LEFT} {py:.1}H{}\"/><text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            WIDTH - RIGHT,
            LEFT - 5.0,
            py + 4.0,
            label(value)
        );
    }
    let _ = writeln!(
        svg,
        "<text x=\"{}\" y=\"{}\" text-anchor=\"end\">{x_name}</text><text x=\"{LEFT}\" y=\"{}\">{y_name}</text>",
        WIDTH - RIGHT,
        HEIGHT - 4.0,
        TOP - 6.0
    );
    for line in lines {
        // More points than columns of the image add no detail.
        let every = line.points.len().div_ceil(3000).max(1);
        let path: Vec<String> = line
            .points
            .iter()
            .step_by(every)
            .map(|&p| at(p))
            .map(|(px, py)| format!("{px:.1} {py:.1}"))
            .collect();
        let _ = writeln!(svg, "<path class=\"{}\" d=\"M{}\"/>", line.class, path.join("L"));
    }
    svg + "</svg></figure>\n"
}

/// Returns about five round values within the range.
fn ticks((low, high): (f64, f64)) -> Vec<f64> {
    let rough = (high - low) / 5.0;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|k| k * power)
        .find(|&step| step >= rough)
        .unwrap_or(rough);
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|k| k as f64 * step).collect()
}

fn label(value: f64) -> String {
    // Removes rounding errors.
    let rounded = (value * 1e6).round() / 1e6;
    format!("{}", rounded + 0.0)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 400.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 22.0;
const BOTTOM: f64 = 40.0;
const STYLE: &str = "
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #fff; --grid: #d8dee4; --truth: #57606a; --estimate: #0969da; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6edf3; --paper: #0d1117; --grid: #30363d; --truth: #8b949e; --estimate: #58a6ff; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 84rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.3rem; } h2 { font-size: 1.1rem; }
main { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(36rem, 100%), 1fr)); gap: 1rem; }
figure { margin: 0; } figcaption { font-weight: 600; } svg { width: 100%; }
svg text { font-size: 12px; fill: var(--ink); } path { fill: none; } .grid { stroke: var(--grid); }
path.truth { stroke: var(--truth); stroke-width: 2.5; } path.estimate { stroke: var(--estimate); stroke-width: 1.5; }
i { display: inline-block; width: 1.5em; height: 3px; vertical-align: middle; } i.truth { background: var(--truth); } i.estimate { background: var(--estimate); }
table { border-collapse: collapse; } th { text-align: left; font-weight: 500; padding-right: 1.5em; } td { font-variant-numeric: tabular-nums; padding-right: 1.5em; }
";
