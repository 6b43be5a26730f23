//! Alignment by printed tags of a known layout in the photos from which the scene was trained.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use vizflyt_process::print_fmt;
use vizflyt_tags::detect::{Detector, DetectorSettings};
use vizflyt_tags::image::Gray;
use vizflyt_tags::layout::{LayoutFrame, Tag, TagLayout};
use vizflyt_twin::Dataset;
use vizflyt_twin::align::Fit;
use vizflyt_twin::align::corners::{self, Ray};
use vizflyt_twin::align::points::{self, Pair};
use vizflyt_twin::dataset::Photo;

/// Estimates the placement from the tags in the photos.
pub(super) fn find(layout_path: &Path, capture: &Path, sigma_m: f64) -> Result<Fit> {
    let layout = TagLayout::read(layout_path)?;
    if layout.frame != LayoutFrame::World {
        print_fmt!(
            "note        {} is not in the world frame: its frame becomes the world frame",
            layout_path.display()
        );
    }
    let dataset = Dataset::read(capture, None)?;
    let mut families: Vec<_> = layout.tags.iter().map(|tag| tag.family).collect();
    families.dedup();
    let mut detector = Detector::new(&families, DetectorSettings::default());
    // For each tag of the layout, the lines of sight to its corners.
    let mut sights: Vec<[Vec<Ray>; 4]> = layout.tags.iter().map(|_| Default::default()).collect();
    let mut with_tags = 0;
    for photo in &dataset.photos {
        let seen = rays(photo, &layout.tags, &mut detector)?;
        with_tags += usize::from(!seen.is_empty());
        for (tag, rays) in seen {
            for (corner, ray) in sights[tag].iter_mut().zip(rays) {
                corner.push(ray);
            }
        }
    }
    let mut pairs = Vec::new();
    let mut tags = 0;
    for (tag, sights) in layout.tags.iter().zip(&sights) {
        let before = pairs.len();
        for (world_m, rays) in tag.corners_m().into_iter().zip(sights) {
            if let Some(corner) = corners::meet(rays) {
                pairs.push(Pair { scene: corner.position, world_m });
            }
        }
        tags += usize::from(pairs.len() > before);
    }
    print_fmt!(
        "seen        {tags} of {} tags from two positions or more, in {with_tags} of {} photos",
        layout.tags.len(),
        dataset.photos.len()
    );
    ensure!(
        tags > 0,
        "no tag of {} is seen from two positions in {}; are the photos sharp, and is it the layout of these tags?",
        layout_path.display(),
        capture.display()
    );
    Ok(points::fit(&pairs, sigma_m)?)
}

/// Returns the indices of the tags in a photo, with the lines of sight to their corners.
fn rays(photo: &Photo, tags: &[Tag], detector: &mut Detector) -> Result<Vec<(usize, [Ray; 4])>> {
    let target = &photo.target;
    // ITU-R BT.601.
    let grey = |rgb: &[u8]| {
        let sum = 299 * u32::from(rgb[0]) + 587 * u32::from(rgb[1]) + 114 * u32::from(rgb[2]);
        (sum / 1000) as u8
    };
    let pixels = target.rgb.chunks_exact(3).map(grey).collect();
    let image = Gray::new(target.width as u32, target.height as u32, pixels)
        .with_context(|| format!("{}: an image without pixels", photo.name))?;
    let found = detector.search(&image, &photo.view.intrinsics(), true);
    let view = &photo.view;
    let origin = view.position.as_dvec3();
    let ray = |px: glam::DVec2| {
        let towards = view.unproject([px.x as f32, px.y as f32], 1.0).as_dvec3() - origin;
        Ray { origin, direction: towards.normalize() }
    };
    Ok(found
        .iter()
        .filter_map(|seen| {
            let is_it = |tag: &Tag| tag.family == seen.family && tag.id == seen.id;
            Some((tags.iter().position(is_it)?, seen.corners_px.map(ray)))
        })
        .collect())
}
