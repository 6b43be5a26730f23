//! `report.html`: one page without external resources.

use std::fmt::Write as _;
use std::path::Path;

use glam::DVec3;
use vizflyt_server::web::top_view::base64;

use super::coverage::{escaped, span, svg};
use super::record::Record;

/// Returns the page, with the images of the folder `trained`.
pub(super) fn html(record: &Record, points: &[DVec3], trained: &Path) -> String {
    let mut page = String::from(HEAD);
    let title = escaped(&record.source);
    // Writing to a string does not fail.
    let _ = write!(page, "<title>{title}: capture</title></head><body><main><h1>{title}</h1>");
    verdict(&mut page, record);
    facts(&mut page, record);
    if let (Some(metric), Some(pictures)) = (&record.metric, &record.pictures) {
        let unseen = record.finished.as_ref().map_or(&[][..], |finished| &finished.unseen);
        let map = svg(metric, pictures, points, unseen);
        if !map.is_empty() {
            let _ = write!(
                page,
                "<h2>The walk from above</h2><p>Blue at its beginning, red at its end; short lines show where the camera \
                 looked, squares are tags, grey dots are points of the room. Dashed red lines: no picture was placed there. Brown: unseen space within the fence \
                 at the heights of flight; solid for the referee, film there too.</p>\
                 <div class=map>{map}</div>"
            );
        }
    }
    tags(&mut page, record);
    samples(&mut page, record, trained);
    stages(&mut page, record);
    page + "</main></body></html>\n"
}

fn verdict(page: &mut String, record: &Record) {
    if let Some(failure) = &record.failure {
        let stage = failure
            .stage
            .map_or("before its first stage".to_owned(), |stage| format!("in its stage {stage}"));
        let (what, remedy) = (escaped(&failure.what), escaped(&failure.remedy));
        let _ = write!(
            page,
            "<p class=\"verdict no\">It stopped {stage}.</p><ul class=findings><li class=no><b class=said>{what}</b><br>\
             What to do: {remedy}.</li></ul>"
        );
    }
    let (class, word) = match (record.fit_to_fly, &record.metric) {
        (true, _) => ("go", "It can be flown."),
        (false, Some(metric)) if !metric.fit_to_fly => ("no", "It is refused."),
        (false, Some(_)) if record.finished.is_some() => {
            ("no", "The alignment is good, but the start is not: correct arena.toml.")
        }
        _ => ("no", "It is not complete."),
    };
    if record.failure.is_none() {
        let _ = write!(page, "<p class=\"verdict {class}\">{word}</p>");
    }
    let metric = record.metric.iter();
    let findings: Vec<_> = metric.flat_map(|metric| &metric.findings).collect();
    let warnings = record.finished.iter().flat_map(|finished| &finished.findings);
    let warnings: Vec<&String> = warnings.chain(&record.remarks).collect();
    if findings.is_empty() && warnings.is_empty() {
        return;
    }
    page.push_str("<ul class=findings>");
    for finding in findings {
        let class = if finding.refused { "no" } else { "warn" };
        let (what, remedy) = (escaped(&finding.what), escaped(&finding.remedy));
        let _ = write!(page, "<li class={class}><b>{what}.</b> {remedy}.");
        if let Some(pictures) = record.pictures.as_ref().filter(|_| !finding.images.is_empty()) {
            let last = pictures.pictures.len().saturating_sub(1);
            let runs = finding.images.iter().filter(|run| run[0] <= run[1] && run[1] <= last);
            let runs: Vec<String> = runs.map(|run| span(pictures, run[0], run[1])).collect();
            let _ = write!(page, " <span class=at>{}</span>", runs.join("; "));
        }
        page.push_str("</li>");
    }
    for warning in warnings {
        let _ = write!(page, "<li class=warn>{}</li>", escaped(warning));
    }
    page.push_str("</ul>");
}

