//! Random textures for gates: patterns of two colours on the splats of a gate, shaded by their direction.

use glam::{Vec3, Vec3Swizzles};
use vizflyt_splat::Splats;
use vizflyt_twin::random::Random;

/// Returns the splats with a random texture: plain, stripes or checks in two colours.
pub(super) fn retextured(splats: &Splats, random: &mut Random) -> Splats {
    let mut painted = splats.clone();
    let colours = [colour(random), colour(random)];
    let pattern = random.below(3);
    let cell_m = random.within(0.05, 0.25);
    let slant = random.within(-1.0, 1.0);
    let sun = Vec3::new(random.normal(), random.normal(), 1.5).normalize();
    let numbers = splats.sh_coefficients() * 3;
    for (i, mean_m) in splats.means_m.iter().enumerate() {
        let along = |v: f32| (v / cell_m).floor() as i32;
        let flat_m = mean_m.xy().length();
        let cell = match pattern {
            0 => 0,
            1 => along(mean_m.z + slant * flat_m),
            _ => along(mean_m.x) + along(mean_m.y) + along(mean_m.z),
        };
        let light = 0.6 + 0.4 * outward(splats, i).dot(sun).abs();
        let colour = colours[cell.rem_euclid(2) as usize] * light * random.within(0.96, 1.04);
        let sh = &mut painted.sh[i * numbers..(i + 1) * numbers];
        sh.fill(0.0);
        sh[..3].copy_from_slice(&((colour - 0.5) / SH_CONSTANT).to_array());
    }
    painted
}

/// Draws a display colour of any hue.
pub(super) fn colour(random: &mut Random) -> Vec3 {
    let hue = random.unit() * 6.0;
    let (saturation, value) = (random.unit(), random.within(0.15, 1.0));
    // HSV to RGB (Smith 1978).
    let channel = |n: f32| {
        let k = (n + hue) % 6.0;
        value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0)
    };
    Vec3::new(channel(5.0), channel(3.0), channel(1.0))
}

/// Returns the direction of the smallest extent of a splat.
fn outward(splats: &Splats, i: usize) -> Vec3 {
    splats.rotations[i] * Vec3::AXES[splats.scales_m[i].min_position()]
}

/// The constant harmonic, 1 / (2 sqrt(pi)).
pub(super) const SH_CONSTANT: f32 = 0.282_094_8;

#[cfg(test)]
mod tests {
    use vizflyt_splat::builtin_models::{QUADROTOR, boxes};

    use super::*;

    #[test]
    fn changes_only_colours_and_differs_between_draws() {
        let splats = boxes(&QUADROTOR);
        let painted: Vec<Splats> =
            (0..4).map(|n| retextured(&splats, &mut Random::stream(5, n))).collect();
        for (n, one) in painted.iter().enumerate() {
            assert_eq!((&one.means_m, &one.rotations), (&splats.means_m, &splats.rotations));
            assert_ne!(one.sh, splats.sh);
            assert!(painted[..n].iter().all(|other| other.sh != one.sh));
            let shown = one.sh.iter().map(|sh| sh * SH_CONSTANT + 0.5);
            assert!(shown.clone().all(|value| (-0.01..=1.05).contains(&value)));
        }
    }

    #[test]
    fn draws_colours_of_all_hues() {
        let mut random = Random::new(1);
        let mut strongest = [0; 3];
        for _ in 0..3000 {
            let colour = colour(&mut random);
            assert!(colour.cmpge(Vec3::ZERO).all() && colour.cmple(Vec3::ONE).all());
            strongest[colour.max_position()] += 1;
        }
        assert!(strongest.iter().all(|&count| count > 800), "{strongest:?}");
    }
}
