"""Base class of plugins."""

from __future__ import annotations

from ._vizflyt import ArenaInfo, Event, Observation, Setpoint


class Plugin:
    """A plugin: receives images and returns setpoints.

    All methods are called from one thread, one at a time, in this order: ``on_start`` once, then
    ``on_image`` and ``on_event`` as they come, then ``on_stop`` once.

    The runtime's guard has the last word: it limits speed and acceleration, keeps the vehicle in the geofence, and
    rejects numbers that are not finite. Without setpoints, it holds after 0.5 s and lands after 2 s.
    """

    def on_start(self, info: ArenaInfo) -> None:
        """Called once before the first image and before take-off, with the arena's goal, cameras and limits. Load
        models here; the vehicle waits on the ground.
        """

    def on_image(self, obs: Observation) -> Setpoint | None:
        """Called with the newest image. Images that arrive during the previous call are skipped.

        Returns the next setpoint. ``None`` keeps the previous setpoint until its deadline, so a plugin that always
        returns ``None`` holds and then lands. Images arrive before take-off; setpoints take effect when the vehicle has
        reached its take-off height.
        """
        raise NotImplementedError

    def on_event(self, event: Event) -> None:
        """Called between images for each event, for example a passed stage, a collision or a new flight phase."""

    def on_stop(self) -> None:
        """Called once at the end of the flight. ``run`` returns afterwards."""
