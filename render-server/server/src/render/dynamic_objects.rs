//! What moves in the twin, as images show it: the arena's objects, and every other vehicle.
//!
//! ```text
//! instant of an image, whose it is, everyone's newest motion -> a placement for each object
//! ```
//! The clock is the referee's: nanoseconds since the arena's epoch, so that what is seen is what is
//! judged. A vehicle does not see itself: it is left out of its own images. Budget: 1 us an image;
//! allocates nothing.

use vizflyt_arena::objects::MovingObjects;
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::builtin_models::{QUADROTOR, boxes};
use vizflyt_splat::{Placement, RigidObject};

use crate::poses::newest::NewestPoses;
use crate::scene::bounds_m;

/// The objects of the renderer's scene, in its order.
#[derive(Clone, Debug, Default)]
pub struct DynamicObjects {
    /// From which the objects' motions count.
    pub epoch: ServerTime,
    /// The arena's own.
    pub objects: MovingObjects,
    /// How many vehicles come after them: all, or none where one flies alone.
    pub vehicles: usize,
    /// The size of each of the arena's objects, for the page.
    pub bounds: Vec<ObjectBounds>,
}

/// The box about an object in its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObjectBounds {
    /// What images of ids hold where it is seen.
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

/// Returns the vehicles as the others see them, numbered from [`VEHICLE_ID`]; none for one alone.
pub fn vehicle_models(vehicles: usize) -> Vec<RigidObject> {
    if vehicles < 2 {
        return Vec::new();
    }
    let splats = boxes(&QUADROTOR);
    let ids = (VEHICLE_ID..).take(vehicles);
    ids.map(|id| RigidObject { id, splats: splats.clone() }).collect()
}

/// In images of ids, the first vehicle; the arena's objects have lower numbers.
pub const VEHICLE_ID: u16 = 1000;

impl DynamicObjects {
    /// Takes the arena's objects, and the vehicles if there are several.
    pub fn new(
        epoch: ServerTime,
        objects: MovingObjects,
        models: &[RigidObject],
        vehicles: usize,
    ) -> Self {
        let bounds = models.iter().take(objects.len()).map(ObjectBounds::of).collect();
        Self { epoch, objects, vehicles: if vehicles < 2 { 0 } else { vehicles }, bounds }
    }

    /// Whether nothing moves.
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty() && self.vehicles == 0
    }

    /// Returns an instant on the objects' clock. [ns]
    pub fn since_epoch_ns(&self, at: ServerTime) -> i64 {
        at.as_ns().wrapping_sub(self.epoch.as_ns()).cast_signed()
    }

    /// Appends where everything is at an instant, as vehicle `own` sees it.
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
            // No further than a motion is known: then it stands where it was last thought to be.
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
    fn a_vehicle_sees_the_others_and_the_objects_on_one_clock() {
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
        // The very pose that the referee is asked about, to the last bit.
        assert_eq!(placements[0], Some(objects.placement(0, 1_234_567)));
        let x_m = |placement: &Placement| placement.map(|pose| pose.translation_m.x);
        assert_eq!(placements[1..].iter().map(x_m).collect::<Vec<_>>(), [None, Some(2.0), None]);
        // Before the epoch, as a stamp of the past may be, the clock runs on.
        assert_eq!(moving.since_epoch_ns(ServerTime::from_ns(4_999_999_999)), -1);
        assert!(vehicle_models(1).is_empty() && DynamicObjects::default().is_empty());
    }
}
