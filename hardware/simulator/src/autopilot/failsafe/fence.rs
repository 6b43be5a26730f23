//! The autopilot's fence: a cylinder around home with a ceiling and a floor, and polygons (AC_Fence.cpp).
//!
//! The floor is active from when the vehicle has risen FENCE_MARGIN above it until it lands, so that standing on the
//! ground is not a breach.

use glam::DVec3;
use vizflyt_protocol::mavlink::{CopterMode, GlobalPoint};
use vizflyt_protocol::time::AutopilotTime;

use super::super::dialect::{self, FenceBreach, MavMessage, MavSeverity};
use super::super::{Autopilot, Param, Return};
use super::Action;

/// Bits of FENCE_TYPE.
const CEILING: u8 = 1;
const CIRCLE: u8 = 2;
const POLYGONS: u8 = 4;
const FLOOR: u8 = 8;
/// Distance beyond the fence at which LAND replaces the configured action [m].
const GIVE_UP_M: f64 = 100.0;

/// Breached sides, and maximum distance beyond them [m].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in super::super) struct Breaches {
    ceiling: bool,
    circle: bool,
    polygon: bool,
    floor: bool,
    beyond_m: f64,
}

impl Breaches {
    pub(in super::super) fn any(self) -> bool {
        self.ceiling || self.circle || self.polygon || self.floor
    }

    fn names(self) -> String {
        let all = [
            (self.ceiling, "Max Alt"),
            (self.circle, "Circle"),
            (self.polygon, "Polygon"),
            (self.floor, "Min Alt"),
        ];
        all.iter().filter(|(on, _)| *on).map(|(_, name)| *name).collect::<Vec<_>>().join(", ")
    }
}

/// State of the fence.
#[derive(Clone, Copy, Debug, Default)]
pub(in super::super) struct Fence {
    breached: Breaches,
    /// Whether the floor is active.
    floor: bool,
    count: u16,
    at: Option<AutopilotTime>,
}

impl Autopilot {
    pub(in super::super) fn is_fenced(&self) -> bool {
        self.params.value(Param::FenceEnable) != 0.0
    }

    fn breaches_at(&self, p_world_m: DVec3) -> Breaches {
        // Before the first arming, home is the present position.
        let home = self.home.unwrap_or(p_world_m);
        let value = |param| self.params.value(param);
        let sides = value(Param::FenceType) as u8;
        let from_home = p_world_m - home;
        let above_m = from_home.z - value(Param::FenceAltMax);
        let outside_m = from_home.truncate().length() - value(Param::FenceRadius);
        let below_m = value(Param::FenceAltMin) - from_home.z;
        let origin = self
            .origin
            .map(|(latitude_e7, longitude_e7, _)| GlobalPoint { latitude_e7, longitude_e7 });
        Breaches {
            ceiling: sides & CEILING != 0 && above_m > 0.0,
            circle: sides & CIRCLE != 0 && outside_m > 0.0,
            // Without an origin, polygons have no position.
            polygon: sides & POLYGONS != 0
                && origin.is_some_and(|origin| {
                    self.polygons.are_breached_at(origin, p_world_m.truncate())
                }),
            floor: sides & FLOOR != 0 && below_m > 0.0 && self.failsafe.fence.floor,
            beyond_m: above_m.max(outside_m),
        }
    }

    pub(in super::super) fn fence_breaches(&self, now: AutopilotTime) -> Breaches {
        if self.estimator.health(now).position {
            self.breaches_at(self.estimator.estimate().p_world_m)
        } else {
            Breaches::default()
        }
    }

    pub(in super::super) fn is_within_fence(&self, p_world_m: DVec3) -> bool {
        !self.is_fenced() || !self.breaches_at(p_world_m).any()
    }

    /// Returns the maximum height of RTL under the ceiling [m, above home].
    pub(in super::super) fn fence_ceiling_m(&self) -> f64 {
        let value = |param| self.params.value(param);
        if self.is_fenced() && value(Param::FenceType) as u8 & CEILING != 0 {
            value(Param::FenceAltMax) - value(Param::FenceMargin)
        } else {
            f64::INFINITY
        }
    }

    /// Activates the floor when the vehicle is well above it, until it lands.
    fn check_floor(&mut self) {
        let value = |param| self.params.value(param);
        let comes_down = match self.mode {
            CopterMode::Land => true,
            CopterMode::Rtl => self.returning == Return::Land,
            _ => false,
        };
        let is_down = !self.armed || self.landed || comes_down;
        let z_m = self.estimator.estimate().p_world_m.z;
        let height_m = self.home.map_or(0.0, |home| z_m - home.z);
        let is_over = height_m >= value(Param::FenceAltMin) + value(Param::FenceMargin);
        self.failsafe.fence.floor = !is_down && (self.failsafe.fence.floor || is_over);
    }

    pub(super) fn check_fence(&mut self, now: AutopilotTime) {
        self.check_floor();
        if !self.is_fenced() || !self.armed || self.landed {
            self.failsafe.fence.breached = Breaches::default();
            return;
        }
        let breached = self.fence_breaches(now);
        let before = std::mem::replace(&mut self.failsafe.fence.breached, breached);
        if !breached.any() {
            return;
        }
        if !before.any() {
            self.failsafe.fence.count = self.failsafe.fence.count.saturating_add(1);
            self.failsafe.fence.at = Some(now);
            let text = format!("{} fence breached", breached.names());
            self.send_status_text(MavSeverity::MAV_SEVERITY_NOTICE, &text);
            let action = match self.params.value(Param::FenceAction) as u8 {
                0 => Action::Nothing,
                2 | 5 => Action::Land,
                4 => Action::Brake,
                _ => Action::Return,
            };
            self.act(now, action);
        } else if breached.beyond_m > GIVE_UP_M && before.beyond_m <= GIVE_UP_M {
            self.act(now, Action::Land);
        }
    }

    pub(in super::super) fn fence_status(&self) -> MavMessage {
        let fence = &self.failsafe.fence;
        MavMessage::FENCE_STATUS(dialect::FENCE_STATUS_DATA {
            breach_time: fence.at.map_or(0, |at| (at.as_ns() / 1_000_000) as u32),
            breach_count: fence.count,
            breach_status: u8::from(fence.breached.any()),
            breach_type: if fence.breached.ceiling {
                FenceBreach::FENCE_BREACH_MAXALT
            } else if fence.breached.circle || fence.breached.polygon {
                FenceBreach::FENCE_BREACH_BOUNDARY
            } else if fence.breached.floor {
                FenceBreach::FENCE_BREACH_MINALT
            } else {
                FenceBreach::FENCE_BREACH_NONE
            },
            ..Default::default()
        })
    }
}
