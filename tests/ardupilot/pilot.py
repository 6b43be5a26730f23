"""Pilot override: as soon as a mode set by the runtime was confirmed, any other mode means hands off, in every
phase."""

import time

from checks import attempt, check, skip, wait
from lab import Flight
from promises import HANDS_OFF_S

MODES = {"ALT_HOLD": 2, "LOITER": 5, "BRAKE": 17, "LAND": 9, "STABILIZE": 0, "RTL": 6}
GUIDED, LAND = 4, 9
PHASES = ("take-off", "flight", "landing")
# Heights in the climb, and in the landing while a takeover is still possible. [m]
CLIMBED_M, LOW_M = 0.3, 0.9
# Time limit for the vehicle to change its mode. [s]
TAKES_S = 3.0


def cases():
    for phase in PHASES:
        for mode in MODES:
            # LAND during the landing is not a different mode.
            if (phase, mode) != ("landing", "LAND"):
                yield phase, mode


def run(lab, quick):
    chosen = [("take-off", "ALT_HOLD"), ("landing", "LOITER")] if quick else list(cases())
    for source in ("RC", "station"):
        name = f"{source} says another mode"
        if source == "RC" and not lab.vehicle.is_real:
            skip(name, "the simulator has no switch to turn")
            continue
        for phase, mode in chosen:
            fly(lab, source, phase, mode)


def fly(lab, source, phase, mode):
    name = f"hands off after {mode} by {source} in {phase}"
    with attempt(name), Flight(lab, "late-land" if phase == "landing" else "forward") as flight:
        if source == "RC":
            # Before that, the switch is at another mode, which does not count until the switch moves.
            flight.vehicle.switch("ALT_HOLD" if mode == "STABILIZE" else "STABILIZE")
        come_to(flight, phase)
        number, told = MODES[mode], time.monotonic()
        if source == "RC":
            flight.vehicle.switch(mode)
        else:
            flight.station.set_mode(number)
        # The first mode that the vehicle reports, before the runtime may have overridden it.
        taken = lambda: next((b for b in flight.wire.beats if b.at > told and b.mode == number), None)
        end = time.monotonic() + TAKES_S
        while not taken() and time.monotonic() < end:
            time.sleep(0.005)
        if not taken():
            texts = flight.station.texts[-2:]
            skip(name, f"the vehicle takes no {mode} then ({'; '.join(texts) or 'it says nothing'})")
            return
        end = taken().at + HANDS_OFF_S
        wait("the pilot's flight", lambda: time.monotonic() > end, HANDS_OFF_S + 5)
        orders = [order for order in flight.wire.orders if order.at > taken().at]
        modes = {beat.mode for beat in flight.wire.beats if beat.at > taken().at} - {number}
        said = mode == "LAND" or flight.runtime.has("hands off")
        detail = [f"{order.name} {order.mode} after {(order.at - taken().at) * 1e3:.0f} ms" for order in orders[:3]]
        if modes:
            detail.append(f"then modes {sorted(modes)}, {'by the runtime' if orders else 'by the autopilot itself'}")
        if not said:
            detail.append(f"it does not say so: {flight.said()}")
        check(name, not orders and said, ", ".join(detail))


def come_to(flight, phase):
    """Flies to the phase of the takeover; the runtime's own mode was confirmed by then."""
    flight.until("GUIDED", lambda: flight.wire.mode() == GUIDED)
    if phase == "take-off":
        flight.until("the climb", lambda: flight.height_m() > CLIMBED_M)
        flight.vehicle.lift()
        return
    flight.until("the flight", lambda: flight.phase("flying"))
    flight.vehicle.lift()
    if phase == "flight":
        start = flight.poses.now().stamp_s
        flight.until("a second of flight", lambda: flight.poses.now().stamp_s > start + 1.0)
    else:
        flight.until("the landing", lambda: flight.wire.mode() == LAND and flight.height_m() < LOW_M)
