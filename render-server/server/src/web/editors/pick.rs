//! Point of the scene at a click: fits one surface to the depths of a small window around it.
//!
//! ```text
//! Request, pixel -> window of 21x21 depths -> plane in 1/z, by majority -> point, and roughness of the surface
//! ```
//! 1/z of a plane is affine in pixels, so the fit also works for a floor at a grazing angle. Sky, holes and edges are
//! rejected: a point between two surfaces lies on neither.

use glam::{DMat3, DVec2, DVec3};
use serde::Serialize;
use vizflyt_protocol::geometry::Intrinsics;

/// Result of a click.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Picked {
    /// Position in the axes and units of the scene's file.
    pub p_scene: DVec3,
    /// Position in the shown world. [m, world]
    pub p_world: DVec3,
    /// Distance ahead. [m, cam]
    pub depth_m: f64,
    /// Roughness of the surface around it, root mean square along the line of sight. [m]
    pub rough_m: f64,
}

/// Reason for which a click found no point.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub(super) enum PickError {
    /// The click is outside the image, or the camera is invalid.
    #[error("the click lies outside the picture; click again")]
    Outside,
    /// Sky, or a hole in the capture.
    #[error("nothing solid is there: sky, or a hole in the capture; click on a surface")]
    Nothing,
    /// Two surfaces at these distances. [m]
    #[error(
        "the click lies on an edge, between {near_m:.2} and {far_m:.2} m ahead; click a little inside, or narrow the view \
         and click again"
    )]
    Edge {
        /// Distance of the nearer surface. [m, cam]
        near_m: f64,
        /// Distance of the farther surface. [m, cam]
        far_m: f64,
    },
}

/// Returns the camera of the window around a pixel, and the pixel in it; `None` outside the image.
pub(super) fn window(picture: &Intrinsics, px: DVec2) -> Option<(Intrinsics, DVec2)> {
    let size = DVec2::new(f64::from(picture.width_px), f64::from(picture.height_px));
    if !(px.cmpge(DVec2::ZERO).all() && px.cmplt(size).all()) {
        return None;
    }
    let corner = px.floor() - f64::from(SIDE_PX / 2);
    let window = Intrinsics {
        width_px: SIDE_PX,
        height_px: SIDE_PX,
        cx_px: picture.cx_px - corner.x,
        cy_px: picture.cy_px - corner.y,
        ..*picture
    };
    Some((window, px - corner))
}

/// Returns depth [m, cam] and roughness [m] of the surface at a pixel of a window.
///
/// # Errors
/// If nothing is there, or the click is on an edge.
pub(super) fn surface(depths_m: &[f32], px: DVec2) -> Result<(f64, f64), PickError> {
    let side = SIDE_PX as usize;
    let seen: Vec<(DVec3, f64)> = depths_m
        .iter()
        .enumerate()
        .filter(|(_, depth_m)| **depth_m > 0.0)
        .map(|(k, &depth_m)| {
            let middle = DVec2::new((k % side) as f64, (k / side) as f64) + 0.5 - px;
            // Scales pixels by ten, to condition the normal equations.
            ((middle / 10.0).extend(1.0), 1.0 / f64::from(depth_m))
        })
        .collect();
    let needed = MAJORITY * depths_m.len() as f64;
    if (seen.len() as f64) < needed {
        return Err(PickError::Nothing);
    }
    let mut kept = seen.clone();
    let mut plane = DVec3::ZERO;
    for _ in 0..ROUNDS {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (at, inverse) in &kept {
            normal += DMat3::from_cols(*at * at.x, *at * at.y, *at * at.z);
            right += *at * *inverse;
        }
        plane = normal.inverse() * right;
        let off = |(at, inverse): &(DVec3, f64)| (plane.dot(*at) - inverse).abs() / inverse;
        let mut offs: Vec<f64> = seen.iter().map(off).collect();
        offs.sort_by(f64::total_cmp);
        let typical = offs[offs.len() / 2];
        kept = seen.iter().copied().filter(|one| off(one) <= (3.0 * typical).min(ROUGH)).collect();
        if kept.len() < ENOUGH {
            break;
        }
    }
    let inverse = plane.z;
    if (kept.len() as f64) < needed || !(inverse > 0.0) {
        let mut all: Vec<f64> = seen.iter().map(|(_, inverse)| 1.0 / inverse).collect();
        all.sort_by(f64::total_cmp);
        let tenth = all.len() / 10;
        return Err(PickError::Edge { near_m: all[tenth], far_m: all[all.len() - 1 - tenth] });
    }
    let squares: f64 = kept.iter().map(|(at, w)| ((plane.dot(*at) - w) / w).powi(2)).sum();
    let depth_m = 1.0 / inverse;
    Ok((depth_m, depth_m * (squares / kept.len() as f64).sqrt()))
}

