//! Moving objects in images: the arena's objects, and every other vehicle.
//!
//! ```text
//! instant and vehicle of an image, newest motions of all vehicles -> a placement for each object
//! ```
//! The clock is the referee's, in nanoseconds since the arena's epoch, so that images and referee agree. A
//! vehicle does not appear in its own images. Budget: 1 us an image; no allocation.

use vizflyt_arena::objects::MovingObjects;
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::builtin_models::{QUADROTOR, boxes};
use vizflyt_splat::{Placement, RigidObject};

use crate::poses::newest::NewestPoses;
use crate::scene::bounds_m;

/// Moving objects of the renderer's scene, in its order.
#[derive(Clone, Debug, Default)]
pub struct DynamicObjects {
    /// Start of the objects' motions.
    pub epoch: ServerTime,
    /// Objects of the arena.
    pub objects: MovingObjects,
    /// Number of vehicles after the objects: all, or none if only one flies.
    pub vehicles: usize,
    /// Size of each of the arena's objects, for the page.
    pub bounds: Vec<ObjectBounds>,
}

/// Bounding box of an object in its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObjectBounds {
    /// Value in images of ids.
    pub id: u16,
    /// Least corner. [m, object]
    pub min_m: [f32; 3],
    /// Greatest corner. [m, object]
    pub max_m: [f32; 3],
}

impl ObjectBounds {
    fn of(object: &RigidObject) -> Self {
        let (min_m, max_m) = bounds_m(&object.splats);
        Self { id: object.id, min_m: min_m.to_array(), max_m: max_m.to_array() }
    }
}

/// Returns the models of the vehicles, numbered from [`VEHICLE_ID`]; none for a single vehicle.
pub fn vehicle_models(vehicles: usize) -> Vec<RigidObject> {
    if vehicles < 2 {
        return Vec::new();
    }
    let splats = boxes(&QUADROTOR);
    let ids = (VEHICLE_ID..).take(vehicles);
    ids.map(|id| RigidObject { id, splats: splats.clone() }).collect()
}

/// Id of the first vehicle in images of ids; the arena's objects have lower ids.
pub const VEHICLE_ID: u16 = 1000;

impl DynamicObjects {
    /// Creates the arena's objects, and the vehicles if there are several.
    pub fn new(
        epoch: ServerTime,
        objects: MovingObjects,
        models: &[RigidObject],
        vehicles: usize,
    ) -> Self {
        let bounds = models.iter().take(objects.len()).map(ObjectBounds::of).collect();
        Self { epoch, objects, vehicles: if vehicles < 2 { 0 } else { vehicles }, bounds }
    }

    /// Returns whether there are no moving objects.
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty() && self.vehicles == 0
    }

    /// Returns a time on the objects' clock. [ns]
    pub fn since_epoch_ns(&self, at: ServerTime) -> i64 {
        at.as_ns().wrapping_sub(self.epoch.as_ns()).cast_signed()
    }

    /// Appends the placements of all objects at an instant, as seen by vehicle `own`.
    pub fn place(
        &self,
        at: ServerTime,
        own: usize,
        known: &NewestPoses,
        placements: &mut Vec<Placement>,
    ) {
        self.objects.place(self.since_epoch_ns(at), placements);
        placements.extend(known.iter().enumerate().take(self.vehicles).map(|(index, known)| {
            let there = known.as_ref().filter(|_| index != own)?;
            // Limited to the time for which the motion is predicted; then the vehicle stays at its last
            // predicted pose.
            let body = there.motion.at(there.motion.reach(at));
            Some(Pose::new(body.translation_m, body.rotation))
        }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::poses::newest::Localized;
    use glam::{DQuat, DVec3};
    use vizflyt_arena::config::{MotionConfig, ObjectConfig};
    use vizflyt_protocol::messages::PoseSample;

    #[test]
    fn vehicles_see_others_and_objects_on_the_referees_clock() {
        let hand = ObjectConfig {
            name: "hand".into(),
            scene: "hand.ply".into(),
            position_m: DVec3::ZERO,
            yaw_deg: 0.0,
            phase_s: Some(0.25),
            motion: Some(MotionConfig::Rotation { axis: DVec3::X, period_s: 4.0 }),
        };
        let objects = MovingObjects::of(&[hand], 0);
        let epoch = ServerTime::from_ns(5_000_000_000);
        let models = vehicle_models(3);
        assert_eq!(models.iter().map(|model| model.id).collect::<Vec<_>>(), [1000, 1001, 1002]);
        let moving = DynamicObjects::new(epoch, objects.clone(), &[], 3);
        let at = epoch.plus_ns(1_234_567);
        let mut known = NewestPoses::default();
        for (index, x_m) in [(0, 1.0), (1, 2.0)] {
            let pose = Pose::new(DVec3::X * x_m, DQuat::IDENTITY);
            known[index] = Some(Localized::still(PoseSample::still(at, pose)));
        }
        let mut placements = Vec::new();
        moving.place(at, 0, &known, &mut placements);
        // Bit for bit the pose of the referee.
        assert_eq!(placements[0], Some(objects.placement(0, 1_234_567)));
        let x_m = |placement: &Placement| placement.map(|pose| pose.translation_m.x);
        assert_eq!(placements[1..].iter().map(x_m).collect::<Vec<_>>(), [None, Some(2.0), None]);
        // Before the epoch, as for an earlier stamp, the clock continues.
        assert_eq!(moving.since_epoch_ns(ServerTime::from_ns(4_999_999_999)), -1);
        assert!(vehicle_models(1).is_empty() && DynamicObjects::default().is_empty());
    }
}
