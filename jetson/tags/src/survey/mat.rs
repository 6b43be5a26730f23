//! Survey of the tags of a mat or a room, from images of one camera.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use super::{LOSS_PX, MAX_OUTLIERS, SurveyError, camera_pose};
use crate::bundle::{Bundle, CornerObservation, Parameter};
use crate::detection::Detection;
use crate::family::TagFamily;
use crate::layout::{CORNERS, LayoutFrame, Square, Tag, TagLayout};

/// Identifier of a tag.
type Key = (TagFamily, u32);

/// A surveyed mat.
#[derive(Clone, Debug, PartialEq)]
pub struct Surveyed {
    /// Surveyed tags. [world]
    pub layout: TagLayout,
    /// Accuracy of each tag, in the layout's order.
    pub residuals: Vec<TagResidual>,
    /// Number of images used.
    pub images: usize,
    /// Root mean square reprojection error, without misread tags. [px]
    pub rms_px: f64,
    /// Root mean square error on the tags. [m]
    pub rms_m: f64,
    /// Tags that were detected or expected but are not in the layout, with the reason.
    pub left_out: Vec<(TagFamily, u32, &'static str)>,
}

/// Accuracy of a surveyed tag.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TagResidual {
    /// Number of images that show the tag.
    pub images: usize,
    /// Root mean square reprojection error of its corners. [m]
    pub rms_m: f64,
    /// Standard deviation of the position relative to the tag with most detections. [m]
    pub sigma_m: f64,
    /// Distance from the printed layout's position; `None` for a tag that is not in it. [m]
    pub moved_m: Option<f64>,
}

/// Returns the poses of tags from the images of one camera.
///
/// `printed` is the layout of the printed tags. It gives their sizes, initial positions, and the `world` frame. Tags of
/// the family and size in `others` that are not in the layout are also surveyed. The frame is the best fit to all tags
/// of `printed`. With `anchor`, it is the frame in which that tag has exactly its printed pose.
///
/// # Errors
/// [`SurveyError`] if there are too few detections, or if they are inconsistent.
pub fn mat(
    lens: &Intrinsics,
    printed: &TagLayout,
    others: Option<(TagFamily, f64)>,
    anchor: Option<(TagFamily, u32)>,
    images: &[Vec<Detection>],
) -> Result<Surveyed, SurveyError> {
    let size_m = |key: Key| -> Option<f64> {
        let on_mat = printed.find(key.0, key.1).map(|tag| tag.size_m);
        on_mat.or_else(|| others.and_then(|(family, size_m)| (family == key.0).then_some(size_m)))
    };
    // Known tags of each image. An image with one tag connects no tags.
    let images: Vec<Vec<(Key, [DVec2; 4])>> = images
        .iter()
        .map(|image| {
            let known = image.iter().filter(|d| size_m((d.family, d.id)).is_some());
            known.map(|d| ((d.family, d.id), d.corners_px)).collect::<Vec<_>>()
        })
        .filter(|image| image.len() >= 2)
        .collect();
    if images.len() < MIN_IMAGES {
        return Err(SurveyError::TooFew {
            what: "images",
            found: images.len(),
            needed: MIN_IMAGES,
            advice: "carry the camera over the mat so that two tags or more are in every image",
        });
    }
    let mut start = Start::new(printed);
    start.grow(lens, &images, &size_m);
    let mut left_out = Vec::new();
    let counts = count(&images, &start.cameras);
    let keys: Vec<Key> = start.tags.keys().copied().collect();
    for key in keys {
        let seen = counts.get(&key).copied().unwrap_or(0);
        if seen < MIN_SIGHTINGS {
            start.tags.remove(&key);
            let why = if seen == 0 { "in no image" } else { "in one image only" };
            left_out.push((key.0, key.1, why));
        }
    }
    for key in images.iter().flatten().map(|(key, _)| *key).collect::<BTreeSet<_>>() {
        if !start.tags.contains_key(&key) && !left_out.iter().any(|l| (l.0, l.1) == key) {
            left_out.push((key.0, key.1, "never seen together with tags of the mat"));
        }
    }
    if start.tags.len() < 2 {
        return Err(SurveyError::TooFew {
            what: "tags",
            found: start.tags.len(),
            needed: 2,
            advice: "every tag must be in several images, each with another tag",
        });
    }
    let (bundle, numbers, solution) = adjust(lens, &start, &images, &size_m, &counts)?;
    if !(solution.outliers <= MAX_OUTLIERS) {
        return Err(SurveyError::Contradiction {
            rms_px: solution.all_rms_px,
            most_px: LOSS_PX,
            advice: "is the camera file the one of this camera and resolution, and the layout the \
                     one that was printed?",
        });
    }
    let found: BTreeMap<Key, Pose<World, Square>> =
        numbers.iter().map(|(key, number)| (*key, bundle.poses[*number].0.into())).collect();
    let world_from_found = match anchor {
        None => best_fit(printed, &found),
        Some((family, id)) => {
            let missing = SurveyError::Anchor { family, id };
            let tag = printed.find(family, id).ok_or(missing.clone())?;
            let found = found.get(&(family, id)).ok_or(missing)?;
            tag.frame_from_tag::<World>() * found.inverse()
        }
    };
    let mut layout = TagLayout { frame: LayoutFrame::World, tags: Vec::new() };
    let mut residuals = Vec::new();
    for (&(family, id), found_from_tag) in &found {
        let size_m = size_m((family, id)).unwrap_or(1.0);
        let tag = Tag::new(family, id, size_m, world_from_found * *found_from_tag);
        let number = numbers[&(family, id)];
        let rms_m = rms_m(&bundle, lens, |seen| seen.right == number);
        residuals.push(TagResidual {
            images: counts.get(&(family, id)).copied().unwrap_or(0),
            rms_m,
            sigma_m: solution.position_sigma_m(number).length(),
            moved_m: printed.find(family, id).map(|p| p.position_m.distance(tag.position_m)),
        });
        layout.tags.push(tag);
    }
    Ok(Surveyed {
        layout,
        residuals,
        images: start.cameras.iter().flatten().count(),
        rms_px: solution.rms_px,
        rms_m: rms_m(&bundle, lens, |_| true),
        left_out,
    })
}

