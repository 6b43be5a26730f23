//! Upload of the arena's polygons as the autopilot's own fence, with the mission protocol: the link offers the number
//! of corners, the autopilot requests each corner, and finally acknowledges all. The upload happens only on the ground,
//! again after each restart, and again if a reply is lost.

use glam::DVec2;
use vizflyt_protocol::mavlink::dialect::{MISSION_ACK_DATA, MavMissionResult, MavMissionType};
use vizflyt_protocol::mavlink::{FenceCorner, FenceSide, GlobalPoint, mission_result_name};
use vizflyt_protocol::time::HostTime;

use super::identity::{COMPONENT_ID, SYSTEM_ID};

/// Polygon on the floor plan that the vehicle must stay inside or outside of.
#[derive(Clone, Debug, PartialEq)]
pub struct FencePolygon {
    pub side: FenceSide,
    /// Three or more corners, in order. [m, world]
    pub corners_m: Vec<DVec2>,
}

/// Result of an upload.
#[derive(Clone, Debug, PartialEq)]
pub enum FenceEvent {
    /// The autopilot has accepted this number of polygons.
    Accepted(usize),
    /// The autopilot has rejected them and keeps its previous fence; the reason as a sentence.
    Rejected(String),
}

/// Timeout after an offer or an item, after which the offer is repeated; ArduCopter repeats a request after a second.
/// [s]
const REPEAT_S: f64 = 1.5;
/// Maximum number of offers.
const TRIES: u8 = 5;

/// State of the upload.
#[derive(Clone, Debug, Default)]
pub(super) struct Upload {
    polygons: Vec<FencePolygon>,
    /// Corners as sent, relative to the origin.
    corners: Vec<FenceCorner>,
    origin: Option<GlobalPoint>,
    stage: Stage,
}

#[derive(Clone, Copy, Debug, Default)]
enum Stage {
    /// Nothing to do, finished, or given up.
    #[default]
    Idle,
    /// Offer due.
    Due { at: Option<HostTime>, tries: u8 },
    /// Offered; number of corners requested.
    Offered { asked: usize, repeat_at: HostTime, tries: u8 },
}

impl Upload {
    /// Sets the polygons to upload.
    pub(super) fn want(&mut self, polygons: Vec<FencePolygon>) {
        if self.polygons != polygons {
            self.polygons = polygons;
            self.restart();
        }
    }

    /// Starts again, for example after a restart of the autopilot.
    pub(super) fn restart(&mut self) {
        self.origin = None;
        let wanted = !self.polygons.is_empty();
        self.stage = if wanted { Stage::Due { at: None, tries: 0 } } else { Stage::Idle };
    }

    /// Ends the upload, because this autopilot supports no polygons. Returns whether one was in progress.
    pub(super) fn give_up(&mut self) -> bool {
        let was_due = self.is_under_way();
        self.stage = Stage::Idle;
        was_due
    }

    /// Whether the upload is unfinished.
    pub(super) fn is_under_way(&self) -> bool {
        !matches!(self.stage, Stage::Idle)
    }

    /// Sets the origin of the autopilot's local frame, which gives the polygons global coordinates.
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

    /// Returns the time at which [`Self::poll`] is due next.
    pub(super) fn due_at(&self) -> Option<HostTime> {
        match self.stage {
            Stage::Offered { repeat_at, .. } => Some(repeat_at),
            Stage::Due { at, .. } => at,
            Stage::Idle => None,
        }
    }

    /// Runs what is due: returns the number of corners to offer, or a failure.
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

    /// Returns the requested corner.
    pub(super) fn asked(&mut self, now: HostTime, seq: u16) -> Option<FenceCorner> {
        let Stage::Offered { asked, repeat_at, .. } = &mut self.stage else { return None };
        let corner = *self.corners.get(usize::from(seq))?;
        *asked = (*asked).max(usize::from(seq) + 1);
        *repeat_at = now.plus_seconds(REPEAT_S);
        Some(corner)
    }

    /// Handles the autopilot's acknowledgement; returns the result when the upload is finished.
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
            // Otherwise it is a reply to an earlier attempt.
            MavMissionResult::MAV_MISSION_ACCEPTED if asked == self.corners.len() => {
                self.stage = Stage::Idle;
                Some(FenceEvent::Accepted(self.polygons.len()))
            }
            // A corner was sent twice; the upload continues.
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
