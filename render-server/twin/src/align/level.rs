//! Finds the floor of a capture in its own points, to level a scene without measurements.
//!
//! People hold a camera about level: the mean of the images' upward directions is accurate to some degrees. Of all
//! planes near level and below the cameras, the one with most points is the floor. It is more accurate than the
//! camera's attitude.

use glam::{DMat3, DVec3};

use super::eigen::symmetric;
use crate::random::Random;

/// A floor, in the frame of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Unit normal, upwards. [scene]
    pub up: DVec3,
    /// Height of the floor along `up`: `up.dot(p)` of its points. [units of the scene]
    pub height: f64,
    /// Number of points on the floor.
    pub points: usize,
    /// RMS distance of the points from the plane. [units of the scene]
    pub rms: f64,
    /// Standard deviation of `up` in the worse direction, from the points; an inclined real floor is not included.
    /// [rad]
    pub tilt_sigma_rad: f64,
}

/// Camera position and the upward direction of its image. [scene]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Held {
    pub position: DVec3,
    /// Upward direction of the image, of unit length.
    pub up: DVec3,
}

/// Finds the floor. Returns `None` if too few points lie in any near-level plane below the cameras.
pub fn find(points: &[DVec3], cameras: &[Held]) -> Option<Level> {
    let hint = cameras.iter().map(|held| held.up).sum::<DVec3>().try_normalize()?;
    let mut heights: Vec<f64> = cameras.iter().map(|held| hint.dot(held.position)).collect();
    heights.sort_by(f64::total_cmp);
    let middle = *heights.get(heights.len() / 2)?;
    let below: Vec<DVec3> =
        points.iter().copied().filter(|p| p.is_finite() && hint.dot(*p) < middle).collect();
    let mut depths: Vec<f64> = below.iter().map(|p| middle - hint.dot(*p)).collect();
    depths.sort_by(f64::total_cmp);
    // Points far below the floor are wrong; most points below the cameras are on the floor or above it.
    let deep = *depths.get(depths.len() * 9 / 10)?;
    let band = BAND * deep;
    let mut random = Random::stream(SEED, 0);
    let mut best: Option<(usize, DVec3, f64)> = None;
    for _ in 0..TRIES {
        let [a, b, c] = std::array::from_fn(|_| below[random.below(below.len())]);
        let Some(normal) = (b - a).cross(c - a).try_normalize() else { continue };
        let normal = if normal.dot(hint) < 0.0 { -normal } else { normal };
        if normal.dot(hint) < MOST_TILT_COS {
            continue;
        }
        let height = normal.dot(a);
        let count = below.iter().filter(|p| (normal.dot(**p) - height).abs() <= band).count();
        // A table also has points, but only a floor has none below it.
        let under = below.iter().filter(|p| normal.dot(**p) < height - 3.0 * band).count();
        let score = count.saturating_sub(2 * under);
        if best.is_none_or(|(most, ..)| score > most) {
            best = Some((score, normal, height));
        }
    }
    let (_, mut up, mut height) = best?;
    let mut level = None;
    for _ in 0..ROUNDS {
        let on: Vec<DVec3> =
            below.iter().copied().filter(|p| (up.dot(*p) - height).abs() <= band).collect();
        if on.len() < LEAST_POINTS {
            return None;
        }
        let count = on.len() as f64;
        let centre = on.iter().sum::<DVec3>() / count;
        let mut spread = DMat3::ZERO;
        for p in &on {
            let d = *p - centre;
            spread += DMat3::from_cols(d * d.x, d * d.y, d * d.z) / count;
        }
        let rows = [0, 1, 2].map(|i| [0, 1, 2].map(|j| spread.col(j)[i]));
        let [(least, normal), (narrow, _), _] = symmetric(rows);
        let normal = DVec3::from_array(normal);
        up = if normal.dot(hint) < 0.0 { -normal } else { normal };
        height = up.dot(centre);
        let rms = least.max(0.0).sqrt();
        let narrow = narrow.max(1e-300).sqrt();
        level = Some(Level {
            up,
            height,
            points: on.len(),
            rms,
            tilt_sigma_rad: rms / narrow / count.sqrt(),
        });
    }
    level.filter(|level| level.up.dot(hint) >= MOST_TILT_COS)
}

