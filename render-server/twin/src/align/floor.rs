//! Alignment by manually selected points: three or more points of the floor, and a measured length.

use glam::{DQuat, DVec3};

use super::eigen::symmetric;
use super::{AlignError, Fit, Similarity};

/// Points selected by a person, in the scene's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Floor {
    /// At least three points of the floor. The first becomes the world's origin; the second lies on its x axis.
    pub points: Vec<DVec3>,
    /// A point above the floor, for example the centroid of the cameras.
    pub above: DVec3,
    /// End points of the known length.
    pub length: [DVec3; 2],
    /// Known length. [m]
    pub length_m: f64,
    /// Standard deviation of the known length. [m]
    pub length_sigma_m: f64,
    /// Standard deviation of a selected point. [m]
    pub click_sigma_m: f64,
}

/// Aligns the scene: floor at z = 0, first point at the origin.
///
/// # Errors
/// Too few points, points on one line, a zero length, or an ambiguous upward direction.
pub fn fit(floor: &Floor) -> Result<Fit, AlignError> {
    let Floor { points, above, length, length_m, length_sigma_m, click_sigma_m } = floor;
    if points.len() < NEEDED {
        return Err(AlignError::TooFew { given: points.len(), needed: NEEDED });
    }
    for (name, value) in [
        ("the known length", *length_m),
        ("the accuracy of the known length", *length_sigma_m),
        ("the accuracy of a click", *click_sigma_m),
    ] {
        if !(value > 0.0 && value.is_finite()) {
            return Err(AlignError::BadNumber(name));
        }
    }
    if points.iter().chain(length).chain([above]).any(|p| !p.is_finite()) {
        return Err(AlignError::BadNumber("a point's coordinate"));
    }
    let count = points.len() as f64;
    let middle = points.iter().sum::<DVec3>() / count;
    let mut scatter = [[0.0; 3]; 3];
    for p in points.iter().map(|p| p - middle) {
        for (row, sums) in scatter.iter_mut().enumerate() {
            for (column, sum) in sums.iter_mut().enumerate() {
                *sum += p[row] * p[column];
            }
        }
    }
    let [(_, normal), (second, _), (first, _)] = symmetric(scatter);
    if !(second > (LINE_SHARE * LINE_SHARE) * first) {
        return Err(AlignError::OnOneLine);
    }
    let extent = length[0].distance(length[1]);
    if !(extent > 0.0) {
        return Err(AlignError::NoLength);
    }
    let scale = length_m / extent;
    let normal = DVec3::from_array(normal);
    let height = normal.dot(above - middle);
    if !(height.abs() * scale > ABOVE_M) {
        return Err(AlignError::FloorAmbiguous);
    }
    let up = normal * height.signum();
    // Level the scene, then rotate it until the second point lies on the x axis.
    let level = DQuat::from_rotation_arc(up, DVec3::Z);
    let ahead = level * (points[1] - points[0]);
    let rotation = DQuat::from_rotation_z(-ahead.y.atan2(ahead.x)) * level;
    let off = |p: DVec3| up.dot(p - middle);
    let origin = points[0] - up * off(points[0]);
    let world_from_scene =
        Similarity { scale, rotation, translation_m: -(rotation * origin * scale) };

    let off_m: Vec<f64> = points.iter().map(|p| off(*p).abs() * scale).collect();
    let squares: f64 = off_m.iter().map(|m| m * m).sum();
    // A plane has three parameters: three points leave no residual to estimate the accuracy from.
    let found_m = if points.len() > NEEDED { (squares / (count - 3.0)).sqrt() } else { 0.0 };
    let click_m = found_m.max(*click_sigma_m);
    let reach_m = scale * ahead.truncate().length();
    Ok(Fit {
        world_from_scene,
        rms_m: (squares / count).sqrt(),
        worst_m: off_m.iter().copied().fold(0.0, f64::max),
        used: points.len(),
        left_out: 0,
        scale_sigma: (length_sigma_m.powi(2) + 2.0 * click_m.powi(2)).sqrt() / length_m,
        // The points' shorter extent determines the tilt about their longer axis.
        tilt_sigma_rad: click_m / (scale * second.sqrt()),
        yaw_sigma_rad: std::f64::consts::SQRT_2 * click_m / reach_m.max(click_m),
        place_sigma_m: click_m,
        middle_m: world_from_scene.transform_point(middle),
    })
}

