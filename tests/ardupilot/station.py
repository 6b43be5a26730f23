"""A second station whose system is 255 would hide from the autopilot that the runtime is gone: nothing is armed."""

from checks import attempt, check
from lab import Flight
from promises import DISARMED_S


def run(lab, _quick):
    name = "a second station with system 255 keeps it from arming"
    with attempt(name), Flight(lab, "forward", system=255) as flight:
        why = lambda: flight.runtime.has("255")
        flight.until("the runtime's sentence, or the climb", lambda: why() or flight.wire.armed())
        # It is ready for all else by then: the autopilot, its poses and images.
        start = flight.poses.now().stamp_s
        flight.until("a while on the ground",
                     lambda: flight.poses.now().stamp_s > start + DISARMED_S or flight.wire.armed())
        armed = any(beat.armed for beat in flight.wire.beats)
        check(name, not armed and why(), flight.said())
