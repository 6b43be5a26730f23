"""A second station with system id 255 would hide the loss of the runtime from the autopilot: arming is refused."""

from checks import attempt, check
from lab import Flight
from promises import DISARMED_S


def run(lab, _quick):
    name = "a second station with system 255 keeps it from arming"
    with attempt(name), Flight(lab, "forward", system=255) as flight:
        why = lambda: flight.runtime.has("255")
        flight.until("the runtime's sentence, or the climb", lambda: why() or flight.wire.armed())
        # By then the rest is ready: the autopilot, its poses and images.
        start = flight.poses.now().stamp_s
        flight.until("a while on the ground",
                     lambda: flight.poses.now().stamp_s > start + DISARMED_S or flight.wire.armed())
        armed = any(beat.armed for beat in flight.wire.beats)
        check(name, not armed and why(), flight.said())