/// Minimum number of floor points.
const NEEDED: usize = 3;
/// Limit of [`super::points`].
const LINE_SHARE: f64 = 0.02;
/// Minimum height of `above` over the floor. [m]
const ABOVE_M: f64 = 0.05;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::tests_support::{gauss, similarity};
    use proptest::prelude::*;

    fn back(truth: &Similarity, p_m: DVec3) -> DVec3 {
        truth.rotation.conjugate() * (p_m - truth.translation_m) / truth.scale
    }

    fn room(truth: &Similarity) -> Floor {
        let scene = |x: f64, y: f64, z: f64| back(truth, DVec3::new(x, y, z));
        Floor {
            points: vec![scene(0.0, 0.0, 0.0), scene(4.0, 0.0, 0.0), scene(1.0, 3.0, 0.0)],
            above: scene(2.0, 1.0, 1.5),
            length: [scene(1.0, 1.0, 0.0), scene(1.0, 1.0, 2.0)],
            length_m: 2.0,
            length_sigma_m: 0.002,
            click_sigma_m: 0.01,
        }
    }

    proptest! {
        #[test]
        fn exact_clicks_give_the_exact_alignment(truth in similarity()) {
            let fit = fit(&room(&truth)).unwrap();
            for p_m in [DVec3::new(3.0, 2.0, 1.0), DVec3::new(-1.0, 0.5, 2.5)] {
                let found_m = fit.world_from_scene.transform_point(back(&truth, p_m));
                prop_assert!(found_m.distance(p_m) < 1e-7, "{found_m} {p_m}");
            }
        }
    }

    #[test]
    fn bounds_hold_for_inaccurate_clicks() {
        let mut random = crate::random::Random::new(9);
        let truth = Similarity {
            scale: 0.17,
            rotation: DQuat::from_scaled_axis(DVec3::new(1.4, 0.3, -0.2)),
            translation_m: DVec3::new(1.0, -2.0, 0.4),
        };
        let mut outside = 0;
        for _ in 0..500 {
            let mut floor = room(&truth);
            for p in floor.points.iter_mut().chain(&mut floor.length) {
                *p += gauss(&mut random) * (0.01 / truth.scale);
            }
            let fit = fit(&floor).unwrap();
            let corner = DVec3::new(5.0, 4.0, 3.0);
            let found = fit.world_from_scene.transform_point(back(&truth, corner));
            outside += usize::from(found.distance(corner) > fit.bound_m(corner));
        }
        assert!(outside <= 10, "{outside} of 500 beyond the bound");
    }

    #[test]
    fn rejects_invalid_input() {
        let still =
            Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };
        let good = room(&still);
        let refused = |change: &dyn Fn(&mut Floor)| {
            let mut floor = good.clone();
            change(&mut floor);
            fit(&floor).unwrap_err()
        };
        assert_eq!(refused(&|f| f.points[2] = DVec3::new(9.0, 0.0, 0.0)), AlignError::OnOneLine);
        assert_eq!(refused(&|f| f.above.z = 0.01), AlignError::FloorAmbiguous);
        assert_eq!(refused(&|f| f.length[1] = f.length[0]), AlignError::NoLength);
        assert_eq!(refused(&|f| f.points.truncate(2)), AlignError::TooFew { given: 2, needed: 3 });
        assert!(matches!(refused(&|f| f.length_m = -1.0), AlignError::BadNumber(_)));
        assert!(matches!(refused(&|f| f.above.x = f64::NAN), AlignError::BadNumber(_)));
    }
}
