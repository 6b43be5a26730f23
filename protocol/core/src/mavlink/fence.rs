//! Polygons of an autopilot's fence in the mission protocol (MAVLink, "Mission Protocol", MAV_MISSION_TYPE_FENCE): one
//! item per corner, in global coordinates.

// Why: ArduCopter uses MAV_FRAME_GLOBAL and MISSION_REQUEST, although the dialect deprecates them.
#![allow(deprecated)]

use glam::DVec2;

use super::dialect::{
    MISSION_ITEM_INT_DATA, MavCmd, MavFrame, MavMessage, MavMissionResult, MavMissionType,
};

/// Geographic position in MAVLink's integer units. [1e-7 deg]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GlobalPoint {
    /// Latitude, positive north. [1e-7 deg]
    pub latitude_e7: i32,
    /// Longitude, positive east. [1e-7 deg]
    pub longitude_e7: i32,
}

impl GlobalPoint {
    /// Returns the position `p_world_m` east and north of `self`, the origin of the local frame. Accurate at the size
    /// of a room, where the globe is flat. [m, world]
    ///
    /// ```
    /// use glam::DVec2;
    /// use vizflyt_protocol::mavlink::GlobalPoint;
    /// let origin = GlobalPoint { latitude_e7: -353_632_621, longitude_e7: 1_491_652_374 };
    /// let corner = origin.offset(DVec2::new(11.0, 4.5));
    /// assert_eq!((corner.latitude_e7, corner.longitude_e7), (-353_632_217, 1_491_653_586));
    /// assert!((corner.from_origin_m(origin) - DVec2::new(11.0, 4.5)).length() < 0.01);
    /// ```
    #[must_use]
    pub fn offset(self, p_world_m: DVec2) -> Self {
        // Saturates: positions beyond the globe are invalid anyway.
        let moved = |from: i32, by: f64| (f64::from(from) + libm::round(by)) as i32;
        let (east_m, north_m) = (p_world_m.x, p_world_m.y);
        Self {
            latitude_e7: moved(self.latitude_e7, north_m / METRES_PER_UNIT),
            longitude_e7: moved(self.longitude_e7, east_m / METRES_PER_UNIT / self.shrink()),
        }
    }

    /// Returns this position relative to `origin`, east and north. [m, world]
    pub fn from_origin_m(self, origin: Self) -> DVec2 {
        let apart = |a: i32, b: i32| f64::from(a) - f64::from(b);
        let east_m = apart(self.longitude_e7, origin.longitude_e7) * origin.shrink();
        let north_m = apart(self.latitude_e7, origin.latitude_e7);
        DVec2::new(east_m, north_m) * METRES_PER_UNIT
    }

    /// Length of a degree of longitude relative to a degree of latitude.
    fn shrink(self) -> f64 {
        libm::cos((f64::from(self.latitude_e7) * 1e-7).to_radians()).max(1e-3)
    }
}

/// Side of a polygon on which the vehicle must stay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FenceSide {
    /// Inclusion: inside the polygon.
    Inside,
    /// Exclusion: outside the polygon.
    Outside,
}

/// Corner of a polygon. Corners of one polygon are consecutive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FenceCorner {
    /// Side of the polygon for the vehicle.
    pub side: FenceSide,
    /// Number of corners of the polygon.
    pub corners: u16,
    /// Position of the corner.
    pub place: GlobalPoint,
}

/// Returns the mission item number `seq` for a corner, for `target`.
pub fn fence_corner_to_mavlink(
    corner: &FenceCorner,
    seq: u16,
    (target_system, target_component): (u8, u8),
) -> MISSION_ITEM_INT_DATA {
    MISSION_ITEM_INT_DATA {
        param1: f32::from(corner.corners),
        x: corner.place.latitude_e7,
        y: corner.place.longitude_e7,
        seq,
        command: match corner.side {
            FenceSide::Inside => MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION,
            FenceSide::Outside => MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
        },
        target_system,
        target_component,
        frame: MavFrame::MAV_FRAME_GLOBAL,
        mission_type: MavMissionType::MAV_MISSION_TYPE_FENCE,
        ..Default::default()
    }
}

/// Returns the corner of a mission item.
///
/// # Errors
/// Returns ArduCopter's result for an item that it does not accept: another command, a frame that is not global, or an
/// invalid number of corners.
pub fn fence_corner_from_mavlink(
    item: &MISSION_ITEM_INT_DATA,
) -> Result<FenceCorner, MavMissionResult> {
    if !matches!(item.frame, MavFrame::MAV_FRAME_GLOBAL | MavFrame::MAV_FRAME_GLOBAL_INT) {
        return Err(MavMissionResult::MAV_MISSION_UNSUPPORTED_FRAME);
    }
    let side = match item.command {
        MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION => FenceSide::Inside,
        MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION => FenceSide::Outside,
        _ => return Err(MavMissionResult::MAV_MISSION_UNSUPPORTED),
    };
    if !(item.param1 >= 3.0 && item.param1 <= MAX_CORNERS) {
        return Err(MavMissionResult::MAV_MISSION_INVALID_PARAM1);
    }
    let place = GlobalPoint { latitude_e7: item.x, longitude_e7: item.y };
    Ok(FenceCorner { side, corners: item.param1 as u16, place })
}

