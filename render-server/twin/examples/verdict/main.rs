//! Adjusts and judges a capture of a generated scene, and prints its error from the truth.
//!
//! ```console
//! $ vizflyt scene generate room --seed 3 --tags --capture room3/ --frames 80
//! $ colmap feature_extractor ... && colmap exhaustive_matcher ... && colmap mapper ... --output_path room3/sparse
//! $ cargo run --release -p vizflyt-twin --example verdict -- room3/ room3/sparse/0 room3/sparse/1
//! ```
//! The first model is judged; further models are second opinions. `--tags none|sizes|layout` selects what is known of
//! the tags (default: `layout`). `--record FOLDER` writes the thinned capture in the format of the tests.

mod record;
mod truth;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use glam::DVec2;
use vizflyt_tags::capture::decode;
use vizflyt_tags::detect::{Detector, DetectorSettings};
use vizflyt_tags::image::Gray;
use vizflyt_tags::layout::TagLayout;
use vizflyt_twin::adjust::{self, Capture, Options, Tag, TagSighting};
use vizflyt_twin::dataset::colmap;
use vizflyt_twin::verdict::{Evidence, Given, Severity, judge};

use truth::Truth;

type Failure = Box<dyn std::error::Error>;

/// Tags in each image (by name): tag index and corners.
type Sightings = BTreeMap<String, Vec<(usize, [[f64; 2]; 4])>>;

