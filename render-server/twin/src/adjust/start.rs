//! Initial similarity transform from structure from motion's frame to metres.

use glam::{DQuat, DVec3};

use super::capture::Capture;
use super::state::TagPlace;
use super::{AdjustError, Known};
use crate::align::corners::{Ray, meet_within};
use crate::align::points::{self, Pair};
use crate::align::{AlignError, Similarity};

/// Initial values.
#[derive(Clone, Debug)]
pub(super) struct Start {
    pub(super) world_from_scene: Similarity,
    /// Tags in the order of the capture. [world]
    pub(super) tags: Vec<TagPlace>,
}

/// Computes the initial values, and which quantities the measurements determine.
pub(super) fn start(capture: &Capture) -> Result<(Start, Known), AdjustError> {
    check(capture)?;
    let tags: Vec<Option<[DVec3; 4]>> =
        (0..capture.tags.len()).map(|tag| triangulated(capture, tag)).collect();
    let (world_from_scene, known) = similarity(capture, &tags)?;
    let places = capture.tags.iter().zip(&tags).map(|(tag, seen)| match (tag.corners_m, seen) {
        (_, None) => TagPlace::Nowhere,
        (Some(corners_m), _) => TagPlace::Given(corners_m),
        (None, Some(seen)) => {
            let [a, b, c, d] = seen.map(|p| world_from_scene.transform_point(p));
            let x = (b - a + c - d).normalize_or_zero();
            let z = x.cross(d - a + c - b).normalize_or_zero();
            let axes = glam::DMat3::from_cols(x, z.cross(x), z);
            TagPlace::Found((a + b + c + d) / 4.0, DQuat::from_mat3(&axes).normalize())
        }
    });
    let tags = places.collect();
    Ok((Start { world_from_scene, tags }, known))
}

/// Triangulates a tag's corners from images only; `None` if the rays do not meet. [scene]
pub(super) fn triangulated(capture: &Capture, tag: usize) -> Option<[DVec3; 4]> {
    let mut rays: [Vec<Ray>; 4] = Default::default();
    for image in &capture.images {
        for seen in image.tags.iter().filter(|seen| seen.tag == tag) {
            for (rays, &pixel) in rays.iter_mut().zip(&seen.corners_px) {
                let pose = &image.scene_from_cam;
                let slope = capture.lens.slope(pixel)?;
                let direction = (pose.rotation * slope.extend(1.0)).normalize();
                rays.push(Ray { origin: pose.translation_m, direction });
            }
        }
    }
    let mut corners = [DVec3::ZERO; 4];
    for (corner, rays) in corners.iter_mut().zip(&rays) {
        *corner = meet_within(rays, START_RAD)?.position;
    }
    let edges = (0..4).map(|k| corners[k].distance(corners[(k + 1) % 4]));
    let (least, greatest) =
        edges.fold((f64::MAX, 0.0f64), |(low, high), edge| (low.min(edge), high.max(edge)));
    // Rays that meet by chance do not form a square.
    (least > 0.5 * greatest).then_some(corners)
}

fn similarity(
    capture: &Capture,
    tags: &[Option<[DVec3; 4]>],
) -> Result<(Similarity, Known), AdjustError> {
    let in_place = Known { scale: true, up: true, place: true };
    let measured = capture.tags.iter().zip(tags).filter_map(|(tag, seen)| {
        let pairs = tag.corners_m?.into_iter().zip((*seen)?);
        Some(pairs.map(|(world_m, scene)| Pair { scene, world_m }))
    });
    let pairs: Vec<Pair> = measured.flatten().collect();
    if !pairs.is_empty() {
        let fit = points::fit(&pairs, START_SIGMA_M)
            .map_err(|cause| AdjustError::Contradictory { what: "tags", cause })?;
        return Ok((fit.world_from_scene, in_place));
    }
    if let Some(similarity) = by_places(capture)? {
        return Ok((similarity, in_place));
    }
    let mut scales: Vec<f64> = capture
        .tags
        .iter()
        .zip(tags)
        .filter_map(|(tag, seen)| {
            let corners = (*seen)?;
            let round: f64 = (0..4).map(|k| corners[k].distance(corners[(k + 1) % 4])).sum();
            Some(4.0 * tag.size_m / round)
        })
        .collect();
    scales.sort_by(f64::total_cmp);
    let ups = capture
        .images
        .iter()
        .filter_map(|image| Some(image.scene_from_cam.rotation * image.up?.direction));
    let up = ups.sum::<DVec3>();
    let known = Known { scale: !scales.is_empty(), up: up.length() > 0.1, place: false };
    let rotation =
        if known.up { DQuat::from_rotation_arc(up.normalize(), DVec3::Z) } else { DQuat::IDENTITY };
    let scale = scales.get(scales.len() / 2).copied().unwrap_or(1.0);
    Ok((Similarity { scale, rotation, translation_m: DVec3::ZERO }, known))
}

