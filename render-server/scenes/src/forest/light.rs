//! Baked light of the forest: a low sun through trunks and crowns, light of the sky, warm reflections from the ground,
//! and ambient occlusion.

use glam::DVec3;

use super::site::Site;
use crate::random::{fractal2, noise2, smoothstep};
use crate::solids::Solids;

/// Light at any point of the forest.
#[derive(Debug)]
pub(crate) struct Light<'a> {
    solids: &'a Solids,
    /// Unit direction towards the sun. [world]
    pub(crate) sun: DVec3,
    seed: u64,
    trunks: Vec<(DVec3, DVec3, f64)>,
}

impl<'a> Light<'a> {
    /// Collects the shadow casters of a site.
    pub(crate) fn new(site: &Site, solids: &'a Solids) -> Self {
        let trunks = site
            .trees
            .iter()
            .map(|tree| {
                let (foot, _) = tree.axis[0];
                let (top, _) = tree.at_height(6.0);
                (foot, top, tree.at_height(1.5).1)
            })
            .collect();
        Self { solids, sun: site.sun, seed: site.seed, trunks }
    }

    /// Returns the share of the sun that reaches a point through trunks and crowns, 0 to 1.
    pub(crate) fn sunlight(&self, p_m: DVec3) -> f64 {
        let through = self.through_crowns(p_m);
        if through < 0.004 { through } else { through * self.past_trunks(p_m) }
    }

    /// Returns the share of the sun that passes through the crowns.
    pub(crate) fn through_crowns(&self, p_m: DVec3) -> f64 {
        let up_m = CROWN_M - p_m.z;
        if up_m <= 0.0 {
            return 1.0;
        }
        let q = (p_m + self.sun * (up_m / self.sun.z)).truncate();
        // Clearings of several metres, with flecks of light of some decimetres within.
        let clearing = noise2(self.seed ^ 0xC1EA, q / 5.5);
        let fleck = fractal2(self.seed ^ 0xF1EC, q / 1.15, 3);
        smoothstep(0.50, 0.62, fleck + 0.42 * (clearing - 0.5))
    }

    fn past_trunks(&self, p_m: DVec3) -> f64 {
        let mut light = 1.0;
        for &(a, b, radius_m) in &self.trunks {
            // Minimum distance of the ray p + s t and the axis a + u v (Eberly, distance of lines).
            let axis = b - a;
            let w = p_m - a;
            let (uu, us, ws, wu) =
                (axis.length_squared(), axis.dot(self.sun), w.dot(self.sun), w.dot(axis));
            let v = ((wu - us * ws) / (uu - us * us).max(1e-9)).clamp(0.0, 1.0);
            let along_m = v * us - ws;
            if along_m < 0.15 {
                continue;
            }
            let off_m = (w + self.sun * along_m - axis * v).length();
            let soft_m = 0.012 + 0.016 * along_m;
            light *= smoothstep(radius_m - soft_m, radius_m + soft_m, off_m);
            if light < 0.004 {
                break;
            }
        }
        light
    }

    /// Returns the light that leaves a matt surface. The point must be on the true surface.
    pub(crate) fn matt(&self, p_m: DVec3, normal: DVec3, albedo: DVec3) -> DVec3 {
        let facing = normal.dot(self.sun).max(0.0);
        let direct = if facing > 0.0 { facing * self.sunlight(p_m) } else { 0.0 };
        albedo * (SUN * direct + self.ambient(normal) * self.solids.openness(p_m, normal))
    }

    /// Returns the light that leaves a thin leaf, which is translucent. `shade` (0 to 1) is the share of sun and sky
    /// that the rest of its plant lets through.
    pub(crate) fn leaf(&self, p_m: DVec3, normal: DVec3, albedo: DVec3, shade: f64) -> DVec3 {
        let facing = normal.dot(self.sun);
        let sun = self.sunlight(p_m) * shade;
        let glow = albedo * DVec3::new(1.0, 1.05, 0.5);
        let direct = albedo * SUN * (facing.max(0.0) * sun)
            + glow * SUN * ((0.2 + 0.3 * (-facing).max(0.0)) * sun);
        direct + albedo * self.ambient(normal) * (0.35 + 0.65 * shade)
    }

    /// Returns ambient light on an open surface.
    pub(crate) fn ambient(&self, normal: DVec3) -> DVec3 {
        let up = 0.5 + 0.5 * normal.z;
        // Because of lit haze, the side of the sun is brighter even in the shade.
        let towards = 0.5 + 0.5 * normal.truncate().dot(self.sun.truncate().normalize_or_zero());
        (SKY * up + BOUNCE * (1.0 - up)) * (0.72 + 0.5 * towards)
    }
}

/// Light of the sun on a perpendicular surface.
pub(crate) const SUN: DVec3 = DVec3::new(3.7, 3.0, 2.0);
/// Light of the sky, filtered by leaves.
const SKY: DVec3 = DVec3::new(0.60, 0.70, 0.68);
/// Light reflected by the ground.
const BOUNCE: DVec3 = DVec3::new(0.34, 0.30, 0.19);
/// Height of the crowns that filter the sun. [m]
const CROWN_M: f64 = 6.5;
