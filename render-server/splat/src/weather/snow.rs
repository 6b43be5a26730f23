//! Snow: size distribution, fall speed and extinction of flakes.
//!
//! - Sizes: `N(D) = N0 exp(-L D)` flakes per m³ and per mm of melted diameter, `N0 = 3800 R^-0.87`,
//!   `L = 2.55 R^-0.48` per mm, R in mm/h of water (Gunn, Marshall, The Distribution with Size of
//!   Aggregate Snowflakes, J. Meteor. 15, 1958).
//! - Size of a flake: snow of diameter S mm has a density of `170 / S` kg/m³ (Holroyd, J. Appl.
//!   Meteor. 10, 1971), so that `S = sqrt(1000 D³ / 170)` mm.
//! - Fall: `1.6 D^0.3` m/s, D in cm melted (Langleben, Q. J. R. Meteor. Soc. 80, 1954). Flakes of
//!   one size also sway: they move in three horizontal directions at a fifth of their fall speed.

use glam::{DVec2, Vec2};

use super::particles::ParticleKind;

/// Snow in the air.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Snow {
    /// Precipitation rate as water. [mm/h]
    pub rate_mmph: f32,
    /// Wind that carries the flakes: east, north. [m/s, world]
    pub wind_mps: Vec2,
}

/// Limits of the size classes that are drawn, as melted diameter. [mm]
const EDGES_MM: [f64; 6] = [0.5, 1.0, 1.5, 2.0, 3.0, 4.5];
/// Number of directions in which flakes of one size move.
const WAYS: u32 = 3;

impl Snow {
    fn slope_per_mm(&self) -> f64 {
        2.55 * f64::from(self.rate_mmph).powf(-0.48)
    }

    fn n0(&self) -> f64 {
        3800.0 * f64::from(self.rate_mmph).powf(-0.87)
    }

    /// Returns the fall speed of a flake, given its melted diameter. [m/s]
    pub fn fall_mps(melted_mm: f64) -> f64 {
        1.6 * (0.1 * melted_mm).powf(0.3)
    }

    /// Returns the diameter of a flake, given its melted diameter. [mm]
    pub fn flake_mm(melted_mm: f64) -> f64 {
        (1000.0 * melted_mm.powi(3) / 170.0).sqrt()
    }

    /// Returns the extinction by all flakes: twice the area of their shadows. [1/m]
    pub fn extinction_per_m(&self) -> f64 {
        // 2 * pi / 4 * integral of S² N(D) with S² = 1000 / 170 D³: the integral is 6 N0 / L⁴, in mm².
        let area_mm2 = 1000.0 / 170.0 * 6.0 * self.n0() / self.slope_per_mm().powi(4);
        std::f64::consts::FRAC_PI_2 * area_mm2 * 1e-6
    }

    /// Returns the flakes by size and direction.
    pub(super) fn kinds(&self) -> impl Iterator<Item = ParticleKind> {
        let (n0, slope) = (self.n0(), self.slope_per_mm());
        let wind_mps = self.wind_mps.as_dvec2();
        EDGES_MM.windows(2).flat_map(move |edges| {
            let [from, to] = [edges[0], edges[1]].map(|mm| (-slope * mm).exp());
            let per_m3 = n0 / slope * (from - to) / f64::from(WAYS);
            let first = |mm: f64, left: f64| (mm + 1.0 / slope) * left;
            let mean_mm = (first(edges[0], from) - first(edges[1], to)) / (from - to);
            let fall_mps = Self::fall_mps(mean_mm);
            (0..WAYS).map(move |way| {
                let angle_rad = std::f64::consts::TAU * f64::from(way) / f64::from(WAYS) + mean_mm;
                let sway_mps = DVec2::from_angle(angle_rad) * (0.2 * fall_mps);
                let v_world_mps = (wind_mps + sway_mps).extend(-fall_mps);
                ParticleKind { diameter_m: Self::flake_mm(mean_mm) * 1e-3, per_m3, v_world_mps }
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drawn_sizes_contain_the_precipitation() {
        for rate in [1.0, 3.0] {
            let snow = Snow { rate_mmph: rate, wind_mps: Vec2::ZERO };
            let falling: f64 = snow
                .kinds()
                .map(|kind| {
                    // Convert to melted diameter.
                    let mm = (0.17 * (kind.diameter_m * 1e3).powi(2)).cbrt();
                    std::f64::consts::PI / 6.0 * mm.powi(3) * kind.per_m3 * -kind.v_world_mps.z
                })
                .sum();
            let mmph = falling * 1e-9 * 1e3 * 3600.0;
            assert!((0.5..1.3).contains(&(mmph / f64::from(rate))), "{rate} mm/h: {mmph}");
        }
    }

    #[test]
    fn fall_speed_and_visibility_are_plausible() {
        assert!((0.6..1.2).contains(&Snow::fall_mps(2.0)));
        // Snow of 1 mm/h of water is "moderate": 500 to 1000 m of visibility (WMO-No. 306, code
        // table 4677).
        let snow = Snow { rate_mmph: 1.0, wind_mps: Vec2::ZERO };
        let sight_m = 50.0_f64.ln() / snow.extinction_per_m();
        assert!((300.0..1500.0).contains(&sight_m), "{sight_m}");
    }
}
