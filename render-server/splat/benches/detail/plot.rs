//! Plot of the cost of an image against the number of splats in the scene.

use std::fmt::Write as _;
use std::path::Path;

use vizflyt_splat::{Camera, CpuRenderer, Detail, Splats};

use crate::measure;
use crate::scenes::{self, city::city};

/// Measured sizes of scenes, in millions of splats.
const MILLIONS: [f64; 6] = [0.2, 0.5, 1.0, 2.0, 3.5, 5.0];

/// Line of the plot.
struct Series {
    name: &'static str,
    colour: &'static str,
    scene: fn(usize) -> Splats,
    camera: Camera,
    detail: Detail,
}

/// Measures, prints and writes `docs/render-cost.svg`.
pub(crate) fn draw() {
    let all_in_view = |name, colour, detail| Series {
        name,
        colour,
        scene: |count| city(count, 8, 0),
        camera: scenes::from_above(),
        detail,
    };
    let elsewhere = |name, colour, detail| Series {
        name,
        colour,
        scene: scenes::quarter_and_elsewhere,
        camera: scenes::quarter_camera(),
        detail,
    };
    let series = [
        all_in_view("all in view, every splat rendered", "#d1495b", Detail::Full),
        all_in_view("all in view, adaptive", "#2a9d8f", Detail::ADAPTIVE),
        elsewhere("200 k in view, the rest elsewhere, every splat", "#e09f3e", Detail::Full),
        elsewhere("200 k in view, the rest elsewhere, adaptive", "#3d7ea6", Detail::ADAPTIVE),
    ];
    let mut lines = Vec::new();
    for series in &series {
        let points: Vec<(f64, f64)> = MILLIONS
            .iter()
            .map(|&millions| {
                let splats = (series.scene)((millions * 1e6) as usize);
                let mut renderer = CpuRenderer::with_detail(&splats, series.detail);
                let figures = measure(&mut renderer, &series.camera);
                println!(
                    "{}: {millions} M splats, {:.1} ms of both cores, median {:.1} ms",
                    series.name, figures.processor_ms, figures.median_ms
                );
                (millions, figures.processor_ms)
            })
            .collect();
        lines.push(points);
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/render-cost.svg");
    std::fs::write(&path, svg(&series, &lines)).expect("docs/ can be written");
    println!("wrote docs/render-cost.svg");
}

/// Returns the plot, in greys and colours that are readable on white and on black.
fn svg(series: &[Series], lines: &[Vec<(f64, f64)>]) -> String {
    let greatest_ms = lines.iter().flatten().map(|point| point.1).fold(1.0, f64::max);
    let step_ms = if greatest_ms > 100.0 { 50.0 } else { 20.0 };
    let top_ms = (greatest_ms / step_ms).ceil() * step_ms;
    let x = |millions: f64| 60.0 + millions / 5.0 * 560.0;
    let y = |ms: f64| 330.0 - ms / top_ms * 280.0;
    let mut out = String::new();
    let mut line = |text: String| {
        writeln!(out, "{text}").expect("a string takes all");
    };
    line(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 720 480\" \
         font-family=\"sans-serif\" font-size=\"13\" fill=\"#808080\">"
            .to_owned(),
    );
    line(
        "<text x=\"60\" y=\"28\" font-size=\"15\">Milliseconds per 640x480 RGB-D image, two cores, \
         over splats in the scene</text>"
            .to_owned(),
    );
    let mut ms = 0.0;
    while ms <= top_ms {
        let at = y(ms);
        line(format!(
            "<path d=\"M60 {at:.1}H620\" stroke=\"#808080\" stroke-opacity=\"0.3\"/>\
             <text x=\"52\" y=\"{:.1}\" text-anchor=\"end\">{ms}</text>",
            at + 4.0
        ));
        ms += step_ms;
    }
    for millions in 0..=5 {
        line(format!(
            "<text x=\"{:.1}\" y=\"350\" text-anchor=\"middle\">{millions} M</text>",
            x(f64::from(millions))
        ));
    }
    for (i, (series, points)) in series.iter().zip(lines).enumerate() {
        let colour = series.colour;
        let places: Vec<String> =
            points.iter().map(|&(m, ms)| format!("{:.1},{:.1}", x(m), y(ms))).collect();
        line(format!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2.5\"/>",
            places.join(" ")
        ));
        for &(m, ms) in points {
            line(format!(
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3.5\" fill=\"{colour}\"/>",
                x(m),
                y(ms)
            ));
        }
        let at = 385 + i * 22;
        line(format!(
            "<path d=\"M60 {at}h26\" stroke=\"{colour}\" stroke-width=\"2.5\"/>\
             <text x=\"96\" y=\"{}\">{}</text>",
            at + 4,
            series.name
        ));
    }
    line("</svg>".to_owned());
    out
}
