//! Whether the vehicle is still in a mode that we have asked for. Once the autopilot has confirmed ours by a heartbeat,
//! another is the doing of a pilot, of a ground station or of a failsafe: nothing is taken back, in no phase of
//! flight. To give the vehicle back is a person's to do.

use vizflyt_protocol::mavlink::CopterMode;

use super::goal::Goal;

/// What heartbeats tell of the mode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct OwnMode {
    /// GUIDED was confirmed.
    guided: bool,
    /// LAND was, since landing is the goal.
    land: bool,
    taken: Option<u32>,
}

impl OwnMode {
    /// Takes the mode of a heartbeat. An acknowledgement is none: it may overtake an older heartbeat.
    pub(super) fn handle_heartbeat(&mut self, goal: Goal, mode: u32, armed: bool) {
        let is_guided = mode == CopterMode::Guided as u32;
        let is_land = mode == CopterMode::Land as u32;
        let is_taken = match goal {
            Goal::Prepare => false,
            Goal::TakeOff(_) | Goal::Fly => {
                self.guided |= is_guided;
                // One that disarms in flight, as by a restart, has not chosen anything.
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

    /// Returns the mode that somebody else has chosen last.
    pub(super) fn taken(&self) -> Option<u32> {
        self.taken
    }

    /// Whether nothing is to be commanded for `goal` any more. A landing that somebody else began is only landed.
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
        // Landing was ordered and something else is flown, before LAND was confirmed and after.
        check(&[(Goal::Land, GUIDED, true), (Goal::Land, LOITER, true)], Some(LOITER));
        check(&[(Goal::Land, LAND, true), (Goal::Land, GUIDED, true)], Some(GUIDED));
        check(&[(Goal::Land, LAND, true), (Goal::Land, LOITER, false)], None);
    }

    #[test]
    fn what_was_taken_is_not_ours_again_by_itself() {
        let own = after(&[(Goal::Fly, GUIDED, true), (Goal::Fly, LOITER, true)]);
        assert!(own.is_hands_off(Goal::Fly) && own.is_hands_off(Goal::Land));
        let back = after(&[
            (Goal::Fly, GUIDED, true),
            (Goal::Fly, LOITER, true),
            (Goal::Prepare, GUIDED, true),
        ]);
        assert!(back.is_hands_off(Goal::Fly));
        // A failsafe's landing goes on, until a pilot takes the vehicle out of it.
        let mut landing = after(&[(Goal::Fly, GUIDED, true), (Goal::Fly, LAND, true)]);
        assert!(landing.is_hands_off(Goal::Fly) && !landing.is_hands_off(Goal::Land));
        landing.handle_heartbeat(Goal::Land, LAND, true);
        landing.handle_heartbeat(Goal::Land, LOITER, true);
        assert!(landing.is_hands_off(Goal::Land));
    }
}
