//! Regions of a scene: box, sphere, prism, and lasso in an image.

use glam::{DQuat, DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::step::{InvalidStep, check_length, check_point, check_rotation, invalid};
use crate::Splats;

/// Region of space. [scene]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Region {
    /// Axis-aligned box.
    Box {
        /// Lowest corner, included.
        min: [f64; 3],
        /// Highest corner, included.
        max: [f64; 3],
    },
    /// Sphere.
    Sphere {
        /// Centre of the sphere.
        center: [f64; 3],
        /// Radius of the sphere.
        radius: f64,
    },
    /// Outline, extruded along an axis.
    Prism {
        /// Axis of the extrusion.
        axis: Axis,
        /// Corners of the outline in the two other coordinates, in the order x, y, z.
        outline: Vec<[f64; 2]>,
        /// Lowest coordinate along the axis.
        low: f64,
        /// Highest coordinate along the axis.
        high: f64,
    },
    /// Splats within an outline in an image: a lasso.
    View {
        /// Position of the camera.
        eye: [f64; 3],
        /// Rotation from the camera's axes (x right, y down, z forward) to the scene: a unit
        /// quaternion x, y, z, w.
        rotation: [f64; 4],
        /// Corners of the outline as slopes x / z, y / z from the camera, independent of its lens.
        outline: Vec<[f64; 2]>,
        /// Whether to select only splats that are not behind the nearest solid splats, as seen from
        /// the camera.
        visible: bool,
    },
}

/// Axis of the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Axis {
    /// x axis; outlines are in y, z.
    X,
    /// y axis; outlines are in x, z.
    Y,
    /// z axis; outlines are in x, y.
    Z,
}

impl Region {
    pub(super) fn check(&self) -> Result<(), InvalidStep> {
        match self {
            Self::Box { min, max } => {
                check_point("min", *min)?;
                check_point("max", *max)?;
                let grows = min.iter().zip(max).all(|(min, max)| min < max);
                let advice = "each must exceed that of min";
                if grows { Ok(()) } else { Err(invalid("max", format!("{max:?}"), advice)) }
            }
            Self::Sphere { center, radius } => {
                check_point("center", *center)?;
                check_length("radius", *radius)
            }
            Self::Prism { outline, low, high, .. } => {
                check_outline(outline)?;
                check_point("low, high", [*low, *high, 0.0])?;
                if low < high { Ok(()) } else { Err(invalid("high", high, "must exceed low")) }
            }
            Self::View { eye, rotation, outline, .. } => {
                check_point("eye", *eye)?;
                check_rotation(*rotation)?;
                check_outline(outline)
            }
        }
    }
}

fn check_outline(outline: &[[f64; 2]]) -> Result<(), InvalidStep> {
    if !(3..=MAX_CORNERS).contains(&outline.len()) {
        let advice = "an outline has 3 to 2000 corners";
        return Err(invalid("outline", format!("{} corners", outline.len()), advice));
    }
    outline.iter().try_for_each(|[u, v]| check_point("outline", [*u, *v, 0.0]))
}

/// Marks the splats with centres in at least one of the regions.
pub fn select(regions: &[Region], splats: &Splats) -> Vec<bool> {
    let mut marks = vec![false; splats.len()];
    for region in regions {
        let found: Vec<bool> = match region {
            Region::Box { min, max } => {
                let (min, max) = (DVec3::from(*min), DVec3::from(*max));
                centers(splats, |p| p.cmpge(min).all() && p.cmple(max).all())
            }
            Region::Sphere { center, radius } => {
                let center = DVec3::from(*center);
                centers(splats, |p| p.distance_squared(center) <= radius * radius)
            }
            Region::Prism { axis, outline, low, high } => {
                let outline = Outline::new(outline);
                centers(splats, |p| {
                    let (along, across) = axis.split(p);
                    (*low..=*high).contains(&along) && outline.contains(across)
                })
            }
            Region::View { eye, rotation, outline, visible } => {
                View::new(*eye, *rotation, outline).select(splats, *visible)
            }
        };
        marks.par_iter_mut().zip(found).for_each(|(mark, found)| *mark |= found);
    }
    marks
}

fn centers(splats: &Splats, inside: impl Fn(DVec3) -> bool + Sync) -> Vec<bool> {
    splats.means_m.par_iter().map(|mean| inside(mean.as_dvec3())).collect()
}

impl Axis {
    /// Returns the coordinate of a point along the axis, and the two other coordinates.
    fn split(self, p: DVec3) -> (f64, DVec2) {
        match self {
            Self::X => (p.x, DVec2::new(p.y, p.z)),
            Self::Y => (p.y, DVec2::new(p.x, p.z)),
            Self::Z => (p.z, DVec2::new(p.x, p.y)),
        }
    }
}