fn main() -> Result<ExitCode, Failure> {
    let mut words: Vec<String> = std::env::args().skip(1).collect();
    let mut option = |name: &str| {
        let at = words.iter().position(|word| word == name)?;
        let value = words.get(at + 1).cloned();
        words.drain(at..(at + 2).min(words.len()));
        value
    };
    let (mode, record) = (option("--tags"), option("--record"));
    let mode = mode.unwrap_or_else(|| "layout".to_owned());
    let [images, models @ ..] = words.as_slice() else {
        return Err("give the folder of images and that of a model".into());
    };
    let folder = Path::new(images);
    let truth = Truth::read(&folder.join("truth.json"))?;
    let given: Vec<Given> = truth
        .images
        .iter()
        .map(|image| Given { name: image.name.clone(), at_s: Some(image.at_s) })
        .collect();
    let mut captures = Vec::new();
    for model in models {
        let at_s =
            |name: &str| given.iter().find(|g| g.name == name).and_then(|g| g.at_s).unwrap_or(0.0);
        captures.push(Capture::new(&colmap::read(Path::new(model))?, at_s)?);
    }
    let (capture, others) = captures.split_first_mut().ok_or("give a model's folder")?;
    if mode != "none" {
        let layout = TagLayout::read(&folder.join("tags.toml"))?;
        let sightings = sightings(folder, &layout, &given, &capture.lens)?;
        add_tags(capture, &layout, &sightings, mode == "layout");
    }
    if let Some(folder) = record {
        record::record(Path::new(&folder), capture, &truth)?;
    }
    let begun = Instant::now();
    let adjusted = adjust::adjust(capture, Options::default());
    println!("adjusted in {:.2} s", begun.elapsed().as_secs_f64());
    match &adjusted {
        Ok(adjusted) => report(&truth, capture, adjusted),
        Err(error) => println!("adjust: {error}"),
    }
    let begun = Instant::now();
    let verdict = judge(&Evidence {
        given: &given,
        capture,
        adjusted: adjusted.as_ref(),
        others,
        aligned: None,
    });
    println!("judged in {:.2} s", begun.elapsed().as_secs_f64());
    for line in &verdict.checked {
        println!("  {line}");
    }
    for finding in &verdict.findings {
        let severity = match finding.severity {
            Severity::Refused => "REFUSED",
            Severity::Warning => "warning",
        };
        println!(
            "{severity} [{:?}] {}\n        -> {}",
            finding.check, finding.what, finding.remedy
        );
    }
    let fly = verdict.is_fit_to_fly();
    println!("{}", if fly { "FLY" } else { "NOT TO BE FLOWN" });
    Ok(if fly { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn report(truth: &Truth, capture: &Capture, adjusted: &adjust::Adjusted) {
    println!(
        "images {} points {} rounds {} points {:.3} px rms, {:.1} % outliers; focal {:.2}",
        capture.images.len(),
        capture.points.len(),
        adjusted.rounds,
        adjusted.points_rms_px,
        100.0 * adjusted.points_outliers,
        adjusted.lens.fx_px
    );
    let before: Vec<_> =
        capture.images.iter().map(|i| (i.name.as_str(), i.scene_from_cam)).collect();
    println!("  model, fitted to the truth:    {}", truth.compare(&before, true));
    let tagged: Vec<_> = before
        .iter()
        .map(|(name, pose)| {
            let to = &adjusted.world_from_scene;
            let at = to.transform_point(pose.translation_m);
            (*name, vizflyt_protocol::geometry::Pose::new(at, to.rotation * pose.rotation))
        })
        .collect();
    println!("  model, placed by tags only:    {}", truth.compare(&tagged, false));
    let after: Vec<_> = capture
        .images
        .iter()
        .zip(&adjusted.world_from_cam)
        .map(|(i, p)| (i.name.as_str(), *p))
        .collect();
    println!("  adjusted:                      {}", truth.compare(&after, false));
    println!("  adjusted, fitted to the truth: {}", truth.compare(&after, true));
    println!(
        "  scale sigma {:?} %, tilt sigma {:?} degrees",
        adjusted.scale_sigma.map(|s| 100.0 * s),
        adjusted.tilt_sigma_rad.map(f64::to_degrees)
    );
    println!("  corners of tags {:.3} px inside", adjusted.inset_px);
    if let Some(readout) = adjusted.readout {
        println!("  rows over {:.2} ms, sigma {:.2}", 1e3 * readout.seconds, 1e3 * readout.sigma_s);
    }
    for (tag, result) in capture.tags.iter().zip(&adjusted.tags) {
        if let Some(r) = result {
            println!(
                "  {}: {} sightings, {} contradict, {:.2} px; held out {:?}",
                tag.name, r.sightings, r.contradicting, r.rms_px, r.held_out
            );
        }
    }
}

fn add_tags(capture: &mut Capture, layout: &TagLayout, sightings: &Sightings, is_placed: bool) {
    for tag in &layout.tags {
        capture.tags.push(Tag {
            name: format!("{} {}", tag.family.name(), tag.id),
            size_m: tag.size_m,
            corners_m: is_placed.then(|| tag.corners_m()),
        });
    }
    for image in &mut capture.images {
        for (tag, corners) in sightings.get(&image.name).into_iter().flatten() {
            let corners_px = corners.map(DVec2::from_array);
            image.tags.push(TagSighting { tag: *tag, corners_px });
        }
    }
}

/// Detects tags in all images, and caches the result in the folder.
fn sightings(
    folder: &Path,
    layout: &TagLayout,
    given: &[Given],
    lens: &vizflyt_protocol::geometry::Intrinsics,
) -> Result<Sightings, Failure> {
    let kept: PathBuf = folder.join("sightings.json");
    if let Ok(text) = std::fs::read_to_string(&kept) {
        return Ok(serde_json::from_str(&text)?);
    }
    let mut families: Vec<_> = layout.tags.iter().map(|tag| tag.family).collect();
    families.dedup();
    let mut detector = Detector::new(&families, DetectorSettings::default());
    let mut all = Sightings::new();
    for image in given {
        let bytes = std::fs::read(folder.join(&image.name))?;
        let gray: Gray = decode(&bytes)?;
        let found = detector.search(&gray, lens, true);
        let known = found.iter().filter_map(|seen| {
            let is_it =
                |tag: &vizflyt_tags::layout::Tag| tag.family == seen.family && tag.id == seen.id;
            let index = layout.tags.iter().position(is_it)?;
            Some((index, seen.corners_px.map(|corner| corner.to_array())))
        });
        all.insert(image.name.clone(), known.collect());
    }
    std::fs::write(&kept, serde_json::to_string(&all)?)?;
    Ok(all)
}
