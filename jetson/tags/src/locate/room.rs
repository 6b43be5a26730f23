//! Checks by tags of the room whether a fixed camera was moved.

use vizflyt_protocol::geometry::Pose;

use super::monitor::Linear;
use super::region::{self, Expected};
use super::{Locator, StampedImage};
use crate::camera::Mounting;
use crate::layout::LayoutFrame;
use crate::solve::{Geometry, Sighting, VehicleTwist};

impl Locator {
    /// Periodically compares the tags of the room with their expected positions in the image of a fixed camera.
    pub(super) fn look_at_room(&mut self, view: &StampedImage) {
        let wrong = self.monitor.correction(view.camera);
        let station = &mut self.stations[view.camera];
        let Mounting::World(world_from_cam) = station.camera.mounting else { return };
        let due = station.room_seen.is_none_or(|at| view.stamp.seconds_since(at) > ROOM_S);
        if !due || !self.tags.values().any(|(frame, _)| *frame == LayoutFrame::World) {
            return;
        }
        station.room_seen = Some(view.stamp);
        let room = self.tags.values().filter(|(frame, _)| *frame == LayoutFrame::World);
        let room = room.map(|(_, tag)| tag);
        let Expected::Within(region) =
            region::expect(&station.camera, room, &Pose::IDENTITY, ROOM_UNCERTAINTY_M)
        else {
            return;
        };
        let found = self.detector.look(view.image, &region, &station.camera.intrinsics);
        // The solver estimates a vehicle's pose: here the vehicle is the camera's stand, which does not move.
        let at = wrong.apply(&world_from_cam);
        let body_from_cam = Pose::new(at.translation_m, at.rotation);
        let sightings: Vec<Sighting> = found
            .iter()
            .filter_map(|seen| {
                let (frame, tag) = self.tags.get(&(seen.family, seen.id))?;
                (*frame == LayoutFrame::World).then(|| Sighting {
                    camera: &station.camera.intrinsics,
                    sight: Geometry::InsideOut {
                        body_from_cam,
                        world_from_tag: tag.frame_from_tag(),
                    },
                    size_m: tag.size_m,
                    corners_px: seen.corners_px,
                    sigma_px: self.settings.corner_sigma_px,
                    lag_s: 0.0,
                    readout_s: 0.0,
                })
            })
            .collect();
        let cameras = vec![view.camera; sightings.len()];
        let motion = VehicleTwist::default();
        let pose = Pose::IDENTITY;
        if let Some(set) = Linear::at(&sightings, &cameras, &motion, &pose, self.middle_m) {
            self.monitor.anchor(view.camera, &set);
        }
    }
}

/// Interval of checks. [s]
const ROOM_S: f64 = 0.3;
/// Position uncertainty of the room's tags, for the searched region. [m]
const ROOM_UNCERTAINTY_M: f64 = 0.1;