/// About the size of a fingertip on a screen.
const SIDE_PX: u32 = 21;
/// Minimum share of the window on one surface.
const MAJORITY: f64 = 0.7;
/// Maximum deviation from the plane, as a share of the distance. A captured floor is smoother; other surfaces are
/// farther away.
const ROUGH: f64 = 0.03;
const ROUNDS: usize = 5;
/// Minimum number of points for a plane.
const ENOUGH: usize = 20;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const MIDDLE: DVec2 = DVec2::new(10.3, 10.8);

    /// Returns the depths of a window from a function of the offset from its centre.
    fn depths(at: impl Fn(f64, f64) -> f64) -> Vec<f32> {
        let side = SIDE_PX as usize;
        (0..side * side)
            .map(|k| {
                let px = DVec2::new((k % side) as f64, (k / side) as f64) + 0.5 - MIDDLE;
                at(px.x, px.y) as f32
            })
            .collect()
    }

    proptest! {
        /// Any noisy plane, also a steep one, returns its depth at the click.
        #[test]
        fn a_surface_gives_its_depth(
            depth_m in 0.2..50.0f64, x in -0.01..0.01f64, y in -0.02..0.02f64, seed in 0.0..9.0f64,
        ) {
            let noise = |u: f64, v: f64| 0.01 * ((u * 12.9898 + v * 78.233 + seed).sin() * 43758.5).fract();
            let window = depths(|u, v| depth_m / (1.0 + x * u + y * v) * (1.0 + noise(u, v)));
            let (found_m, rough_m) = surface(&window, MIDDLE).unwrap();
            prop_assert!((found_m / depth_m - 1.0).abs() < 0.004, "{found_m} {depth_m}");
            prop_assert!(rough_m < 0.02 * depth_m);
        }

        #[test]
        fn no_window_panics(window in prop::collection::vec(
            prop_oneof![Just(0.0f32), Just(1e-30), Just(f32::MAX), Just(f32::NAN), 0.1..9.0f32],
            (SIDE_PX * SIDE_PX) as usize,
        )) {
            if let Ok((depth_m, rough_m)) = surface(&window, MIDDLE) {
                prop_assert!(depth_m.is_finite() && rough_m.is_finite());
            }
        }
    }

    #[test]
    fn sky_and_edges_are_rejected_with_the_reason() {
        assert_eq!(surface(&depths(|_, _| 0.0), MIDDLE), Err(PickError::Nothing));
        let rim = depths(|u, _| if u < 0.0 { 2.0 } else { 0.0 });
        assert_eq!(surface(&rim, MIDDLE), Err(PickError::Nothing));
        for share in [-4.0, 0.0, 3.0] {
            let edge = surface(&depths(|u, _| if u < share { 2.0 } else { 5.0 }), MIDDLE);
            let Err(PickError::Edge { near_m, far_m }) = edge else { panic!("{edge:?}") };
            assert!((near_m - 2.0).abs() < 0.1 && (far_m - 5.0).abs() < 0.1, "{edge:?}");
        }
        // A wire in front of a wall is not an edge: the wall has the majority.
        let wire = depths(|u, _| if (3.0..5.0).contains(&u) { 1.0 } else { 3.0 });
        assert!((surface(&wire, MIDDLE).unwrap().0 - 3.0).abs() < 0.01);
    }

    #[test]
    fn the_window_has_the_same_rays_as_the_image() {
        let picture = Intrinsics::from_horizontal_fov(640, 480, 1.2);
        let click = DVec2::new(100.25, 300.5);
        let (small, px) = window(&picture, click).unwrap();
        let ray = picture.slope(click).unwrap();
        assert!((small.slope(px).unwrap() - ray).length() < 1e-12);
        for outside in [DVec2::new(-1.0, 5.0), DVec2::new(640.0, 5.0), DVec2::new(f64::NAN, 5.0)] {
            assert_eq!(window(&picture, outside), None);
        }
    }
}