/// Maximum distance of a floor's points from it, relative to the camera's height above the lowest points: 3 cm of 1.5
/// m.
const BAND: f64 = 0.02;
/// Maximum inclination, cos(20 degrees): on average, cameras are held more accurately.
const MOST_TILT_COS: f64 = 0.939_692_620_785_908_4;
const TRIES: usize = 500;
const ROUNDS: usize = 5;
/// Minimum number of points: fewer may lie in a plane by chance.
const LEAST_POINTS: usize = 30;
const SEED: u64 = 7;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    /// Returns a hall of 10 x 6 m, 4 m high, in a rotated frame: points on floor and walls, a table, some below the
    /// floor.
    fn hall(turn: DQuat, floor: usize) -> (Vec<DVec3>, Vec<Held>) {
        let mut random = Random::stream(3, 1);
        let mut within = |low: f64, high: f64| low + f64::from(random.unit()) * (high - low);
        let mut points = Vec::new();
        for _ in 0..floor {
            points.push(DVec3::new(within(0.0, 10.0), within(0.0, 6.0), within(-0.01, 0.01)));
        }
        for _ in 0..800 {
            points.push(DVec3::new(within(0.0, 10.0), 6.0, within(0.0, 4.0)));
            points.push(DVec3::new(0.0, within(0.0, 6.0), within(0.0, 4.0)));
        }
        for _ in 0..150 {
            points.push(DVec3::new(within(4.0, 5.0), within(2.0, 3.0), 0.75 + within(-0.01, 0.01)));
        }
        for _ in 0..20 {
            points.push(DVec3::new(within(0.0, 10.0), within(0.0, 6.0), within(-3.0, -0.5)));
        }
        let held = (0..40).map(|_| Held {
            position: DVec3::new(within(1.0, 9.0), within(1.0, 5.0), within(1.35, 1.5)),
            // The camera pitches and rolls by some degrees, and looks down on average.
            up: DVec3::new(within(-0.1, 0.25), within(-0.15, 0.15), 1.0).normalize(),
        });
        let held: Vec<Held> = held.collect();
        let scaled = |p: DVec3| turn * p * 0.3;
        let held = held.into_iter().map(|h| Held { position: scaled(h.position), up: turn * h.up });
        (points.into_iter().map(scaled).collect(), held.collect())
    }

    #[test]
    fn finds_the_floor_despite_tables_and_walls() {
        for turn in
            [DQuat::IDENTITY, DQuat::from_xyzw(0.5, -0.5, 0.5, 0.5), DQuat::from_rotation_x(2.0)]
        {
            let (points, cameras) = hall(turn, 400);
            let level = find(&points, &cameras).unwrap();
            let off = level.up.angle_between(turn * DVec3::Z);
            assert!(off.to_degrees() < 0.1, "{} degrees off", off.to_degrees());
            assert!(off < 5.0 * level.tilt_sigma_rad + 1e-4, "{level:?}");
            assert!(level.height.abs() < 0.003, "{level:?}");
        }
    }

    #[test]
    fn returns_none_without_a_floor() {
        let (points, cameras) = hall(DQuat::IDENTITY, 0);
        let walls: Vec<DVec3> = points.into_iter().filter(|p| p.x == 0.0).collect();
        assert_eq!(find(&walls, &cameras), None);
        assert_eq!(find(&[], &cameras), None);
        assert_eq!(find(&[DVec3::ZERO], &[]), None);
        assert_eq!(find(&[DVec3::NAN; 50], &cameras), None);
    }
}
