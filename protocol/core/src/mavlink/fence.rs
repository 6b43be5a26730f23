//! Polygons of an autopilot's fence, as the mission protocol carries them (MAVLink, "Mission Protocol",
//! MAV_MISSION_TYPE_FENCE): one item for each corner, on the globe.

// Why: MAV_FRAME_GLOBAL and MISSION_REQUEST are what ArduCopter speaks, whatever the dialect advises.
#![allow(deprecated)]

use glam::DVec2;

use super::dialect::{
    MISSION_ITEM_INT_DATA, MavCmd, MavFrame, MavMessage, MavMissionResult, MavMissionType,
};

/// A place on the globe, in the whole numbers of MAVLink. [1e-7 deg]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GlobalPoint {
    /// North of the equator. [1e-7 deg]
    pub latitude_e7: i32,
    /// East of Greenwich. [1e-7 deg]
    pub longitude_e7: i32,
}

impl GlobalPoint {
    /// Returns the place that is `p_world_m` east and north of `self`, the local frame's origin; good
    /// for a room, where the globe is flat. [m, world]
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
        // Saturates: whoever asks for a place beyond the globe gets none of sense.
        let moved = |from: i32, by: f64| (f64::from(from) + libm::round(by)) as i32;
        let (east_m, north_m) = (p_world_m.x, p_world_m.y);
        Self {
            latitude_e7: moved(self.latitude_e7, north_m / METRES_PER_UNIT),
            longitude_e7: moved(self.longitude_e7, east_m / METRES_PER_UNIT / self.shrink()),
        }
    }

    /// Returns how far east and north of `origin` this place is. [m, world]
    pub fn from_origin_m(self, origin: Self) -> DVec2 {
        let apart = |a: i32, b: i32| f64::from(a) - f64::from(b);
        let east_m = apart(self.longitude_e7, origin.longitude_e7) * origin.shrink();
        let north_m = apart(self.latitude_e7, origin.latitude_e7);
        DVec2::new(east_m, north_m) * METRES_PER_UNIT
    }

    /// How much shorter a degree of longitude is than one of latitude.
    fn shrink(self) -> f64 {
        libm::cos((f64::from(self.latitude_e7) * 1e-7).to_radians()).max(1e-3)
    }
}

/// Which side of a polygon a vehicle must keep to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FenceSide {
    /// Inclusion: within.
    Inside,
    /// Exclusion: out of it.
    Outside,
}

/// A corner of a polygon; those of one polygon follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FenceCorner {
    /// What its polygon is for.
    pub side: FenceSide,
    /// How many corners its polygon has.
    pub corners: u16,
    /// Where it is.
    pub place: GlobalPoint,
}

/// Returns the mission item of a corner, the `seq`-th of all, for `target`.
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

/// Returns the corner that a mission item is.
///
/// # Errors
/// The answer of ArduCopter's to an item that it cannot take: another command, a frame that is not the
/// globe's, a number of corners that is none.
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

/// Returns which item of the fence an autopilot asks for, by either form of the request; `None` for
/// any other message. ArduCopter sends MISSION_REQUEST, PX4 MISSION_REQUEST_INT.
pub fn fence_request_from_mavlink(message: &MavMessage) -> Option<u16> {
    let (seq, kind) = match message {
        MavMessage::MISSION_REQUEST_INT(request) => (request.seq, request.mission_type),
        MavMessage::MISSION_REQUEST(request) => (request.seq, request.mission_type),
        _ => return None,
    };
    (kind == MavMissionType::MAV_MISSION_TYPE_FENCE).then_some(seq)
}

/// Returns what an autopilot made of a fence, in words.
pub fn mission_result_name(result: MavMissionResult) -> &'static str {
    match result {
        MavMissionResult::MAV_MISSION_ACCEPTED => "accepted",
        MavMissionResult::MAV_MISSION_UNSUPPORTED_FRAME => "it does not know the frame",
        MavMissionResult::MAV_MISSION_UNSUPPORTED => "it does not know polygons",
        MavMissionResult::MAV_MISSION_NO_SPACE => "it has no room for as many corners",
        MavMissionResult::MAV_MISSION_INVALID_SEQUENCE => "items came in the wrong order",
        MavMissionResult::MAV_MISSION_DENIED => "another program is writing it",
        MavMissionResult::MAV_MISSION_OPERATION_CANCELLED => "the upload was cancelled",
        _ => "it finds a polygon invalid",
    }
}

/// One unit of latitude, as ArduPilot has it (Location.h, LOCATION_SCALING_FACTOR): an arc of 1e-7
/// degrees on a globe of 6378.1 km. [m]
const METRES_PER_UNIT: f64 = 0.011_131_884_502_145_034;
/// ArduPilot counts a polygon's corners in a byte.
const MAX_CORNERS: f32 = 255.0;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn only_corners_on_the_globe_are_taken() {
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
        fn a_room_comes_back_to_a_centimetre(
            latitude_e7 in -800_000_000..800_000_000, longitude_e7 in -1_790_000_000..1_790_000_000,
            x in -50.0..50.0, y in -50.0..50.0,
        ) {
            let origin = GlobalPoint { latitude_e7, longitude_e7 };
            let p_m = DVec2::new(x, y);
            let back_m = origin.offset(p_m).from_origin_m(origin);
            prop_assert!((back_m - p_m).length() < 0.01, "{back_m}");
        }

        #[test]
        fn an_item_comes_back(x: i32, y: i32, corners in 3_u16..=255, is_inside: bool, seq: u16) {
            let side = if is_inside { FenceSide::Inside } else { FenceSide::Outside };
            let place = GlobalPoint { latitude_e7: x, longitude_e7: y };
            let corner = FenceCorner { side, corners, place };
            let item = fence_corner_to_mavlink(&corner, seq, (1, 1));
            prop_assert_eq!(fence_corner_from_mavlink(&item), Ok(corner));
            prop_assert_eq!(item.seq, seq);
        }
    }
}