/// Initial poses of tags and cameras.
struct Start {
    tags: BTreeMap<Key, Pose<World, Square>>,
    /// Camera pose of each image, if it is connected to the others.
    cameras: Vec<Option<Pose<World, Cam>>>,
}

impl Start {
    fn new(printed: &TagLayout) -> Self {
        let tags =
            printed.tags.iter().map(|t| ((t.family, t.id), t.frame_from_tag::<World>())).collect();
        Self { tags, cameras: Vec::new() }
    }

    /// Locates cameras by known tags, and further tags by located cameras, until nothing is added.
    fn grow(
        &mut self,
        lens: &Intrinsics,
        images: &[Vec<(Key, [DVec2; 4])>],
        size_m: &impl Fn(Key) -> Option<f64>,
    ) {
        self.cameras = vec![None; images.len()];
        // A single tag leaves two possible poses: cameras with one tag come last.
        for least in [2, 1] {
            loop {
                let mut grown = false;
                for (image, camera) in images.iter().zip(&mut self.cameras) {
                    if camera.is_some() {
                        continue;
                    }
                    let known: Vec<_> = image
                        .iter()
                        .filter_map(|(key, px)| Some((*self.tags.get(key)?, size_m(*key)?, *px)))
                        .collect();
                    if known.len() >= least
                        && let Some((pose, _)) = camera_pose(lens, &known)
                    {
                        *camera = Some(pose);
                        grown = true;
                    }
                }
                let unknown: BTreeSet<Key> = images
                    .iter()
                    .zip(&self.cameras)
                    .filter(|(_, camera)| camera.is_some())
                    .flat_map(|(image, _)| image.iter().map(|(key, _)| *key))
                    .filter(|key| !self.tags.contains_key(key))
                    .collect();
                for key in unknown {
                    if let Some(pose) = self.place(lens, images, key, size_m(key).unwrap_or(1.0)) {
                        self.tags.insert(key, pose);
                        grown = true;
                    }
                }
                if !grown {
                    break;
                }
            }
        }
    }

    /// Returns the pose of a tag: of the two candidates from each image, the one that fits all images best.
    fn place(
        &self,
        lens: &Intrinsics,
        images: &[Vec<(Key, [DVec2; 4])>],
        key: Key,
        size_m: f64,
    ) -> Option<Pose<World, Square>> {
        let sightings: Vec<(Pose<World, Cam>, [DVec2; 4])> = images
            .iter()
            .zip(&self.cameras)
            .filter_map(|(image, camera)| {
                let (_, corners_px) = image.iter().find(|(other, _)| *other == key)?;
                Some(((*camera)?, *corners_px))
            })
            .collect();
        let cost = |world_from_tag: &Pose<World, Square>| -> f64 {
            let off = |(camera, corners_px): &(Pose<World, Cam>, [DVec2; 4])| -> f64 {
                let cam_from_tag = camera.inverse() * *world_from_tag;
                CORNERS
                    .iter()
                    .zip(corners_px)
                    .map(|(corner, pixel)| {
                        let p_cam = cam_from_tag.transform_point((*corner * size_m).extend(0.0));
                        let far = 100.0;
                        lens.project(p_cam).map_or(far, |p| p.distance(*pixel).min(far))
                    })
                    .sum()
            };
            sightings.iter().map(off).sum()
        };
        let mut best: Option<(f64, Pose<World, Square>)> = None;
        for (world_from_cam, corners_px) in sightings.iter().take(MAX_STARTS) {
            // Pose of the camera relative to the tag: the tag's frame takes the place of the room.
            let Some((_, solved)) = camera_pose(lens, &[(Pose::IDENTITY, size_m, *corners_px)])
            else {
                continue;
            };
            for fit in [Some(solved.best), solved.other].into_iter().flatten() {
                let p = fit.world_from_body;
                let tag_from_cam: Pose<Square, Cam> = Pose::new(p.translation_m, p.rotation);
                let pose = *world_from_cam * tag_from_cam.inverse();
                let cost = cost(&pose);
                if best.is_none_or(|(least, _)| cost < least) {
                    best = Some((cost, pose));
                }
            }
        }
        best.map(|(_, pose)| pose)
    }
}

