//! `[rules]`: penalties that do not end a flight, and the setpoints that plugins may use.

use glam::DVec3;
use serde::{Deserialize, Serialize};
use vizflyt_protocol::messages::{SetpointKind, SetpointKinds};

use super::validate::{ConfigError, check_number, check_position, invalid};
use super::{ArenaConfig, Geofence};

/// `[rules]`: a start box, and penalties in seconds. Every key is optional; without keys, nothing is penalized.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RulesConfig {
    /// Box in which the body's centre must be at take-off; take-off waits for it. A flight that starts outside
    /// of it is not official. For a vehicle with its own spawn, the box moves with the spawn. [m, world]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_box: Option<Geofence>,
    /// Penalty for a take-off outside of the start box. [s]
    pub false_start_s: f64,
    /// Clearance below which a near miss is counted; 0 disables it. [m]
    pub near_miss_m: f64,
    /// Penalty for each near miss, regardless of its duration. [s]
    pub near_miss_s: f64,
    /// Kinds of setpoint that plugins may use; default: all except attitude rates, and except positions if
    /// `ground_truth` is false.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub setpoints: Option<SetpointKinds>,
}

impl RulesConfig {
    /// Returns the start box for a spawn: placing the vehicle by hand is accurate to half a metre. [m, world]
    pub fn start_box_about(spawn_m: DVec3) -> Geofence {
        let (below_m, above_m) = (DVec3::new(0.5, 0.5, 0.5), DVec3::new(0.5, 0.5, 1.0));
        Geofence { min_m: spawn_m - below_m, max_m: spawn_m + above_m }
    }

    /// Whether a flight may start at a position. [m, world]
    pub fn starts_within(&self, p_m: DVec3) -> bool {
        let within = |start: Geofence| p_m.cmpge(start.min_m).all() && p_m.cmple(start.max_m).all();
        self.start_box.is_none_or(within)
    }

    pub(super) fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Returns the penalty of a flight, from its take-off position [m, world] and its clearances in order of
    /// time [m]. [s]
    ///
    /// ```
    /// use glam::DVec3;
    /// use vizflyt_arena::config::{Geofence, RulesConfig};
    /// let rules = RulesConfig {
    ///     start_box: Some(Geofence { min_m: DVec3::ZERO, max_m: DVec3::ONE }),
    ///     false_start_s: 5.0,
    ///     near_miss_m: 0.1,
    ///     near_miss_s: 2.0,
    ///     setpoints: None,
    /// };
    /// let clearances_m = [0.5, 0.09, 0.08, 0.5, 0.05];
    /// assert_eq!(rules.penalty_s(Some(DVec3::splat(0.5)), clearances_m), 4.0);
    /// assert_eq!(rules.penalty_s(Some(DVec3::splat(1.5)), clearances_m), 9.0);
    /// assert_eq!(rules.penalty_s(None, []), 0.0);
    /// ```
    pub fn penalty_s(
        &self,
        took_off_m: Option<DVec3>,
        clearances_m: impl IntoIterator<Item = f64>,
    ) -> f64 {
        let false_start = took_off_m.is_some_and(|p_m| !self.starts_within(p_m));
        let (mut near_misses, mut near) = (0_u32, false);
        for clearance_m in clearances_m {
            let now_near = clearance_m < self.near_miss_m;
            near_misses += u32::from(now_near && !near);
            near = now_near;
        }
        let start_s = if false_start { self.false_start_s } else { 0.0 };
        start_s + f64::from(near_misses) * self.near_miss_s
    }
}

impl ArenaConfig {
    pub(super) fn check_rules(&self) -> Result<(), ConfigError> {
        let rules = &self.rules;
        for (key, value) in
            [("rules.false_start_s", rules.false_start_s), ("rules.near_miss_s", rules.near_miss_s)]
        {
            check_number(key, value, "s", 0.0..=86400.0)?;
        }
        check_number("rules.near_miss_m", rules.near_miss_m, "m (0 is none)", 0.0..=2.0)?;
        if rules.setpoints == Some(SetpointKinds::NONE) {
            let advice = "name one kind or more, or leave it out".to_owned();
            return Err(invalid("rules.setpoints", "[]", advice));
        }
        let asks_for_pose =
            rules.setpoints.is_some_and(|kinds| kinds.contains(SetpointKind::Position));
        if asks_for_pose && !self.ground_truth {
            let advice = "needs the pose, which ground_truth = false withholds".to_owned();
            return Err(invalid("rules.setpoints", "position", advice));
        }
        let Some(start) = &rules.start_box else { return Ok(()) };
        check_position("rules.start_box.min_m", start.min_m)?;
        check_position("rules.start_box.max_m", start.max_m)?;
        if !start.min_m.cmplt(start.max_m).all() {
            let advice = format!("must exceed min_m = {} on each axis", start.min_m);
            return Err(invalid("rules.start_box.max_m", start.max_m, advice));
        }
        let spawn_m = self.spawn.position_m;
        if !rules.starts_within(spawn_m) {
            let advice =
                format!("the vehicle starts at {spawn_m}, outside of it; move one of them");
            return Err(invalid("rules.start_box.min_m", start.min_m, advice));
        }
        Ok(())
    }
}
