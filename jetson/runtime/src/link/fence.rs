//! The arena's polygons for the autopilot's own fence, uploaded by the mission protocol: their number
//! is offered, the autopilot requests one corner after the other, and acknowledges them all in the
//! end. Only to a vehicle on the ground, again after each restart, and again where an answer is lost.

use glam::DVec2;
use vizflyt_protocol::mavlink::dialect::{MISSION_ACK_DATA, MavMissionResult, MavMissionType};
use vizflyt_protocol::mavlink::{FenceCorner, FenceSide, GlobalPoint, mission_result_name};
use vizflyt_protocol::time::HostTime;

use super::identity::{COMPONENT_ID, SYSTEM_ID};

/// A part of the floor plan that the vehicle must stay in, or out of.
#[derive(Clone, Debug, PartialEq)]
pub struct FencePolygon {
    /// In or out.
    pub side: FenceSide,
    /// Three corners or more, in order. [m, world]
    pub corners_m: Vec<DVec2>,
}

/// The result of an upload.
#[derive(Clone, Debug, PartialEq)]
pub enum FenceEvent {
    /// The autopilot has accepted this many polygons.
    Accepted(usize),
    /// It has not, and keeps its former fence; why, in a sentence.
    Rejected(String),
}

/// An offer or an item that nothing follows is offered again after this; ArduCopter repeats a request
/// after a second. [s]
const REPEAT_S: f64 = 1.5;
/// Offered this many times: given up.
const TRIES: u8 = 5;

/// The upload.
#[derive(Clone, Debug, Default)]
pub(super) struct Upload {
    polygons: Vec<FencePolygon>,
    /// As they are sent: about an origin.
    corners: Vec<FenceCorner>,
    origin: Option<GlobalPoint>,
    stage: Stage,
}

#[derive(Clone, Copy, Debug, Default)]
enum Stage {
    /// Nothing to do, or done, or given up.
    #[default]
    Idle,
    /// To be offered.
    Due { at: Option<HostTime>, tries: u8 },
    /// Offered; so many corners have been asked for.
    Offered { asked: usize, repeat_at: HostTime, tries: u8 },
}

impl Upload {
    /// Wants these polygons in the autopilot.
    pub(super) fn want(&mut self, polygons: Vec<FencePolygon>) {
        if self.polygons != polygons {
            self.polygons = polygons;
            self.restart();
        }
    }

    /// Starts again, as after a restart of the autopilot.
    pub(super) fn restart(&mut self) {
        self.origin = None;
        let wanted = !self.polygons.is_empty();
        self.stage = if wanted { Stage::Due { at: None, tries: 0 } } else { Stage::Idle };
    }

    /// Takes it that this autopilot keeps no polygons.
    pub(super) fn give_up(&mut self) -> bool {
        let was_due = self.is_under_way();
        self.stage = Stage::Idle;
        was_due
    }

    /// Whether it is not over yet.
    pub(super) fn is_under_way(&self) -> bool {
        !matches!(self.stage, Stage::Idle)
    }

    /// Takes the origin of the autopilot's local frame, which places the polygons on the globe.
    pub(super) fn set_origin(&mut self, origin: GlobalPoint) {
        if self.origin == Some(origin) {
            return;
        }
        let moved = self.origin.is_some();
        if moved {
            self.restart();
        }
        self.origin = Some(origin);
        self.corners.clear();
        for polygon in &self.polygons {
            let corners = polygon.corners_m.len() as u16;
            let place = |&corner_m: &DVec2| FenceCorner {
                side: polygon.side,
                corners,
                place: origin.offset(corner_m),
            };
            self.corners.extend(polygon.corners_m.iter().map(place));
        }
    }

    /// Returns when [`Self::poll`] has something to do next.
    pub(super) fn due_at(&self) -> Option<HostTime> {
        match self.stage {
            Stage::Offered { repeat_at, .. } => Some(repeat_at),
            Stage::Due { at, .. } => at,
            Stage::Idle => None,
        }
    }

    /// Does what is due: returns the number of corners to offer, or that it has failed.
    pub(super) fn poll(&mut self, now: HostTime) -> Option<Result<u16, FenceEvent>> {
        self.origin?;
        let tries = match self.stage {
            Stage::Due { at, tries } if at.is_none_or(|at| now >= at) => tries,
            Stage::Offered { repeat_at, tries, .. } if now >= repeat_at => tries,
            _ => return None,
        };
        if tries >= TRIES {
            return Some(Err(self.fail("it does not answer")));
        }
        let repeat_at = now.plus_seconds(REPEAT_S);
        self.stage = Stage::Offered { asked: 0, repeat_at, tries: tries + 1 };
        Some(Ok(self.corners.len() as u16))
    }

    /// Returns the corner that is asked for.
    pub(super) fn asked(&mut self, now: HostTime, seq: u16) -> Option<FenceCorner> {
        let Stage::Offered { asked, repeat_at, .. } = &mut self.stage else { return None };
        let corner = *self.corners.get(usize::from(seq))?;
        *asked = (*asked).max(usize::from(seq) + 1);
        *repeat_at = now.plus_seconds(REPEAT_S);
        Some(corner)
    }

    /// Handles the autopilot's acknowledgement; returns the result of the upload, once it is known.
    pub(super) fn acknowledged(
        &mut self,
        now: HostTime,
        ack: &MISSION_ACK_DATA,
    ) -> Option<FenceEvent> {
        let for_us = [0, SYSTEM_ID].contains(&ack.target_system)
            && [0, COMPONENT_ID].contains(&ack.target_component);
        let Stage::Offered { asked, tries, .. } = self.stage else { return None };
        if !for_us || ack.mission_type != MavMissionType::MAV_MISSION_TYPE_FENCE {
            return None;
        }
        match ack.mavtype {
            // An answer to an earlier attempt otherwise.
            MavMissionResult::MAV_MISSION_ACCEPTED if asked == self.corners.len() => {
                self.stage = Stage::Idle;
                Some(FenceEvent::Accepted(self.polygons.len()))
            }
            // A corner came twice, and it goes on.
            MavMissionResult::MAV_MISSION_ACCEPTED
            | MavMissionResult::MAV_MISSION_INVALID_SEQUENCE => None,
            MavMissionResult::MAV_MISSION_DENIED
            | MavMissionResult::MAV_MISSION_OPERATION_CANCELLED
                if tries < TRIES =>
            {
                self.stage = Stage::Due { at: Some(now.plus_seconds(REPEAT_S)), tries };
                None
            }
            refusal => Some(self.fail(mission_result_name(refusal))),
        }
    }

    fn fail(&mut self, why: &str) -> FenceEvent {
        self.stage = Stage::Idle;
        FenceEvent::Rejected(why.to_owned())
    }
}