/// Closed outline. If it crosses itself, points that it encloses an odd number of times are inside.
struct Outline {
    corners: Vec<DVec2>,
    min: DVec2,
    max: DVec2,
}

impl Outline {
    fn new(corners: &[[f64; 2]]) -> Self {
        let corners: Vec<DVec2> = corners.iter().copied().map(DVec2::from).collect();
        let min = corners.iter().copied().fold(DVec2::INFINITY, DVec2::min);
        let max = corners.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
        Self { corners, min, max }
    }

    fn contains(&self, p: DVec2) -> bool {
        if !(p.cmpge(self.min).all() && p.cmple(self.max).all()) {
            return false;
        }
        let mut inside = false;
        let mut before = self.corners[self.corners.len() - 1];
        for &corner in &self.corners {
            if (corner.y > p.y) != (before.y > p.y) {
                let share = (p.y - corner.y) / (before.y - corner.y);
                inside ^= p.x < corner.x + share * (before.x - corner.x);
            }
            before = corner;
        }
        inside
    }
}

/// Lasso: a camera and an outline in its image.
struct View {
    eye: DVec3,
    cam_from_scene: DQuat,
    outline: Outline,
}

impl View {
    fn new(eye: [f64; 3], rotation: [f64; 4], outline: &[[f64; 2]]) -> Self {
        let cam_from_scene = DQuat::from_array(rotation).normalize().inverse();
        Self { eye: eye.into(), cam_from_scene, outline: Outline::new(outline) }
    }

    /// Returns slopes and depth of a point, or `None` if it is not in front of the camera.
    fn project(&self, p: DVec3) -> Option<(DVec2, f64)> {
        let p = self.cam_from_scene * (p - self.eye);
        (p.z > 0.0 && p.is_finite()).then(|| (p.truncate() / p.z, p.z))
    }

    fn select(&self, splats: &Splats, visible: bool) -> Vec<bool> {
        let nearest = visible.then(|| Nearest::of(self, splats));
        (0..splats.len())
            .into_par_iter()
            .map(|index| {
                let Some((slope, z)) = self.project(splats.means_m[index].as_dvec3()) else {
                    return false;
                };
                self.outline.contains(slope)
                    && nearest.as_ref().is_none_or(|nearest| {
                        let size = f64::from(splats.scales_m[index].max_element());
                        z <= nearest.at(slope) * (1.0 + BEHIND) + size
                    })
            })
            .collect()
    }
}

/// Depths of the nearest solid splats, in a raster over the outline.
struct Nearest {
    min: DVec2,
    step: DVec2,
    depths: Vec<f64>,
}

impl Nearest {
    fn of(view: &View, splats: &Splats) -> Self {
        let (min, max) = (view.outline.min, view.outline.max);
        let step = ((max - min) / SIDE as f64).max(DVec2::splat(1e-12));
        let mut depths = vec![f64::INFINITY; SIDE * SIDE];
        for index in 0..splats.len() {
            if splats.opacities[index] < SOLID_OPACITY {
                continue;
            }
            let Some((slope, z)) = view.project(splats.means_m[index].as_dvec3()) else { continue };
            // A disc seen at an angle covers about its middle standard deviation. Parts outside the
            // outline are ignored.
            let [a, b, c] = splats.scales_m[index].as_dvec3().to_array();
            let radius = DEVIATIONS * a.min(b).max(a.max(b).min(c)) / z;
            let low = ((slope - radius - min) / step).floor().max(DVec2::ZERO);
            let high = ((slope + radius - min) / step).floor().min(DVec2::splat((SIDE - 1) as f64));
            if !(low.cmple(high).all()) {
                continue;
            }
            for row in low.y as usize..=high.y as usize {
                for depth in &mut depths[row * SIDE..][low.x as usize..=high.x as usize] {
                    *depth = depth.min(z);
                }
            }
        }
        Self { min, step, depths }
    }

    fn at(&self, slope: DVec2) -> f64 {
        let at =
            ((slope - self.min) / self.step).clamp(DVec2::ZERO, DVec2::splat((SIDE - 1) as f64));
        self.depths[at.y as usize * SIDE + at.x as usize]
    }
}

/// Maximum corners of an outline; an outline drawn by hand has some hundred.
const MAX_CORNERS: usize = 2000;
/// Cells of the raster per side. One cell is about one to a few pixels of the image in which a
/// lasso was drawn.
const SIDE: usize = 256;
/// Minimum opacity of a splat that occludes others: the level of the median depth.
const SOLID_OPACITY: f32 = 0.5;
/// Radius within which a solid splat occludes: there, it absorbs an eighth of the light. [standard
/// deviations]
const DEVIATIONS: f64 = 2.0;
/// Maximum distance behind the nearest splat of a splat on the same surface. [share of the depth]
const BEHIND: f64 = 0.02;
