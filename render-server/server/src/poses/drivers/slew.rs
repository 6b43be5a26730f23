//! Gradual correction of stamps after the source of the poses paused. Sans-IO.
//!
//! Such a source continues where it stopped, so all later stamps are late by the pause. A step in the stamps would make
//! the vehicle seem to stand for that time, and its turn disagree with the gyroscope. Therefore the stamps run faster
//! than the source until they have caught up: a speed then seems a quarter lower, never higher.

use vizflyt_protocol::time::ServerTime;

/// Lag of the stamps behind their clock, which decreases to zero.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Slew {
    behind_s: f64,
    last: Option<ServerTime>,
}

impl Slew {
    /// Continues the stamps although their clock has slipped by `late_s`; negative if it caught up. A long pause is not
    /// corrected: the poses count as lost.
    pub(super) fn slip(&mut self, late_s: f64) {
        let behind_s = self.behind_s + late_s;
        *self = Self::default();
        if behind_s > 0.0 && behind_s < LONGEST_S {
            self.behind_s = behind_s;
        }
    }

    /// Returns the corrected stamp.
    pub(super) fn apply(&mut self, stamp: ServerTime) -> ServerTime {
        let dt_s = self.last.map_or(0.0, |last| stamp.seconds_since(last).max(0.0));
        self.last = Some(stamp);
        self.behind_s = (self.behind_s - RATE * dt_s).max(0.0);
        stamp.plus_seconds(-self.behind_s)
    }
}

/// Share by which the stamps run faster.
const RATE: f64 = 0.35;
/// Pause after which the vehicle lands anyway. [s]
const LONGEST_S: f64 = 0.5;
