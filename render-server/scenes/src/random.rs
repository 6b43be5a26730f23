//! Random numbers and noise that are the same on every machine: they use integer hashes, exact arithmetic and `libm`,
//! but not the platform's mathematics library.

use core::f64::consts::TAU;

use glam::{DVec2, DVec3};
use vizflyt_protocol::random::{GOLDEN, SplitMix64, mix, unit};

/// Random numbers of a stream of a seed.
#[derive(Clone, Debug)]
pub(crate) struct Rng(SplitMix64);

impl Rng {
    /// Returns the stream `stream` of a seed. Streams are independent.
    pub(crate) fn new(seed: u64, stream: u64) -> Self {
        Self(SplitMix64::new(mix(seed ^ mix(stream.wrapping_mul(GOLDEN)))))
    }

    /// Returns a number in [0, 1).
    pub(crate) fn unit(&mut self) -> f64 {
        self.0.unit()
    }

    /// Returns a number in [low, high).
    pub(crate) fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Returns a number in (-half, half).
    pub(crate) fn spread(&mut self, half: f64) -> f64 {
        half * (2.0 * self.unit() - 1.0)
    }

    /// Returns an integer in `0..n`.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        ((self.unit() * n as f64) as usize).min(n - 1)
    }

    /// Returns an angle in [0, 2 pi). [rad]
    pub(crate) fn angle(&mut self) -> f64 {
        TAU * self.unit()
    }

    /// Whether an event of this probability happens.
    pub(crate) fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// Returns a direction with uniform distribution on the sphere.
    pub(crate) fn direction(&mut self) -> DVec3 {
        let z = self.spread(1.0);
        polar(self.angle()).extend(0.0) * (1.0 - z * z).max(0.0).sqrt() + DVec3::Z * z
    }

    /// Returns a number with approximately normal distribution, mean 0 and standard deviation 1 (sum of four uniforms).
    pub(crate) fn normal(&mut self) -> f64 {
        let sum = self.unit() + self.unit() + self.unit() + self.unit();
        (sum - 2.0) * 3f64.sqrt()
    }
}

/// Returns the unit vector at an angle from x towards y.
pub(crate) fn polar(angle_rad: f64) -> DVec2 {
    DVec2::new(libm::cos(angle_rad), libm::sin(angle_rad))
}

/// Returns smooth noise in [0, 1] with features of about unit width.
pub(crate) fn noise(seed: u64, p: DVec3) -> f64 {
    let cell = p.floor();
    let f = p - cell;
    let s = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
    let [x, y, z] = [cell.x as i64, cell.y as i64, cell.z as i64];
    let corner = |dx: i64, dy: i64, dz: i64| lattice(seed, x + dx, y + dy, z + dz);
    let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let face = |dz| {
        lerp(
            lerp(corner(0, 0, dz), corner(1, 0, dz), s.x),
            lerp(corner(0, 1, dz), corner(1, 1, dz), s.x),
            s.y,
        )
    };
    lerp(face(0), face(1), s.z)
}

/// Returns smooth noise in [0, 1] over the plane.
pub(crate) fn noise2(seed: u64, p: DVec2) -> f64 {
    let cell = p.floor();
    let f = p - cell;
    let s = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
    let (x, y) = (cell.x as i64, cell.y as i64);
    let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
    lerp(
        lerp(lattice(seed, x, y, 0), lattice(seed, x + 1, y, 0), s.x),
        lerp(lattice(seed, x, y + 1, 0), lattice(seed, x + 1, y + 1, 0), s.x),
        s.y,
    )
}

/// Returns noise over the plane in about [0, 1] with `octaves` levels of detail, each with half the size and amplitude.
pub(crate) fn fractal2(seed: u64, p: DVec2, octaves: u32) -> f64 {
    let (mut sum, mut height, mut total, mut q) = (0.0, 1.0, 0.0, p);
    for octave in 0..octaves {
        sum += height * noise2(seed.wrapping_add(u64::from(octave)), q);
        total += height;
        height *= 0.5;
        // A factor other than 2 and a shift avoid aligned lattices of the octaves.
        q = q * 2.03 + DVec2::new(17.1, 5.3);
    }
    sum / total
}

/// Returns 0 below `low`, 1 above `high`, and a smooth ramp in between.
pub(crate) fn smoothstep(low: f64, high: f64, x: f64) -> f64 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

fn lattice(seed: u64, x: i64, y: i64, z: i64) -> f64 {
    let key = (x as u64).wrapping_mul(0x9E37_79B1_85EB_CA87)
        ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ (z as u64).wrapping_mul(0x1656_67B1_9E37_79F9);
    unit(mix(key ^ seed.wrapping_mul(GOLDEN)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_have_the_right_moments_and_streams_differ() {
        let mut rng = Rng::new(1, 2);
        let mean = (0..10_000).map(|_| rng.unit()).sum::<f64>() / 1e4;
        assert!((mean - 0.5).abs() < 0.02);
        let variance = (0..10_000).map(|_| rng.normal().powi(2)).sum::<f64>() / 1e4;
        assert!((variance - 1.0).abs() < 0.05);
        assert_ne!(Rng::new(1, 2).unit(), Rng::new(1, 3).unit());
        assert_ne!(Rng::new(1, 2).unit(), Rng::new(2, 2).unit());
    }

    #[test]
    fn noise_is_continuous_and_in_range() {
        let mut rng = Rng::new(3, 0);
        for _ in 0..2000 {
            let p = DVec3::new(rng.spread(50.0), rng.spread(50.0), rng.spread(50.0));
            let here = noise(9, p);
            assert!((0.0..=1.0).contains(&here));
            assert!((noise(9, p + DVec3::splat(1e-4)) - here).abs() < 1e-3);
            let flat = noise2(9, p.truncate());
            assert!((0.0..=1.0).contains(&flat));
            assert!((noise2(9, p.truncate() + DVec2::splat(1e-4)) - flat).abs() < 1e-3);
        }
    }
}
