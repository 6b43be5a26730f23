//! Rain: size distribution, fall speed and extinction of drops.
//!
//! - Sizes: `N(D) = 8000 exp(-L D)` drops per m³ and mm, `L = 4.1 R^-0.21` per mm, rain rate R in
//!   mm/h (Marshall, Palmer, The Distribution of Raindrops with Size, J. Meteor. 5, 1948).
//! - Fall: `9.65 - 10.3 exp(-0.6 D)` m/s, D in mm (Atlas, Srivastava, Sekhon, Rev. Geophys. 11, 1973, a fit to
//!   Gunn, Kinzer, J. Meteor. 6, 1949).
//! - Streaks: a drop that crosses a pixel during the exposure leaves a streak as long as its
//!   displacement. For the rest of the exposure, the background is visible through it (Garg, Nayar,
//!   Vision and Rain, IJCV 75, 2007). A drop shows most of its surroundings upside down. It is
//!   therefore brighter than the camera's view below the sky or the lamps.

use glam::Vec2;

use super::particles::ParticleKind;

/// Rain in the air, and drops on the lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rain {
    /// Precipitation rate. [mm/h]
    pub rate_mmph: f32,
    /// Wind that carries the drops: east, north. [m/s, world]
    pub wind_mps: Vec2,
    /// Number of drops on the lens at any time.
    pub lens_drops: u32,
}

/// Limits of the size classes that are drawn. Smaller drops are at most a thousandth of a pixel
/// wide from 0.1 m on. [mm]
const EDGES_MM: [f64; 8] = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0];
/// Number density of drops in the limit of zero diameter. [1/m³/mm]
const N0: f64 = 8000.0;

impl Rain {
    /// Returns the slope of the size distribution. [1/mm]
    fn slope_per_mm(&self) -> f64 {
        4.1 * f64::from(self.rate_mmph).powf(-0.21)
    }

    /// Returns the fall speed of a drop. [m/s]
    pub fn fall_mps(diameter_mm: f64) -> f64 {
        (9.65 - 10.3 * (-0.6 * diameter_mm).exp()).max(0.0)
    }

    /// Returns the extinction by all drops: twice the area of their shadows. [1/m]
    pub fn extinction_per_m(&self) -> f64 {
        // 2 * pi / 4 * integral of D² N(D): 2 N0 / L³, in mm².
        std::f64::consts::FRAC_PI_2 * 2.0 * N0 / self.slope_per_mm().powi(3) * 1e-6
    }

    /// Returns the drops by size.
    pub(super) fn kinds(&self) -> impl Iterator<Item = ParticleKind> {
        let slope = self.slope_per_mm();
        let wind_mps = self.wind_mps.as_dvec2();
        EDGES_MM.windows(2).map(move |edges| {
            let [from, to] = [edges[0], edges[1]].map(|mm| (-slope * mm).exp());
            let per_m3 = N0 / slope * (from - to);
            // Mean diameter between the limits.
            let first = |mm: f64, left: f64| (mm + 1.0 / slope) * left;
            let mean_mm = (first(edges[0], from) - first(edges[1], to)) / (from - to);
            let v_world_mps = wind_mps.extend(-Self::fall_mps(mean_mm));
            ParticleKind { diameter_m: mean_mm * 1e-3, per_m3, v_world_mps }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rain(rate_mmph: f32) -> Rain {
        Rain { rate_mmph, wind_mps: Vec2::ZERO, lens_drops: 0 }
    }

    #[test]
    fn fall_speeds_match_the_measurements_of_gunn_and_kinzer() {
        // Table 2 of the paper: terminal speed at 0.5, 1, 2, 3, 4 and 5 mm.
        let measured =
            [(0.5, 2.06), (1.0, 4.03), (2.0, 6.49), (3.0, 8.06), (4.0, 8.83), (5.0, 9.09)];
        for (mm, mps) in measured {
            assert!((Rain::fall_mps(mm) - mps).abs() < 0.15, "{mm} mm: {} m/s", Rain::fall_mps(mm));
        }
    }

    #[test]
    fn drawn_sizes_contain_the_precipitation() {
        // The water that the drawn drops carry through a square metre per hour is nearly the rate:
        // the distribution is a fit, and its smallest drops are omitted.
        for rate in [5.0, 25.0, 80.0] {
            let falling: f64 = rain(rate)
                .kinds()
                .map(|kind| {
                    let mm = kind.diameter_m * 1e3;
                    std::f64::consts::PI / 6.0 * mm.powi(3) * kind.per_m3 * -kind.v_world_mps.z
                })
                .sum();
            let mmph = falling * 1e-9 * 1e3 * 3600.0;
            assert!((0.75..1.25).contains(&(mmph / f64::from(rate))), "{rate} mm/h: {mmph}");
        }
    }

    #[test]
    fn extinction_of_heavy_rain_matches_measurements() {
        // Ulbrich, Atlas (J. Appl. Meteor. 24, 1985): about 1.2 R^0.63 dB/km; 25 mm/h are 2.1 / km.
        let per_km = rain(25.0).extinction_per_m() * 1e3;
        assert!((1.4..3.2).contains(&per_km), "{per_km}");
    }
}
