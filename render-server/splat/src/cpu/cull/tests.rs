use glam::{DQuat, DVec3, Quat};
use vizflyt_protocol::geometry::{Distortion, Intrinsics, World};

use super::*;
use crate::Splats;
use crate::cpu::detail::Detail;
use crate::cpu::lens::Lenses;
use crate::cpu::project::{Projected, project};
use crate::cpu::simd::Portable;

/// Returns splats in all directions, mostly small, some of them metres across; about 120 blocks.
fn part() -> Part {
    let mut splats = Splats::default();
    for i in 0..30_000u32 {
        let spread = |k: f64| (f64::from(i) * k).fract() as f32 * 2.0 - 1.0;
        let at = Vec3::new(spread(0.618_034), spread(0.414_214), spread(0.732_051)) * 6.0;
        let size_m = if i % 9000 == 5 { 3.0 } else { 0.002 * (1.0 + (i % 30) as f32) };
        splats.means_m.push(at);
        splats.scales_m.push(Vec3::new(size_m, 0.5 * size_m, 0.2 * size_m));
        splats.rotations.push(Quat::from_rotation_y(spread(0.236_068)));
        splats.opacities.push(0.9);
        splats.sh.extend([0.0; 3]);
    }
    Part::new(0, &splats, Detail::Full)
}

fn lenses() -> Vec<Intrinsics> {
    let mut all = Vec::new();
    for fov in [0.4, 1.1, 2.0, 2.9] {
        let k = Intrinsics::from_horizontal_fov(96, 72, fov);
        let shifted = Intrinsics { cx_px: 10.0, cy_px: 90.0, fy_px: 1.4 * k.fy_px, ..k };
        for k in [k, shifted] {
            all.push(k);
            for [k1, k2, p1, p2, k3] in [
                [-0.3, 0.1, 0.001, -0.002, 0.0],
                [0.2, 0.0, -0.01, 0.0, 0.0],
                [-0.05, 0.0, 0.0, 0.0, 0.0],
            ] {
                let distortion = Distortion::BrownConrady { k1, k2, p1, p2, k3 };
                all.push(Intrinsics { distortion, ..k });
            }
            for [k1, k2, k3, k4] in [[0.0; 4], [0.1, -0.02, 0.005, -0.001], [-0.2, 0.0, 0.0, 0.0]] {
                let distortion = Distortion::KannalaBrandt { k1, k2, k3, k4 };
                // Maximum pixels per radian at which the field of view fits the image.
                let f_px = 96.0 / fov;
                all.push(Intrinsics { distortion, fx_px: f_px, fy_px: f_px, ..k });
            }
        }
    }
    all
}

#[test]
fn does_not_cull_blocks_with_visible_splats() {
    let part = part();
    let everything: Vec<Visible> =
        (0..part.blocks.len()).map(|block| Visible { part: 0, block: block as u32 }).collect();
    let (mut projected, mut kept) = (Projected::default(), Lenses::default());
    for intrinsics in lenses() {
        let mut seen_share = 0.0;
        for turn in 0..12 {
            let turn = f64::from(turn);
            let pose: Pose<World, Cam> = Pose::new(
                DVec3::new(turn.cos(), 0.3 * turn, (2.0 * turn).sin()),
                DQuat::from_rotation_y(0.8 * turn) * DQuat::from_rotation_x(0.5 * turn),
            );
            let camera = Camera::new(intrinsics, pose, 0.05);
            let view = ObjectView::new(&camera, &kept.of(&camera), &pose);
            let mut visible = Vec::new();
            cull(0, &part, &view, 0.0, &mut visible);
            let mut is_visible = vec![false; part.blocks.len()];
            for v in &visible {
                is_visible[v.block as usize] = true;
            }
            project(Portable, std::slice::from_ref(&part), &[view], &everything, &mut projected);
            for (block, &count) in projected.counts.iter().enumerate() {
                let culled_in_view = count > 0 && !is_visible[block];
                assert!(!culled_in_view, "{camera:?}: block {block} shows {count} splats");
            }
            seen_share += visible.len() as f64 / part.blocks.len() as f64 / 12.0;
        }
        // A lens of 23 degrees sees little, but blocks here are metres across, and those next to the camera count as
        // large.
        let most = if intrinsics.distortion == Distortion::None { 0.3 } else { 0.7 };
        assert!(intrinsics.fx_px < 200.0 || seen_share < most, "{intrinsics:?} sees {seen_share}");
    }
}
