"""Inside the net: the true body stays inside the fence for every command of the plugin."""

from checks import attempt, check
from lab import Flight
from promises import OUTSIDE_M

# Half a metre per second above the arena's limit, so that the guard's limit applies. [m/s]
ASKED_MPS = 3.0
BODY_RADIUS_M = 0.12
# Each face: its name, its axis, the direction, and a start with a long run-up.
FACES = {
    "east": (0, 1, (0.9, 0.0, 0.0)),
    "west": (0, -1, (10.1, 0.0, 0.0)),
    "north": (1, 1, (5.0, -1.6, 0.0)),
    "south": (1, -1, (5.0, 1.6, 0.0)),
}
# Time until the vehicle stops before the face, or hangs in the net. [s]
WATCHED_S = 14.0
STANDS_MPS = 0.05


def run(lab, quick):
    for name in ("east",) if quick else FACES:
        fly(lab, name, *FACES[name])


def fly(lab, name, axis, sign, spawn):
    velocity = ["0", "0"]
    velocity[axis] = "%g" % (sign * ASKED_MPS)
    check_name = f"asked for {ASKED_MPS:g} m/s to the {name}, it stays in the net"
    with attempt(check_name), Flight(lab, "world:" + ":".join(velocity), spawn) as flight:
        flight.until("the flight", lambda: flight.phase("flying"))
        start = flight.poses.now().stamp_s
        moved = lambda: abs(flight.poses.now().p[axis] - spawn[axis]) > 1.0
        stands = lambda: moved() and flight.poses.speed_mps() < STANDS_MPS
        over = lambda: flight.poses.now().stamp_s > start + WATCHED_S
        flight.until("the vehicle before the face", lambda: stands() or over() or flight.phase("landed"), 60)
        # It may swing back and return.
        stood = flight.poses.now().stamp_s
        flight.until("a while there", lambda: flight.poses.now().stamp_s > stood + 2.0 or flight.phase("landed"), 30)
        track = flight.poses.since(start)
        face = flight.fence[sign > 0][axis]
        outside = max(sign * (sight.p[axis] - face) for sight in track) + BODY_RADIUS_M
        fastest = max((b.p[axis] - a.p[axis]) * sign / (b.stamp_s - a.stamp_s) for a, b in zip(track, track[10:]))
        has_landed = flight.phase("landed") or any(beat.mode == 9 for beat in flight.wire.beats)
        landed = f", LAND: {flight.said()}" if has_landed else ""
        where = "%.2f m %s" % (abs(outside), "outside" if outside > 0 else "inside")
        # A vehicle that lands before the face proves nothing about the fence.
        check(check_name, outside <= OUTSIDE_M and not landed,
              f"the body came to {where}, {fastest:.1f} m/s at most{landed}")