fn facts(page: &mut String, record: &Record) {
    page.push_str("<table>");
    let mut row = |name: &str, text: String| {
        let _ = write!(page, "<tr><th>{name}</th><td>{}</td></tr>", escaped(&text));
    };
    if let Some(pictures) = &record.pictures {
        let of = pictures.pictures.len();
        row("pictures", format!("{of} of {} x {} px", pictures.size_px[0], pictures.size_px[1]));
    }
    if let (Some(pictures), Some(poses)) = (&record.pictures, &record.poses) {
        let of = pictures.pictures.len();
        let placed = record.metric.as_ref().map_or(poses.models[0].placed, |metric| {
            if metric.has_model { metric.way.len() } else { poses.models[0].placed }
        });
        let share = 100.0 * placed as f64 / of.max(1) as f64;
        row("placed", format!("{placed} of {of}, {share:.1} %, by {}", poses.tool));
    }
    if let Some(metric) = record.metric.as_ref().filter(|metric| metric.has_model) {
        let bound = |text: Option<String>, guess: &str| text.unwrap_or_else(|| guess.to_owned());
        let scale =
            metric.scale_bound.map(|share| format!("to {:.2} % (three sigmas)", 100.0 * share));
        row("scale", format!("{}, by {}", bound(scale, "guessed"), metric.scale_from));
        let tilt = metric.tilt_bound_deg.map(|deg| format!("to {deg:.2} degrees (three sigmas)"));
        row("up", format!("{}, by {}", bound(tilt, "unknown"), metric.up_from));
        if let Some(rms_px) = metric.points_rms_px {
            row("points", format!("reprojection error {rms_px:.2} px (rms)"));
        }
        if let Some(shutter) = metric.rolling_shutter {
            row("shutter", shutter.in_words());
        }
        for line in &metric.checked {
            row("checked", line.clone());
        }
    }
    if let Some(trained) = &record.trained {
        let (width, height) = (trained.width_px, trained.height_px);
        row(
            "trained",
            format!("{} splats, {} steps at {width} x {height} px", trained.splats, trained.steps),
        );
        if let Some(held_out) = trained.held_out {
            row(
                "held out",
                format!(
                    "{} photos: PSNR {:.2} dB, SSIM {:.3}",
                    held_out.photos, held_out.psnr_db, held_out.ssim
                ),
            );
        }
    }
    if let Some(finished) = &record.finished {
        row("carved", format!("{} splats removed, {} left", finished.carved, finished.splats));
        let size_m = finished.fence_max_m - finished.fence_min_m;
        row(
            "fence",
            format!(
                "{:.1} x {:.1} x {:.1} m, of which {:.0} % were seen",
                size_m.x,
                size_m.y,
                size_m.z,
                100.0 * finished.seen_share
            ),
        );
        row(
            "obstacles",
            format!(
                "{} voxels of {} m; {} pictures were taken inside one",
                finished.solid_voxels, finished.voxel_m, finished.solid_on_way
            ),
        );
    }
    page.push_str("</table>");
}

fn tags(page: &mut String, record: &Record) {
    let Some(metric) = record.metric.as_ref().filter(|metric| !metric.tags.is_empty()) else {
        return;
    };
    page.push_str(
        "<h2>Tags</h2><table class=grid><tr><th>tag<th>pictures<th>error [px]<th>held out: error [cm]<th>size [%]\
         <th>contradicting</tr>",
    );
    let number = |value: Option<f64>, factor: f64, digits: usize| {
        value.map_or("-".to_owned(), |value| format!("{:.digits$}", value * factor))
    };
    for tag in &metric.tags {
        let _ = write!(
            page,
            "<tr><td>{}<td>{}<td>{}<td>{}<td>{}<td>{}</tr>",
            escaped(&tag.name),
            tag.sightings,
            number(tag.rms_px, 1.0, 2),
            number(tag.held_out_off_m, 100.0, 1),
            number(tag.held_out_size_error, 100.0, 2),
            tag.contradicting
        );
    }
    page.push_str("</table>");
}

