//! Generated lawn that resembles a capture. While a city consists of even walls, this scene has layers of leaves in
//! different colours, many faint splats less than 10 cm wide, and thin objects in front of them: the most difficult
//! case for merging.

use glam::{Quat, Vec3};
use vizflyt_splat::Splats;

use crate::city::Random;

/// Side of the lawn, which is centred at the origin. [m]
pub(crate) const SIDE_M: f32 = 12.0;

/// Returns `count` splats, z up: a lawn with stakes.
pub(crate) fn lawn(count: usize) -> Splats {
    let random = &mut Random::new(11);
    let mut splats = Splats { sh_degree: 1, ..Splats::default() };
    // More splats are smaller, with the same total area.
    let size = (100_000.0 / count as f32).sqrt();
    for i in 0..count {
        let mut within = |low, high| random.range(low, high);
        let half = SIDE_M / 2.0;
        let stake = i % 20 == 0;
        let mean_m = if stake {
            // On a grid, 1.5 m high.
            let at = |share: f32| ((share * 6.0).floor() + 0.5) * SIDE_M / 6.0 - half;
            Vec3::new(at(within(0.0, 0.999)), at(within(0.0, 0.999)), within(0.0, 1.5))
                + Vec3::new(within(-0.06, 0.06), within(-0.06, 0.06), 0.0)
        } else {
            let height_m = within(0.0, 1.0).powi(3) * 0.3;
            Vec3::new(within(-half, half), within(-half, half), height_m)
        };
        splats.means_m.push(mean_m);
        let side_m = 0.04 * size * within(-1.2, 0.9).exp();
        splats.scales_m.push(side_m * Vec3::new(within(1.0, 3.0), 1.0, within(0.05, 0.4)));
        let q = Quat::from_array([(); 4].map(|()| within(-1.0, 1.0)));
        splats.rotations.push(if q.length() > 0.1 { q.normalize() } else { Quat::IDENTITY });
        splats.opacities.push(within(0.0, 1.0).sqrt());
        let base = if stake { [-0.8, -0.5, -0.2] } else { [0.1, 0.6, -0.7] };
        let shade = within(-0.5, 0.5);
        splats.sh.extend(base.map(|channel| channel + shade + within(-0.2, 0.2)));
        splats.sh.extend([(); 9].map(|()| within(-0.2, 0.2)));
    }
    splats
}
