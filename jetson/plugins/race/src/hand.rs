//! Rotating hand of a window: pivot, angle, speed, and the times at which the way is clear.
//!
//! Points in cells of the window that are free at other times belong to the hand. Each image gives its line. Lines of
//! different angles cross at the pivot. Angles over time give the speed, and both predict the hand.

use std::collections::VecDeque;

use vizflyt_sdk::glam::{DMat2, DVec2};
use vizflyt_sdk::protocol::geometry::wrap_pi;

/// Estimates the hand of one window. Points are in the window's plane.
#[derive(Clone, Debug, Default)]
pub struct Hand {
    sightings: VecDeque<Sighting>,
    first_s: Option<f64>,
    last_s: f64,
    motion: Option<HandRotation>,
}

/// The hand in one image.
#[derive(Clone, Copy, Debug)]
struct Sighting {
    at_s: f64,
    /// Middle of the visible part. [m, plane]
    middle_m: DVec2,
    /// Unit vector along the hand.
    along: DVec2,
    /// Half length of the visible part. [m]
    half_m: f64,
}

/// Rotation of the hand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandRotation {
    /// Pivot. [m, plane]
    pub pivot_m: DVec2,
    /// Angle at `at_s`, from the plane's left towards up. [rad]
    pub angle_rad: f64,
    /// Time of that angle. [s]
    pub at_s: f64,
    /// Angular velocity. [rad/s]
    pub omega_radps: f64,
    /// Distance from the pivot to the tip. [m]
    pub length_m: f64,
}

impl HandRotation {
    /// Returns the angle of the hand at a time. [rad]
    pub fn angle_at(&self, at_s: f64) -> f64 {
        wrap_pi(self.angle_rad + self.omega_radps * (at_s - self.at_s))
    }

    /// Returns the distance from a point to the hand's middle line at a time. [m]
    pub fn distance_m(&self, within_m: DVec2, at_s: f64) -> f64 {
        let tip = DVec2::from_angle(self.angle_at(at_s)) * self.length_m;
        let from_pivot_m = within_m - self.pivot_m;
        let along = (from_pivot_m.dot(tip) / tip.length_squared().max(1e-6)).clamp(0.0, 1.0);
        from_pivot_m.distance(tip * along)
    }
}

impl Hand {
    /// Adds the hand's points of an image. [m, plane]
    pub fn update(&mut self, now_s: f64, points_m: &[DVec2]) {
        self.first_s.get_or_insert(now_s);
        self.last_s = now_s;
        while self.sightings.front().is_some_and(|first| now_s - first.at_s > REMEMBERED_S) {
            self.sightings.pop_front();
        }
        if let Some(sighting) = sighting(now_s, points_m) {
            self.sightings.push_back(sighting);
        }
        self.motion = self.fit();
    }

    /// Returns the rotation of the hand, once it is estimated.
    pub fn motion(&self) -> Option<&HandRotation> {
        self.motion.as_ref()
    }

    /// Returns whether a disc of `radius_m` at a point stays clear of the hand during a time interval. A window without
    /// any sighting for a long time has no hand.
    pub fn is_clear(&self, within_m: DVec2, radius_m: f64, from_s: f64, to_s: f64) -> bool {
        let Some(motion) = &self.motion else {
            let watched_s = self.first_s.map_or(0.0, |first_s| self.last_s - first_s);
            return self.sightings.is_empty() && watched_s > NO_HAND_S;
        };
        let steps = 24;
        (0..=steps).all(|n| {
            let at_s = from_s + (to_s - from_s) * f64::from(n) / f64::from(steps);
            motion.distance_m(within_m, at_s) > radius_m + HALF_WIDTH_M
        })
    }

    fn fit(&self) -> Option<HandRotation> {
        // Pieces that the image's edge cuts diagonally have another direction than the hand.
        let longest_m = self.sightings.iter().map(|sighting| sighting.half_m).fold(0.0, f64::max);
        let whole = |sighting: &&Sighting| sighting.half_m > WHOLE * longest_m;
        let pivot_m = pivot_m(self.sightings.iter().filter(whole))?;
        // Use the direction from the pivot to the middle, because the line of a cut piece is a few degrees off.
        let angles: Vec<(f64, f64)> = self
            .sightings
            .iter()
            .filter(whole)
            .map(|sighting| (sighting.at_s, (sighting.middle_m - pivot_m).to_angle()))
            .collect();
        let omega_radps = while_in_sight_radps(&angles)?;
        // While out of sight, the hand may have turned by any angle; the speed gives the number of complete turns.
        let newest_s = self.sightings.back()?.at_s;
        let (mut last_s, mut last_rad) = *angles.first()?;
        let line = Line::through(angles.iter().map(|&(at_s, angle_rad)| {
            let foretold_rad = last_rad + omega_radps * (at_s - last_s);
            (last_s, last_rad) = (at_s, foretold_rad + wrap_pi(angle_rad - foretold_rad));
            (at_s - newest_s, last_rad)
        }))?;
        let tip_m = |sighting: &Sighting| (sighting.middle_m - pivot_m).length() + sighting.half_m;
        let length_m = self.sightings.iter().filter(whole).map(tip_m).fold(0.0, f64::max);
        Some(HandRotation {
            pivot_m,
            angle_rad: wrap_pi(line.at_zero),
            at_s: newest_s,
            omega_radps: line.slope,
            length_m,
        })
    }
}

