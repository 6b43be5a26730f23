//! Descriptions of poses and motions for users.

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Pose, World};

/// Describes position and heading of a vehicle.
pub fn describe_pose(pose: &Pose<World, Body>) -> String {
    let p = pose.translation_m;
    format!(
        "nose points {}, up is {}, drone is {:.2} m above the floor, at x {:.2}, y {:.2}",
        direction(pose.rotate(DVec3::X)),
        direction(pose.rotate(DVec3::Z)),
        p.z,
        p.x,
        p.y
    )
}

/// Returns the axis nearest to a direction, and the angle to it.
pub fn direction(v: DVec3) -> String {
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let names = ["x", "y", "z"];
    let (mut best, mut name) = (f64::NEG_INFINITY, String::new());
    for (axis, axis_name) in axes.into_iter().zip(names) {
        for (sign, text) in [(1.0, "+"), (-1.0, "-")] {
            let along = v.dot(axis) * sign;
            if along > best {
                best = along;
                name = format!("{text}{axis_name}");
            }
        }
    }
    let off_deg = (best / v.length().max(f64::MIN_POSITIVE)).clamp(-1.0, 1.0).acos().to_degrees();
    if off_deg < 5.0 { name } else { format!("{name} ({off_deg:.0} degrees off)") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    #[test]
    fn describes_a_pose() {
        let pose = Pose::new(DVec3::new(1.0, 2.0, 1.02), DQuat::IDENTITY);
        assert_eq!(
            describe_pose(&pose),
            "nose points +x, up is +z, drone is 1.02 m above the floor, at x 1.00, y 2.00"
        );
        assert_eq!(direction(DVec3::new(0.0, -1.0, 0.02)), "-y");
        let tilted = DQuat::from_rotation_z(20f64.to_radians()) * DVec3::X;
        assert_eq!(direction(tilted), "+x (20 degrees off)");
    }
}