/// Returns the number of located images that show each tag.
fn count(
    images: &[Vec<(Key, [DVec2; 4])>],
    cameras: &[Option<Pose<World, Cam>>],
) -> BTreeMap<Key, usize> {
    let mut counts = BTreeMap::new();
    for (image, _) in images.iter().zip(cameras).filter(|(_, camera)| camera.is_some()) {
        for (key, _) in image {
            *counts.entry(*key).or_insert(0) += 1;
        }
    }
    counts
}

type Adjusted = (Bundle, BTreeMap<Key, usize>, crate::bundle::Solution);

fn adjust(
    lens: &Intrinsics,
    start: &Start,
    images: &[Vec<(Key, [DVec2; 4])>],
    size_m: &impl Fn(Key) -> Option<f64>,
    counts: &BTreeMap<Key, usize>,
) -> Result<Adjusted, SurveyError> {
    let mut bundle = Bundle { lenses: vec![(*lens, false)], loss_px: LOSS_PX, ..Bundle::default() };
    // The tag with most detections is fixed and defines the frame.
    let held = start.tags.keys().max_by_key(|key| counts.get(key)).copied();
    let numbers: BTreeMap<Key, usize> = start
        .tags
        .iter()
        .map(|(key, pose)| {
            let role = if Some(*key) == held { Parameter::Fixed } else { Parameter::Shared };
            (*key, bundle.pose(*pose, role))
        })
        .collect();
    for (image, camera) in images.iter().zip(&start.cameras) {
        let Some(world_from_cam) = camera else { continue };
        let tags =
            || image.iter().filter_map(|(key, px)| Some((numbers.get(key)?, size_m(*key)?, px)));
        // Without the removed tags, an image may contain none.
        if tags().count() < 1 {
            continue;
        }
        let left = bundle.pose(world_from_cam.inverse(), Parameter::View);
        for (&right, size_m, corners_px) in tags() {
            for (corner, &pixel) in CORNERS.iter().zip(corners_px) {
                let point_m = (*corner * size_m).extend(0.0);
                bundle.seen.push(CornerObservation { lens: 0, left, right, point_m, pixel });
            }
        }
    }
    let solution = bundle.solve().ok_or(SurveyError::Undetermined {
        advice: "carry the camera over the whole mat, nearer, and look at it from several sides",
    })?;
    Ok((bundle, numbers, solution))
}

/// Returns the root mean square reprojection error, scaled to the distance of the corner. [m]
fn rms_m(bundle: &Bundle, lens: &Intrinsics, which: impl Fn(&CornerObservation) -> bool) -> f64 {
    let (mut sum, mut count) = (0.0, 0u32);
    for seen in bundle.seen.iter().filter(|seen| which(seen)) {
        if let Some(residual) = bundle.residual(seen) {
            let focal_px = 0.5 * (lens.fx_px + lens.fy_px);
            sum += (residual.length() * bundle.depth_m(seen) / focal_px).powi(2);
            count += 1;
        }
    }
    (sum / f64::from(count.max(1))).sqrt()
}

/// Returns the rigid motion from the surveyed corners to the printed ones, by least squares over the common tags.
fn best_fit(printed: &TagLayout, found: &BTreeMap<Key, Pose<World, Square>>) -> Pose<World, World> {
    let mut pairs: Vec<(DVec3, DVec3)> = Vec::new();
    for tag in &printed.tags {
        if let Some(pose) = found.get(&(tag.family, tag.id)) {
            let corners = Tag::new(tag.family, tag.id, tag.size_m, *pose).corners_m();
            pairs.extend(corners.into_iter().zip(tag.corners_m()));
        }
    }
    let count = pairs.len().max(1) as f64;
    let middle_found = pairs.iter().map(|p| p.0).sum::<DVec3>() / count;
    let middle_printed = pairs.iter().map(|p| p.1).sum::<DVec3>() / count;
    // Gauss-Newton: surveyed corners are within centimetres of the printed ones.
    let mut q = DQuat::IDENTITY;
    for _ in 0..20 {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (from, to) in &pairs {
            let arm = q * (*from - middle_found);
            let off = (*to - middle_printed) - arm;
            right += arm.cross(off);
            normal += DMat3::from_diagonal(DVec3::splat(arm.length_squared()))
                - DMat3::from_cols(arm * arm.x, arm * arm.y, arm * arm.z);
        }
        let turn = normal.inverse() * right;
        if !turn.is_finite() {
            break;
        }
        q = (DQuat::from_scaled_axis(turn) * q).normalize();
        if turn.length() < 1e-13 {
            break;
        }
    }
    Pose::new(middle_printed - q * middle_found, q)
}

/// Minimum number of images for a reliable survey.
const MIN_IMAGES: usize = 5;
/// Minimum number of images of a tag; with fewer, its position is not verified.
const MIN_SIGHTINGS: usize = 2;
/// Maximum number of images that give candidates for a tag's pose.
const MAX_STARTS: usize = 10;
