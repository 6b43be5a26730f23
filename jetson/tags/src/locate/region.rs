//! Expected position of tags in an image.

use glam::{DMat3, DVec2};
use vizflyt_protocol::geometry::{Body, Pose, World};

use crate::camera::{Mounting, TagCamera};
use crate::detect::Region;
use crate::layout::{CORNERS, LayoutFrame, Tag};

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Expected {
    /// The vehicle's pose is unknown.
    Unknown,
    /// All tags are outside the image.
    OutOfView,
    /// Tags are inside this region.
    Within(Region),
}

/// Returns the expected region of the tags that move relative to the camera, for a pose with uncertainty
/// `uncertainty_m`.
pub(super) fn expect<'a>(
    camera: &TagCamera,
    tags: impl Iterator<Item = &'a Tag>,
    world_from_body: &Pose<World, Body>,
    uncertainty_m: f64,
) -> Expected {
    let k = &camera.intrinsics;
    let size = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    let mut margin_px = 0.0f64;
    let mut sizes = Sizes::default();
    for tag in tags {
        let Some(corners) = project_tag(camera, tag, world_from_body, WITH_RIM) else { continue };
        let inside = |corner: &DVec2| corner.cmpge(DVec2::ZERO).all() && corner.cmple(size).all();
        if !corners.iter().any(inside) {
            continue;
        }
        for corner in corners {
            low = low.min(corner);
            high = high.max(corner);
        }
        let edges = (0..4).map(|i| corners[i].distance(corners[(i + 1) % 4]) / WITH_RIM);
        let (least, most) =
            edges.fold((f64::INFINITY, 0.0f64), |(low, high), e| (low.min(e), high.max(e)));
        let off_px = uncertainty_m * most / tag.size_m;
        let is_whole = |corner: &DVec2| {
            corner.cmpge(DVec2::splat(off_px)).all()
                && (size - corner).cmpge(DVec2::splat(off_px)).all()
        };
        sizes.add(tag.size_m, least, corners.iter().all(is_whole));
        margin_px = margin_px.max(off_px);
    }
    if !(high.x > low.x) {
        return Expected::OutOfView;
    }
    if let Mounting::Body(_) = camera.mounting {
        // When the vehicle turns, the room moves through the image of its camera.
        margin_px += TURN_UNCERTAINTY_RAD * k.fx_px;
    }
    let margin = DVec2::splat(margin_px + MIN_MARGIN_PX);
    Expected::Within(Region {
        least_px: low - margin,
        most_px: high + margin,
        tag_edge_px: Some(sizes.edge_px()),
    })
}

/// Visible sizes of tags in the image; a mat has tags of several sizes.
#[derive(Default)]
struct Sizes {
    /// Per size: edge of the tag [m], largest of the shortest edges in the image [px], and the same for tags completely
    /// inside the image [px].
    all: Vec<(f64, f64, f64)>,
}

impl Sizes {
    fn add(&mut self, size_m: f64, edge_px: f64, is_whole: bool) {
        let whole_px = if is_whole { edge_px } else { 0.0 };
        match self.all.iter_mut().find(|(of_m, ..)| *of_m == size_m) {
            Some((_, most, whole)) => (*most, *whole) = (most.max(edge_px), whole.max(whole_px)),
            None => self.all.push((size_m, edge_px, whole_px)),
        }
    }

    /// Returns the edge of the tags to look for. With several sizes it is the smallest that is easy to decode: such
    /// tags are numerous, and the image's border does not cut all of them. [px]
    fn edge_px(&self) -> f64 {
        let most_px = |of: fn(&(f64, f64, f64)) -> f64| self.all.iter().map(of).fold(0.0, f64::max);
        if let [(_, edge_px, _)] = self.all[..] {
            return edge_px;
        }
        let whole = self.all.iter().map(|(.., whole_px)| *whole_px);
        let easy_px = whole.filter(|px| *px >= EASY_PX).fold(f64::INFINITY, f64::min);
        if easy_px.is_finite() {
            return easy_px;
        }
        // Otherwise: the largest tag that is completely inside, or the largest of all.
        match most_px(|(.., whole_px)| *whole_px) {
            whole_px if whole_px > 0.0 => whole_px,
            _ => most_px(|(_, edge_px, _)| *edge_px),
        }
    }
}

