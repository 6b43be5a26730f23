//! Fence polygons over the mission protocol, as in ArduCopter (MissionItemProtocol.cpp, AC_PolyFence_loader.cpp): it
//! requests one item after the other, accepts all or nothing, and stores the fence over a reboot. Circles, return
//! points, missions and rally points are not simulated and are refused.

use glam::DVec2;
use vizflyt_protocol::mavlink::{
    FenceCorner, FenceSide, GlobalPoint, fence_corner_from_mavlink, fence_corner_to_mavlink,
};
use vizflyt_protocol::time::AutopilotTime;

use super::Autopilot;
use super::dialect::{
    MISSION_ACK_DATA, MISSION_COUNT_DATA, MISSION_ITEM_INT_DATA, MISSION_REQUEST_DATA, MavMessage,
    MavMissionResult, MavMissionType, MavSeverity,
};

/// Maximum number of corners, about the capacity of ArduCopter's storage.
const MAX_CORNERS: u16 = 70;
/// Time after which a missing item is requested again [s].
const REPEAT_S: f64 = 1.0;
/// Silence of the sender after which an upload is cancelled [s].
const TIMEOUT_S: f64 = 8.0;

/// Sender of a message: system and component.
type Sender = (u8, u8);

/// Stored polygons, and the upload in progress.
#[derive(Clone, Debug, Default)]
pub(super) struct Polygons {
    /// Corners of all polygons in force, one after the other.
    corners: Vec<FenceCorner>,
    upload: Option<Upload>,
}

#[derive(Clone, Debug)]
struct Upload {
    from: Sender,
    count: u16,
    got: Vec<FenceCorner>,
    received_at: AutopilotTime,
    asked_at: AutopilotTime,
}

impl Polygons {
    /// Returns the polygons that are stored over a reboot.
    pub(super) fn stored(&self) -> Self {
        Self { corners: self.corners.clone(), upload: None }
    }

    /// Whether a position is outside an inclusion polygon, or inside an exclusion polygon [m, world].
    pub(super) fn are_breached_at(&self, origin: GlobalPoint, p_world_m: DVec2) -> bool {
        let mut rest = &self.corners[..];
        while let Some(first) = rest.first() {
            let (polygon, others) = rest.split_at(usize::from(first.corners).min(rest.len()));
            let corner_m = |i: usize| polygon[i].place.from_origin_m(origin);
            let inside = is_inside((0..polygon.len()).map(corner_m), p_world_m);
            if inside != (first.side == FenceSide::Inside) {
                return true;
            }
            rest = others;
        }
        false
    }
}

/// Whether a point is inside a polygon: a ray from it crosses the sides an odd number of times.
fn is_inside(corners_m: impl Iterator<Item = DVec2> + Clone, p_m: DVec2) -> bool {
    let next = corners_m.clone().cycle().skip(1);
    let crosses = |(a, b): (DVec2, DVec2)| {
        let spans = (a.y > p_m.y) != (b.y > p_m.y);
        spans && p_m.x < a.x + (p_m.y - a.y) / (b.y - a.y) * (b.x - a.x)
    };
    corners_m.zip(next).filter(|&side| crosses(side)).count() % 2 == 1
}

/// Whether the corners form complete polygons, each of one kind.
fn are_whole(mut corners: &[FenceCorner]) -> bool {
    while let Some(first) = corners.first() {
        let count = usize::from(first.corners);
        let Some(polygon) = corners.get(..count) else { return false };
        if polygon.iter().any(|c| (c.side, c.corners) != (first.side, first.corners)) {
            return false;
        }
        corners = &corners[count..];
    }
    true
}

impl Autopilot {
    /// Handles a message of the mission protocol. Returns whether it was one.
    pub(super) fn handle_mission(
        &mut self,
        now: AutopilotTime,
        from: Sender,
        message: &MavMessage,
    ) -> bool {
        let (to, kind) = match message {
            MavMessage::MISSION_COUNT(m) => ((m.target_system, m.target_component), m.mission_type),
            MavMessage::MISSION_ITEM_INT(m) => {
                ((m.target_system, m.target_component), m.mission_type)
            }
            MavMessage::MISSION_CLEAR_ALL(m) => {
                ((m.target_system, m.target_component), m.mission_type)
            }
            MavMessage::MISSION_REQUEST_LIST(m) => {
                ((m.target_system, m.target_component), m.mission_type)
            }
            MavMessage::MISSION_REQUEST_INT(m) => {
                ((m.target_system, m.target_component), m.mission_type)
            }
            _ => return false,
        };
        if !self.is_for_us(to.0, to.1) {
            return true;
        }
        let clears_all = kind == MavMissionType::MAV_MISSION_TYPE_ALL
            && matches!(message, MavMessage::MISSION_CLEAR_ALL(_));
        if kind != MavMissionType::MAV_MISSION_TYPE_FENCE && !clears_all {
            self.acknowledge(from, kind, MavMissionResult::MAV_MISSION_UNSUPPORTED);
            return true;
        }
        match message {
            MavMessage::MISSION_COUNT(m) => self.begin_upload(now, from, m.count),
            MavMessage::MISSION_ITEM_INT(m) => self.take_item(now, from, m),
            MavMessage::MISSION_CLEAR_ALL(_) => {
                let result = if self.polygons.upload.is_some() {
                    MavMissionResult::MAV_MISSION_ERROR
                } else {
                    self.polygons.corners.clear();
                    MavMissionResult::MAV_MISSION_ACCEPTED
                };
                self.acknowledge(from, kind, result);
            }
            MavMessage::MISSION_REQUEST_LIST(_) => {
                self.send(MavMessage::MISSION_COUNT(MISSION_COUNT_DATA {
                    count: self.polygons.corners.len() as u16,
                    target_system: from.0,
                    target_component: from.1,
                    mission_type: MavMissionType::MAV_MISSION_TYPE_FENCE,
                    ..Default::default()
                }));
            }
            MavMessage::MISSION_REQUEST_INT(m) => {
                match self.polygons.corners.get(usize::from(m.seq)) {
                    Some(corner) => {
                        let item = fence_corner_to_mavlink(corner, m.seq, from);
                        self.send(MavMessage::MISSION_ITEM_INT(item));
                    }
                    None => self.answer(from, MavMissionResult::MAV_MISSION_INVALID_SEQUENCE),
                }
            }
            _ => {}
        }
        true
    }

