//! Detects that the vehicle left a mode that we requested. After a heartbeat has confirmed our mode, another mode was
//! chosen by a pilot, a ground station or a failsafe. The link never changes it back, in any phase of flight. Only a
//! person may give control back.

use vizflyt_protocol::mavlink::CopterMode;

use super::goal::Goal;

/// State derived from the modes in heartbeats.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct OwnMode {
    /// GUIDED has been confirmed.
    guided: bool,
    /// LAND has been confirmed since landing is the goal.
    land: bool,
    taken: Option<u32>,
}

impl OwnMode {
    /// Records the mode of a heartbeat. Acknowledgements do not count, because they may overtake an older heartbeat.
    pub(super) fn handle_heartbeat(&mut self, goal: Goal, mode: u32, armed: bool) {
        let is_guided = mode == CopterMode::Guided as u32;
        let is_land = mode == CopterMode::Land as u32;
        let is_taken = match goal {
            Goal::Prepare => false,
            Goal::TakeOff(_) | Goal::Fly => {
                self.guided |= is_guided;
                // A vehicle that disarms in flight, for example after a restart, has not chosen a mode.
                self.guided && !is_guided && (armed || goal != Goal::Fly)
            }
            Goal::Land => {
                self.land |= armed && is_land;
                armed && !is_land && (self.land || !is_guided)
            }
        };
        if is_taken {
            self.taken = Some(mode);
        }
    }

    /// Returns the mode last chosen by a pilot, a ground station or a failsafe.
    pub(super) fn taken(&self) -> Option<u32> {
        self.taken
    }

    /// Whether the link must not command anything for `goal`. If another party started a landing, only landing is
    /// allowed.
    pub(super) fn is_hands_off(&self, goal: Goal) -> bool {
        let is_land = |mode: u32| mode == CopterMode::Land as u32;
        self.taken.is_some_and(|mode| goal != Goal::Land || !is_land(mode))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GUIDED: u32 = CopterMode::Guided as u32;
    const LAND: u32 = CopterMode::Land as u32;
    const LOITER: u32 = CopterMode::Loiter as u32;

    fn after(heartbeats: &[(Goal, u32, bool)]) -> OwnMode {
        let mut own = OwnMode::default();
        for &(goal, mode, armed) in heartbeats {
            own.handle_heartbeat(goal, mode, armed);
        }
        own
    }

    #[test]
    fn a_mode_is_taken_only_after_ours_was_confirmed() {
        let climb = Goal::TakeOff(1.0);
        let check = |heartbeats: &[_], taken: Option<u32>| {
            assert_eq!(after(heartbeats).taken(), taken, "{heartbeats:?}");
        };
        check(&[(Goal::Prepare, GUIDED, false), (Goal::Prepare, LOITER, false)], None);
        check(&[(climb, LOITER, false), (climb, 0, false)], None);
        check(&[(climb, GUIDED, false), (climb, LOITER, false)], Some(LOITER));
        check(&[(climb, GUIDED, true), (climb, LOITER, true)], Some(LOITER));
        check(&[(climb, GUIDED, true), (Goal::Fly, LAND, true)], Some(LAND));
        check(&[(climb, GUIDED, true), (Goal::Land, GUIDED, true), (Goal::Land, LAND, true)], None);
        // Landing was ordered and another mode is active, before and after LAND was confirmed.
        check(&[(Goal::Land, GUIDED, true), (Goal::Land, LOITER, true)], Some(LOITER));
        check(&[(Goal::Land, LAND, true), (Goal::Land, GUIDED, true)], Some(GUIDED));
        check(&[(Goal::Land, LAND, true), (Goal::Land, LOITER, false)], None);
    }

    #[test]
    fn control_is_not_resumed_automatically() {
        let own = after(&[(Goal::Fly, GUIDED, true), (Goal::Fly, LOITER, true)]);
        assert!(own.is_hands_off(Goal::Fly) && own.is_hands_off(Goal::Land));
        let back = after(&[
            (Goal::Fly, GUIDED, true),
            (Goal::Fly, LOITER, true),
            (Goal::Prepare, GUIDED, true),
        ]);
        assert!(back.is_hands_off(Goal::Fly));
        // A landing by a failsafe continues until a pilot changes the mode.
        let mut landing = after(&[(Goal::Fly, GUIDED, true), (Goal::Fly, LAND, true)]);
        assert!(landing.is_hands_off(Goal::Fly) && !landing.is_hands_off(Goal::Land));
        landing.handle_heartbeat(Goal::Land, LAND, true);
        landing.handle_heartbeat(Goal::Land, LOITER, true);
        assert!(landing.is_hands_off(Goal::Land));
    }
}
