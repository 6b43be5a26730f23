"""Guaranteed limits of a vehicle. Change them only here; docs/guides describes them in words."""

# After a loss that a component other than the autopilot handles: maximum time to landing, maximum drift. [s], [m]
DOWN_WITHIN_S = 5.0
DRIFT_M = 0.5
# And in addition to the drift, this time multiplied by the speed of flight. [s]
DRIFT_S = 0.8

# Losses that only the autopilot can handle: time to landing as in docs/guides/failsafe.md, plus a tolerance. [s]
AUTOPILOT_ALONE = {"MAVLink cut": "Wi-Fi dies"}
AS_WRITTEN_S = 1.0

# Maximum distance of the body outside the fence. [m]
OUTSIDE_M = 0.0

# Time after a pilot's override in which the runtime's commands are recorded. [s]
HANDS_OFF_S = 4.0

# Time for which a vehicle that must not arm is observed. [s]
DISARMED_S = 6.0


def drift_m(speed_mps):
    return DRIFT_M + DRIFT_S * speed_mps
