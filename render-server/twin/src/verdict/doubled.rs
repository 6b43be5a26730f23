//! Check for doubled places: images whose poses show the same surface from the same side, but that share no points of
//! it.
//!
//! If two rooms that look alike were merged, images of one find the points of the other where expected. But differences
//! between the rooms then exist twice, side by side, and images of the same wall from the same position have nothing in
//! common.

use glam::DVec2;

use super::connected::Shared;
use super::walk::Walk;
use super::{Check, Finding, Severity, Verdict};

/// Adds a finding if many pairs of images should share points and do not.
pub(super) fn check(walk: &Walk<'_>, shared: &Shared, verdict: &mut Verdict) {
    let images = walk.poses.len();
    let seen: Vec<Surface> = (0..images).map(|image| Surface::of(walk, image)).collect();
    let (mut should, mut do_not) = (0, Vec::new());
    for a in 0..images {
        for b in 0..images {
            let common = seen[a].agrees_with(walk, &seen[b], b);
            if a != b && common >= SHOULD {
                should += 1;
                if f64::from(shared.between(a, b)) < NONE * f64::from(common) {
                    do_not.push((a, b));
                }
            }
        }
    }
    verdict.checked.push(format!(
        "doubled: {should} times an image should find what another shows, {} times it finds next to nothing",
        do_not.len()
    ));
    if should == 0 || (do_not.len() as f64) < MANY * f64::from(should) {
        return;
    }
    let mut concerned: Vec<usize> = do_not.iter().map(|(a, _)| *a).collect();
    concerned.sort_unstable();
    concerned.dedup();
    let runs = walk.runs(concerned);
    verdict.findings.push(Finding {
        severity: Severity::Refused,
        check: Check::Doubled,
        what: format!(
            "two places that look alike seem to have been merged: {} of {should} pairs of images see the \
             same from the same side, and have nothing in common: {}",
            do_not.len(),
            walk.spans(&runs)
        ),
        remedy: "put something different into each of the places, such as tags; film both again, and the path between \
                 them in one go"
            .to_owned(),
        images: runs,
    });
}

/// Points that an image saw, with their depth.
struct Surface {
    image: usize,
    /// (point, pixel, depth).
    seen: Vec<(usize, DVec2, f64)>,
    columns: usize,
    cells: Vec<Vec<usize>>,
}

impl Surface {
    fn of(walk: &Walk<'_>, image: usize) -> Self {
        let (width, height) = (f64::from(walk.lens.width_px), f64::from(walk.lens.height_px));
        let cell_px = width / CELLS;
        let columns = (width / cell_px).ceil() as usize + 1;
        let rows = (height / cell_px).ceil() as usize + 1;
        let mut surface =
            Self { image, seen: Vec::new(), columns, cells: vec![Vec::new(); columns * rows] };
        let pose = &walk.poses[image];
        for sighting in &walk.evidence.capture.images[image].seen {
            let p_cam = pose.inverse().transform_point(walk.points[sighting.point]);
            let inside = sighting.pixel.cmpge(DVec2::ZERO).all()
                && sighting.pixel.cmplt(DVec2::new(width, height)).all();
            if p_cam.z > 0.0 && inside {
                let cell = sighting.pixel / cell_px;
                let at = cell.y as usize * columns + cell.x as usize;
                surface.cells[at].push(surface.seen.len());
                surface.seen.push((sighting.point, sighting.pixel, p_cam.z));
            }
        }
        surface
    }

    /// Returns the number of own points that another image should see: where that image has points at the same depth,
    /// and a similar direction and distance.
    fn agrees_with(&self, walk: &Walk<'_>, other: &Self, b: usize) -> u32 {
        if self.image == b {
            return 0;
        }
        let (from, to) = (&walk.poses[self.image], &walk.poses[b]);
        let (width, height) = (f64::from(walk.lens.width_px), f64::from(walk.lens.height_px));
        let cell_px = width / CELLS;
        let mut count = 0;
        for &(point, _, _) in &self.seen {
            let p = walk.points[point];
            let p_cam = to.inverse().transform_point(p);
            let Some(pixel) = walk.lens.project(p_cam) else { continue };
            if !(pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < width && pixel.y < height) {
                continue;
            }
            let (by_a, by_b) = (p - from.translation_m, p - to.translation_m);
            let nearer = by_a.length() / by_b.length();
            let same_side = by_a.dot(by_b) > SIDE_COS * by_a.length() * by_b.length();
            if !(same_side && nearer > 1.0 / DISTANCE && nearer < DISTANCE) {
                continue;
            }
            let cell = pixel / cell_px;
            let at = cell.y as usize * other.columns + cell.x as usize;
            let near = &other.cells[at];
            let same = near.iter().any(|i| (other.seen[*i].2 / p_cam.z - 1.0).abs() < DEPTH);
            count += u32::from(same);
        }
        count
    }
}

/// Number of columns of the raster for the search of neighbours.
const CELLS: f64 = 32.0;
/// Maximum relative difference in depth of the same surface.
const DEPTH: f64 = 0.03;
/// Maximum change of direction in which features are still matched, cos(20 degrees).
const SIDE_COS: f64 = 0.94;
/// Maximum ratio of distances in which features are still matched.
const DISTANCE: f64 = 1.4;
/// Minimum number of points of one image where the other also has surface.
const SHOULD: u32 = 30;
/// Limit of the shared fraction; images of one place share about a fifth or more.
const NONE: f64 = 0.02;
/// Limit of the fraction of such pairs. In correct captures, repeated texture and blur also cause some.
const MANY: f64 = 0.15;