fn samples(page: &mut String, record: &Record, trained: &Path) {
    let Some(samples) = record.trained.as_ref().map(|trained| &trained.samples) else { return };
    page.push_str("<h2>Held-out photos and their renderings</h2><div class=pairs>");
    for (k, sample) in samples.iter().enumerate() {
        let picture = |kind: &str| {
            let bytes = std::fs::read(trained.join(format!("{kind}-{k}.jpg"))).unwrap_or_default();
            format!("<img alt=\"{kind}\" src=\"data:image/jpeg;base64,{}\">", base64(&bytes))
        };
        let at_s = record.pictures.as_ref().filter(|p| p.of_video).map(|p| p.at_s(&sample.name));
        let at = at_s.map_or_else(|| escaped(&sample.name), super::images::clock);
        let _ = write!(
            page,
            "<figure>{}{}<figcaption>{at}: {:.1} dB</figcaption></figure>",
            picture("photo"),
            picture("render"),
            sample.psnr_db
        );
    }
    page.push_str("</div>");
}

fn stages(page: &mut String, record: &Record) {
    page.push_str("<h2>Times</h2><table class=grid><tr><th>stage<th>seconds</tr>");
    for time in &record.stages {
        let kept = if time.kept { " (from an earlier run)" } else { "" };
        let _ = write!(page, "<tr><td>{}<td>{:.1}{kept}</tr>", time.stage, time.seconds);
    }
    let _ = write!(page, "</table><p class=at>{}</p>", escaped(&record.made_by));
}

const HEAD: &str = "<!doctype html><html lang=en><head><meta charset=utf-8>\
<meta name=viewport content=\"width=device-width, initial-scale=1\"><style>\
body{font:15px/1.5 system-ui,sans-serif;margin:0;background:#f4f5f7;color:#1c222b}\
main{max-width:900px;margin:0 auto;padding:24px}\
h1{font-size:22px;margin:0 0 8px}h2{font-size:17px;margin:28px 0 6px}\
.verdict{font-size:18px;font-weight:600;padding:10px 14px;border-radius:6px;color:#fff}\
.go{background:#1b7f3b}.verdict.no{background:#b3261e}\
.findings{padding-left:0;list-style:none}.findings li{border-left:4px solid #d99a00;background:#fff;margin:6px 0;\
padding:6px 10px}.findings li.no{border-color:#b3261e}.said{white-space:pre-wrap}\
table{border-collapse:collapse;background:#fff;width:100%}th,td{text-align:left;padding:4px 10px;\
border-bottom:1px solid #e3e6eb;vertical-align:top}table:not(.grid) th{width:7em;font-weight:500;color:#596273}\
.map svg{width:100%;background:#fff;border:1px solid #e3e6eb}\
.pairs{display:grid;grid-template-columns:1fr;gap:12px}figure{margin:0}figure img{width:50%;display:inline-block}\
figcaption,.at{color:#596273;font-size:13px}</style>";

#[cfg(test)]
mod tests {
    use super::super::metric::{FindingFact, Metric};
    use super::super::record::Failure;
    use super::super::work::Stage;
    use super::*;

    #[test]
    fn shows_the_rejection_first_and_escapes_all_text() {
        let mut record = Record::new(Path::new("<hall>.mp4"));
        let finding = FindingFact {
            refused: true,
            of_metres: false,
            what: "12 of 60 images were not placed <i>".to_owned(),
            remedy: "walk there again".to_owned(),
            images: vec![[3, 14]],
        };
        record.metric = Some(Metric { findings: vec![finding], ..Metric::default() });
        let page = html(&record, &[], Path::new("nowhere"));
        assert!(page.contains("It is refused.") && page.contains("walk there again"), "{page}");
        assert!(!page.contains("<hall>") && !page.contains("<i>"), "{page}");
        assert!(!page.contains("http://") && !page.contains("https://"), "no external resources");
        record.metric = None;
        assert!(html(&record, &[], Path::new("nowhere")).contains("It is not complete."));
        record.failure = Some(Failure {
            stage: Some(Stage::Poses),
            what: "pycolmap <failed>".to_owned(),
            remedy: "film slowly".to_owned(),
        });
        let page = html(&record, &[], Path::new("nowhere"));
        assert!(
            page.contains("It stopped in its stage poses.") && page.contains("film slowly."),
            "{page}"
        );
        assert!(!page.contains("<failed>") && !page.contains("It is not complete."), "{page}");
    }
}
