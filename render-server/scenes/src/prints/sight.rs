//! Visibility of prints from a walk.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Pose, World};

use super::Print;
use crate::solids::Solids;
use crate::walk::Walk;

/// Camera at an instant of a walk.
pub(super) struct Glimpse {
    pub(super) world_from_cam: Pose<World, Cam>,
}

/// Returns glimpses at even intervals.
pub(super) fn glimpses(walk: &Walk) -> Vec<Glimpse> {
    let count = (walk.seconds() / GLIMPSE_S).ceil();
    let at = |n: usize| walk.seconds() * n as f64 / count;
    (0..count as usize).map(|n| Glimpse { world_from_cam: walk.world_from_cam(at(n)) }).collect()
}

/// Returns dense positions of the walker. [m, world]
pub(super) fn way_m(walk: &Walk) -> Vec<DVec2> {
    let count = (walk.length_m() / 0.2).ceil().max(8.0);
    let at = |n: usize| walk.world_from_cam(walk.seconds() * n as f64 / count);
    (0..count as usize).map(|n| at(n).translation_m.truncate()).collect()
}

impl Glimpse {
    /// Whether a phone sees a complete print, large enough and from a suitable angle to be read.
    pub(super) fn sees(&self, print: &Print, solids: &Solids) -> bool {
        let eye_m = self.world_from_cam.translation_m;
        let pose = print.world_from_print;
        let way = eye_m - pose.translation_m;
        let far_m = way.length();
        let facing = pose.rotate(DVec3::Z).dot(way) / far_m;
        if !(NEAR_M..FAR_M).contains(&far_m) || facing < FACING {
            return false;
        }
        let cam_from_world = self.world_from_cam.inverse();
        let half = print.side_m / 2.0;
        let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (0.0, 0.0)];
        corners.iter().all(|&(x, y)| {
            let p_m = pose.transform_point(DVec3::new(half * x, half * y, 0.02));
            let p_cam = cam_from_world.transform_point(p_m);
            let slope = p_cam.truncate() / p_cam.z;
            p_cam.z > 0.3
                && slope.x.abs() < SLOPES.x
                && slope.y.abs() < SLOPES.y
                && is_clear(solids, p_m, eye_m)
        })
    }
}

/// Whether no solid is between a point on a surface and another point. Uses sphere tracing (Hart 1996).
fn is_clear(solids: &Solids, from_m: DVec3, to_m: DVec3) -> bool {
    let way = to_m - from_m;
    let length_m = way.length();
    let toward = way / length_m;
    // Start outside of the board's wall.
    let mut along_m = 0.08;
    while along_m < length_m {
        let free_m = solids.distance_to_bodies_m(from_m + toward * along_m);
        if free_m < 0.01 {
            return false;
        }
        along_m += free_m.max(0.02);
    }
    true
}

/// Time between glimpses. [s]
const GLIMPSE_S: f64 = 0.4;
/// Distance range in which a tag of 0.24 m has 120 to 20 px in an image of 640 px width. [m]
const NEAR_M: f64 = 0.9;
const FAR_M: f64 = 4.6;
/// Cosine of the maximum viewing angle for reading a tag: 60 degrees.
const FACING: f64 = 0.5;
/// Limits of the slopes that are well within a phone's image for all lenses.
const SLOPES: DVec2 = DVec2::new(0.56, 0.40);