/// Returns whether a camera can use tags of a layout in this frame.
pub(super) fn sees(mounting: &Mounting, frame: LayoutFrame) -> bool {
    matches!(
        (mounting, frame),
        (Mounting::World(_), LayoutFrame::Body) | (Mounting::Body(_), LayoutFrame::World)
    )
}

/// Returns the projected corners of a tag, scaled about its middle by `scale`. `None` unless all corners are in front
/// of the camera and the printed face is seen at more than a grazing angle.
pub(super) fn project_tag(
    camera: &TagCamera,
    tag: &Tag,
    world_from_body: &Pose<World, Body>,
    scale: f64,
) -> Option<[DVec2; 4]> {
    let (rotation, at) = match camera.mounting {
        Mounting::World(world_from_cam) => {
            let cam_from_body = world_from_cam.inverse() * *world_from_body;
            (cam_from_body.rotation, cam_from_body.translation_m)
        }
        Mounting::Body(body_from_cam) => {
            let cam_from_world = (*world_from_body * body_from_cam).inverse();
            (cam_from_world.rotation, cam_from_world.translation_m)
        }
        Mounting::Unknown => return None,
    };
    let turn = DMat3::from_quat(rotation);
    let middle = turn * tag.position_m + at;
    let normal = turn * tag.normal();
    if !(normal.dot(middle) < -GRAZING * middle.length()) {
        return None;
    }
    let mut corners = [DVec2::ZERO; 4];
    for (corner, c) in corners.iter_mut().zip(CORNERS) {
        let p = tag.position_m + tag.rotation_xyzw * (c * tag.size_m * scale).extend(0.0);
        *corner = camera.intrinsics.project(turn * p + at)?;
    }
    Some(corners)
}

/// Tags with at least this edge are decoded without enlarging the image. [px]
const EASY_PX: f64 = 30.0;
/// Uncertainty of the first pose after a search. [m]
pub(super) const FOUND_UNCERTAINTY_M: f64 = 0.15;
/// Scale that includes the white rim, which detection needs (one cell of eight), and some paper.
const WITH_RIM: f64 = 1.4;
/// Maximum unpredicted rotation between two images. [rad]
const TURN_UNCERTAINTY_RAD: f64 = 0.03;
/// Minimum margin of the region. [px]
const MIN_MARGIN_PX: f64 = 8.0;
/// Minimum cosine between a tag's normal and the view direction: 81 degrees.
const GRAZING: f64 = 0.15;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selects_the_smallest_complete_and_easily_decoded_tag_size() {
        let edge_px = |tags: &[(f64, f64, bool)]| {
            let mut sizes = Sizes::default();
            for &(size_m, edge_px, is_whole) in tags {
                sizes.add(size_m, edge_px, is_whole);
            }
            sizes.edge_px()
        };
        // All faces of a cube have the same size; one is seen at an angle.
        assert_eq!(edge_px(&[(0.2, 80.0, true), (0.2, 20.0, true)]), 80.0);
        // On a pad: the image's border cuts the large tags around it.
        assert_eq!(edge_px(&[(0.2, 500.0, false), (0.042, 120.0, true)]), 120.0);
        assert_eq!(edge_px(&[(0.2, 100.0, false), (0.042, 22.0, true)]), 22.0);
        // Higher up: both sizes are visible, the small one at the limit of detection.
        assert_eq!(edge_px(&[(0.2, 150.0, true), (0.042, 32.0, true)]), 32.0);
        assert_eq!(edge_px(&[(0.2, 90.0, true), (0.042, 19.0, true)]), 90.0);
        assert_eq!(edge_px(&[(0.2, 25.0, true), (0.042, 5.0, true)]), 25.0);
        assert_eq!(edge_px(&[(0.2, 500.0, false), (0.042, 110.0, false)]), 500.0);
    }
}