/// Returns the number of the fence item that an autopilot requests; `None` for any other message. ArduCopter sends
/// MISSION_REQUEST, PX4 sends MISSION_REQUEST_INT.
pub fn fence_request_from_mavlink(message: &MavMessage) -> Option<u16> {
    let (seq, kind) = match message {
        MavMessage::MISSION_REQUEST_INT(request) => (request.seq, request.mission_type),
        MavMessage::MISSION_REQUEST(request) => (request.seq, request.mission_type),
        _ => return None,
    };
    (kind == MavMissionType::MAV_MISSION_TYPE_FENCE).then_some(seq)
}

/// Returns an autopilot's result for a fence as text.
pub fn mission_result_name(result: MavMissionResult) -> &'static str {
    match result {
        MavMissionResult::MAV_MISSION_ACCEPTED => "accepted",
        MavMissionResult::MAV_MISSION_UNSUPPORTED_FRAME => "it does not support the frame",
        MavMissionResult::MAV_MISSION_UNSUPPORTED => "it does not support polygons",
        MavMissionResult::MAV_MISSION_NO_SPACE => "it has no space for this many corners",
        MavMissionResult::MAV_MISSION_INVALID_SEQUENCE => "items arrived in the wrong order",
        MavMissionResult::MAV_MISSION_DENIED => "another program is writing it",
        MavMissionResult::MAV_MISSION_OPERATION_CANCELLED => "the upload was cancelled",
        _ => "it rejects a polygon as invalid",
    }
}

/// Length of one unit of latitude, as in ArduPilot (Location.h, LOCATION_SCALING_FACTOR): an arc of 1e-7 degrees on a
/// globe of 6378.1 km. [m]
const METRES_PER_UNIT: f64 = 0.011_131_884_502_145_034;
/// ArduPilot stores the number of corners in one byte.
const MAX_CORNERS: f32 = 255.0;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn accepts_only_polygon_corners_in_global_frames() {
        let place = GlobalPoint { latitude_e7: 1, longitude_e7: 2 };
        let corner = FenceCorner { side: FenceSide::Outside, corners: 4, place };
        let item = || fence_corner_to_mavlink(&corner, 3, (1, 1));
        assert_eq!(fence_corner_from_mavlink(&item()), Ok(corner));
        let check = |change: fn(&mut MISSION_ITEM_INT_DATA), expected| {
            let mut item = item();
            change(&mut item);
            assert_eq!(fence_corner_from_mavlink(&item), Err(expected));
        };
        let frame = MavMissionResult::MAV_MISSION_UNSUPPORTED_FRAME;
        check(|item| item.frame = MavFrame::MAV_FRAME_LOCAL_NED, frame);
        let circle = MavMissionResult::MAV_MISSION_UNSUPPORTED;
        check(|item| item.command = MavCmd::MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION, circle);
        let corners = MavMissionResult::MAV_MISSION_INVALID_PARAM1;
        check(|item| item.param1 = 2.0, corners);
        check(|item| item.param1 = f32::NAN, corners);
        check(|item| item.param1 = 1e9, corners);
    }

    proptest! {
        #[test]
        fn offsets_are_accurate_to_a_centimetre(
            latitude_e7 in -800_000_000..800_000_000, longitude_e7 in -1_790_000_000..1_790_000_000,
            x in -50.0..50.0, y in -50.0..50.0,
        ) {
            let origin = GlobalPoint { latitude_e7, longitude_e7 };
            let p_m = DVec2::new(x, y);
            let back_m = origin.offset(p_m).from_origin_m(origin);
            prop_assert!((back_m - p_m).length() < 0.01, "{back_m}");
        }

        #[test]
        fn corners_survive_the_wire(x: i32, y: i32, corners in 3_u16..=255, is_inside: bool, seq: u16) {
            let side = if is_inside { FenceSide::Inside } else { FenceSide::Outside };
            let place = GlobalPoint { latitude_e7: x, longitude_e7: y };
            let corner = FenceCorner { side, corners, place };
            let item = fence_corner_to_mavlink(&corner, seq, (1, 1));
            prop_assert_eq!(fence_corner_from_mavlink(&item), Ok(corner));
            prop_assert_eq!(item.seq, seq);
        }
    }
}
