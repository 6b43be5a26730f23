//! Where tags should be in an image.

use glam::DVec2;
use vizflyt_protocol::geometry::{Body, Pose, World};

use super::project_tag;
use crate::camera::{Mounting, TagCamera};
use crate::detect::Region;
use crate::layout::Tag;

/// What is expected of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Expected {
    /// Nothing is known of the vehicle.
    Unknown,
    /// No tag should be in it.
    OutOfView,
    /// Tags should be here.
    Within(Region),
}

/// Returns where tags that move against a camera should be if the vehicle is at a pose, give or take `uncertainty_m`.
pub(super) fn expect<'a>(
    camera: &TagCamera,
    tags: impl Iterator<Item = &'a Tag>,
    world_from_body: &Pose<World, Body>,
    uncertainty_m: f64,
) -> Expected {
    let k = &camera.intrinsics;
    let size = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    let (mut edge_px, mut margin_px) = (0.0f64, 0.0f64);
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
        edge_px = edge_px.max(least);
        margin_px = margin_px.max(uncertainty_m * most / tag.size_m);
    }
    if !(high.x > low.x) {
        return Expected::OutOfView;
    }
    if let Mounting::Body(_) = camera.mounting {
        // The room moves through a carried camera's image when the vehicle turns.
        margin_px += TURN_UNCERTAINTY_RAD * k.fx_px;
    }
    let margin = DVec2::splat(margin_px + MIN_MARGIN_PX);
    Expected::Within(Region {
        least_px: low - margin,
        most_px: high + margin,
        tag_edge_px: Some(edge_px),
    })
}

/// What the first solution of a search may be off. [m]
pub(super) const FOUND_UNCERTAINTY_M: f64 = 0.15;
/// Tags are found by the white rim around them, one cell of eight, and some of the paper.
const WITH_RIM: f64 = 1.4;
/// What the attitude may turn unforeseen between two images. [rad]
const TURN_UNCERTAINTY_RAD: f64 = 0.03;
/// What is added around in any case. [px]
const MIN_MARGIN_PX: f64 = 8.0;