/// Returns the similarity transform from measured positions of cameras, if there are enough.
fn by_places(capture: &Capture) -> Result<Option<Similarity>, AdjustError> {
    let placed = || capture.images.iter().filter_map(|image| Some((image, image.place?)));
    if placed().count() < 4 {
        return Ok(None);
    }
    let mut sigmas_m: Vec<f64> = placed().map(|(_, place)| place.sigma_m).collect();
    sigmas_m.sort_by(f64::total_cmp);
    let sigma_m = sigmas_m[sigmas_m.len() / 2];
    let mut lever = DVec3::ZERO;
    let mut found = None;
    for _ in 0..LEVER_ROUNDS {
        let pairs: Vec<Pair> = placed()
            .map(|(image, place)| Pair {
                scene: image.scene_from_cam.transform_point(lever),
                world_m: place.position_m,
            })
            .collect();
        let fit = match points::fit(&pairs, sigma_m) {
            Ok(fit) => fit,
            // A walk along a line does not determine it.
            Err(AlignError::OnOneLine | AlignError::TooFew { .. }) => return Ok(None),
            Err(cause) => return Err(AdjustError::Contradictory { what: "cameras", cause }),
        };
        lever = capture.tracked_in_cam_m / fit.world_from_scene.scale;
        found = Some(fit.world_from_scene);
    }
    Ok(found)
}

fn check(capture: &Capture) -> Result<(), AdjustError> {
    capture.lens.validate().map_err(|_| AdjustError::BadNumber("the lens"))?;
    let count = capture.points.len();
    let is_number = |ok: bool, what| if ok { Ok(()) } else { Err(AdjustError::BadNumber(what)) };
    is_number(capture.points.iter().all(|p| p.is_finite()), "a point")?;
    is_number(capture.tracked_in_cam_m.is_finite(), "the tracked point's position")?;
    let mut views = vec![0u32; count];
    for image in &capture.images {
        is_number(image.at_s.is_finite() && image.scene_from_cam.is_valid(), "an image's pose")?;
        for seen in &image.seen {
            is_number(seen.point < count && seen.pixel.is_finite(), "a sighting of a point")?;
            views[seen.point] += 1;
        }
        for seen in &image.tags {
            let finite = seen.corners_px.iter().all(|corner| corner.is_finite());
            is_number(seen.tag < capture.tags.len() && finite, "a sighting of a tag")?;
        }
        if let Some(place) = image.place {
            let good = place.position_m.is_finite() && place.sigma_m > 0.0;
            is_number(good && place.sigma_m.is_finite(), "a tracked position")?;
        }
        if let Some(up) = image.up {
            let good = up.direction.is_normalized() && up.sigma_rad > 0.0;
            is_number(good && up.sigma_rad.is_finite(), "a measured vertical")?;
        }
    }
    for tag in &capture.tags {
        let corners = tag.corners_m.iter().flatten().all(|corner| corner.is_finite());
        let good = corners && tag.size_m > 0.0 && tag.size_m.is_finite();
        is_number(good, "a tag's size or position")?;
    }
    let points = views.iter().filter(|&&views| views > 1).count();
    let images = capture.images.len();
    if images < 3 || points < 20 {
        return Err(AdjustError::TooLittle { images, points });
    }
    Ok(())
}

/// Position error of a pose before the adjustment, in a room. [m]
const START_SIGMA_M: f64 = 0.02;
/// Rotation error of a pose before the adjustment. [rad]
const START_RAD: f64 = 0.02;
/// The offset of the tracked point needs the scale, and the other way round.
const LEVER_ROUNDS: usize = 3;