    fn begin_upload(&mut self, now: AutopilotTime, from: Sender, count: u16) {
        if self.polygons.upload.as_ref().is_some_and(|upload| upload.from != from) {
            return self.answer(from, MavMissionResult::MAV_MISSION_DENIED);
        }
        self.polygons.upload = None;
        if count > MAX_CORNERS {
            let text = format!("Only {MAX_CORNERS} items are supported");
            self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, &text);
            return self.answer(from, MavMissionResult::MAV_MISSION_NO_SPACE);
        }
        if count == 0 {
            self.polygons.corners.clear();
            return self.answer(from, MavMissionResult::MAV_MISSION_ACCEPTED);
        }
        let got = Vec::with_capacity(usize::from(count));
        self.polygons.upload = Some(Upload { from, count, got, received_at: now, asked_at: now });
        self.ask_for_item(now);
    }

    fn take_item(&mut self, now: AutopilotTime, from: Sender, item: &MISSION_ITEM_INT_DATA) {
        let Some(upload) = self.polygons.upload.as_mut() else { return };
        if upload.from != from {
            return self.answer(from, MavMissionResult::MAV_MISSION_DENIED);
        }
        if usize::from(item.seq) != upload.got.len() {
            // A duplicate; the upload continues.
            return self.answer(from, MavMissionResult::MAV_MISSION_INVALID_SEQUENCE);
        }
        match fence_corner_from_mavlink(item) {
            Ok(corner) => upload.got.push(corner),
            Err(result) => {
                self.polygons.upload = None;
                return self.answer(from, result);
            }
        }
        upload.received_at = now;
        if upload.got.len() < usize::from(upload.count) {
            return self.ask_for_item(now);
        }
        let corners = std::mem::take(&mut upload.got);
        self.polygons.upload = None;
        let result = if are_whole(&corners) {
            self.polygons.corners = corners;
            MavMissionResult::MAV_MISSION_ACCEPTED
        } else {
            MavMissionResult::MAV_MISSION_ERROR
        };
        self.answer(from, result);
    }

    fn ask_for_item(&mut self, now: AutopilotTime) {
        let Some(upload) = self.polygons.upload.as_mut() else { return };
        upload.asked_at = now;
        let request = MISSION_REQUEST_DATA {
            seq: upload.got.len() as u16,
            target_system: upload.from.0,
            target_component: upload.from.1,
            mission_type: MavMissionType::MAV_MISSION_TYPE_FENCE,
        };
        self.send(MavMessage::MISSION_REQUEST(request));
    }

    /// Requests missing items again, and cancels the upload after a timeout.
    pub(super) fn tend_upload(&mut self, now: AutopilotTime) {
        let Some(upload) = &self.polygons.upload else { return };
        if now.seconds_since(upload.received_at) > TIMEOUT_S {
            let from = upload.from;
            self.polygons.upload = None;
            self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, "Fence upload timeout");
            self.answer(from, MavMissionResult::MAV_MISSION_OPERATION_CANCELLED);
        } else if now.seconds_since(upload.asked_at) > REPEAT_S {
            self.ask_for_item(now);
        }
    }

    fn answer(&mut self, to: Sender, result: MavMissionResult) {
        self.acknowledge(to, MavMissionType::MAV_MISSION_TYPE_FENCE, result);
    }

    fn acknowledge(&mut self, to: Sender, kind: MavMissionType, result: MavMissionResult) {
        self.send(MavMessage::MISSION_ACK(MISSION_ACK_DATA {
            target_system: to.0,
            target_component: to.1,
            mavtype: result,
            mission_type: kind,
            ..Default::default()
        }));
    }
}