/// Returns the angular velocity over the intervals in which the hand was always visible; `None` if they are too short.
/// [(s, rad)] -> [rad/s]
fn while_in_sight_radps(angles: &[(f64, f64)]) -> Option<f64> {
    let (mut squares, mut products) = (0.0, 0.0);
    for stretch in angles.chunk_by(|before, after| after.0 - before.0 < OUT_OF_SIGHT_S) {
        let (first_s, first_rad) = stretch[0];
        let turned = |&(at_s, angle_rad): &(f64, f64)| {
            // Less than half a turn, because the hand is visible only above the window's lower edge.
            (at_s - first_s, wrap_pi(angle_rad - first_rad))
        };
        let count = stretch.len() as f64;
        let (t, a) =
            stretch.iter().map(turned).fold((0.0, 0.0), |(t, a), (dt, da)| (t + dt, a + da));
        for (dt, da) in stretch.iter().map(turned) {
            squares += (dt - t / count).powi(2);
            products += (dt - t / count) * (da - a / count);
        }
    }
    (squares > 1e-3).then(|| products / squares)
}

/// A straight line, fitted by least squares.
struct Line {
    at_zero: f64,
    slope: f64,
}

impl Line {
    fn through(points: impl Iterator<Item = (f64, f64)>) -> Option<Self> {
        let (mut n, mut x, mut xx, mut y, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (at, value) in points {
            n += 1.0;
            x += at;
            xx += at * at;
            y += value;
            xy += at * value;
        }
        let spread = n * xx - x * x;
        let slope = (n * xy - x * y) / spread;
        (spread > 1e-9).then(|| Self { at_zero: (y - slope * x) / n, slope })
    }
}

/// Returns the crossing of the hand's lines; `None` if their directions are too similar. [m, plane]
fn pivot_m<'a>(sightings: impl Iterator<Item = &'a Sighting>) -> Option<DVec2> {
    let (mut matrix, mut right, mut count) = (DMat2::ZERO, DVec2::ZERO, 0_u32);
    for sighting in sightings {
        let across = sighting.along.perp();
        let project = DMat2::from_cols(across * across.x, across * across.y);
        matrix += project;
        right += project * sighting.middle_m;
        count += 1;
    }
    let differ = (matrix * (1.0 / f64::from(count.max(1)))).determinant();
    (count >= FEWEST && differ > SWEPT).then(|| matrix.inverse() * right)
}

fn sighting(at_s: f64, points_m: &[DVec2]) -> Option<Sighting> {
    if points_m.len() < FEWEST_POINTS {
        return None;
    }
    let middle_m = points_m.iter().sum::<DVec2>() / points_m.len() as f64;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p_m in points_m {
        let d = *p_m - middle_m;
        xx += d.x * d.x;
        xy += d.x * d.y;
        yy += d.y * d.y;
    }
    let along = DVec2::from_angle(0.5 * (2.0 * xy).atan2(xx - yy));
    let reach = |p_m: &DVec2| (*p_m - middle_m).dot(along).abs();
    let across = |p_m: &DVec2| (*p_m - middle_m).dot(along.perp()).abs();
    let half_m = points_m.iter().map(reach).fold(0.0, f64::max);
    let wide_m = points_m.iter().map(across).sum::<f64>() / points_m.len() as f64;
    // A small spot has no direction.
    (half_m > SHORTEST_M && half_m > 4.0 * wide_m).then_some(Sighting {
        at_s,
        middle_m,
        along,
        half_m,
    })
}

/// Sightings are kept for two turns at 60 degrees per second, or a part of a slower turn. [s]
const REMEMBERED_S: f64 = 8.0;
/// After a gap of this length between sightings, the hand was out of sight. [s]
const OUT_OF_SIGHT_S: f64 = 0.5;
/// Without a sighting for this long, there is no hand: a turn at 40 degrees per second. [s]
const NO_HAND_S: f64 = 9.0;
/// Half of the hand's width, plus the error of its prediction. [m]
const HALF_WIDTH_M: f64 = 0.1;
/// Half of the minimum length of a sighting. [m]
const SHORTEST_M: f64 = 0.12;
/// Minimum length of a sighting for the fit, as a fraction of the longest.
const WHOLE: f64 = 0.7;
const FEWEST: u32 = 12;
const FEWEST_POINTS: usize = 8;
/// Determinant of the lines' mean projector after a sweep of 45 degrees: (1 - sinc^2(45 deg)) / 4.
const SWEPT: f64 = 0.045;

#[cfg(test)]
mod tests;
