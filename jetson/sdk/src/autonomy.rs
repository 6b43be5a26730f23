//! The one trait a plugin implements.

use vizflyt_protocol::messages::{ArenaInfo, Event, Setpoint};

use crate::observation::Observation;

/// A plugin: receives images and returns setpoints.
///
/// All methods are called from one thread, one at a time, in this order: `on_start` once, then
/// `on_image` and `on_event` as they come, then `on_stop` once.
///
/// The runtime's guard has the last word: it limits speed and acceleration, keeps the vehicle in
/// the geofence, refuses numbers that are not finite, and holds (after 0.5 s) and lands (after
/// 2 s) if no setpoint comes.
pub trait Autonomy {
    /// Called once before the first image and before take-off, with what there is to know of the
    /// arena: goal, cameras, limits. Load models here; the vehicle waits on the ground.
    fn on_start(&mut self, info: &ArenaInfo) {
        let _ = info;
    }

    /// Called with the newest image; those that came during the last call are skipped.
    ///
    /// Returns where to fly. `None` leaves the former setpoint in force until its deadline, so a
    /// plugin that always returns `None` holds and then lands. Images come from before take-off
    /// on; answers count once the vehicle has reached its take-off height.
    fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint>;

    /// Called between images when something happened: a stage passed, a collision, a new phase of
    /// flight.
    fn on_event(&mut self, event: &Event) {
        let _ = event;
    }

    /// Called once at the end of the flight. The process exits afterwards.
    fn on_stop(&mut self) {}
}
