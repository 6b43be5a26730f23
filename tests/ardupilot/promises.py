"""What a vehicle promises, in figures. The one place to change them; docs/guides says the same in words."""

# After a loss that something beside the autopilot answers: down within so long, having drifted by so far. [s], [m]
DOWN_WITHIN_S = 5.0
DRIFT_M = 0.5
# And by so long a way at the speed that was flown. [s]
DRIFT_S = 0.8

# Losses that only the autopilot is left to answer: down as rows of docs/guides/failsafe.md say, or so much later. [s]
AUTOPILOT_ALONE = {"MAVLink cut": "Wi-Fi dies"}
AS_WRITTEN_S = 1.0

# How far the body may be outside the fence. [m]
OUTSIDE_M = 0.0

# For so long after a pilot's word the runtime is listened to. [s]
HANDS_OFF_S = 4.0

# For so long a vehicle that must not arm is watched. [s]
DISARMED_S = 6.0


def drift_m(speed_mps):
    return DRIFT_M + DRIFT_S * speed_mps
