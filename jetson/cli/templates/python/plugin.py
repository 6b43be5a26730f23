"""{{name}}: climbs to 1 m and follows the depth gradient: it turns to where there is more room.

Fly it:   vizflyt fly {{folder}}
Test it:  .venv/bin/python3 -m unittest
"""

import numpy as np
import vizflyt

HEIGHT_M = 1.0  # height to fly at
FAR_M = 8.0  # farther than this, and where nothing is seen, all is the same
STOP_M = 1.2  # nearer than this, only turn


def steer(depth_m, height_m):
    """Says where to fly by one depth image.

    depth_m: (H, W) float32, metres along the camera's axis; 0 where nothing is seen.
    height_m: above the floor, or None where the course withholds it.
    Returns the velocity (forward, left, up) in m/s and the turn rate in rad/s, left positive.
    """
    depth_m = np.where(depth_m > 0, np.minimum(depth_m, FAR_M), FAR_M)
    rows, columns = depth_m.shape
    band = depth_m[rows // 3 : 2 * rows // 3]  # at the vehicle's own height
    profile = band.mean(axis=0)  # room by column, left to right

    # The gradient: how much the depth grows from the middle to the right edge, by least squares.
    x = np.linspace(-1.0, 1.0, columns)
    gradient_m = float(x @ profile / (x @ x))

    ahead_m = float(np.percentile(band[:, columns // 3 : 2 * columns // 3], 5))
    forward_mps = np.clip(0.5 * (ahead_m - STOP_M), 0.0, 1.0)
    turn_radps = np.clip(-0.4 * gradient_m, -1.0, 1.0)
    if ahead_m < STOP_M:
        # A wall: turn on until there is room.
        turn_radps = -0.8 if gradient_m > 0 else 0.8
    up_mps = 0.0 if height_m is None else np.clip(HEIGHT_M - height_m, -0.5, 0.5)
    return (float(forward_mps), 0.0, float(up_mps)), float(turn_radps)


class {{class}}(vizflyt.Plugin):
    def on_start(self, info):
        print("cameras:", ", ".join(camera.name for camera in info.cameras))

    def on_image(self, obs):
        front = obs.camera("front")
        if front is None:
            return None  # no image yet
        pose = obs.vehicle.world_from_body if obs.vehicle is not None else None
        height_m = float(pose.translation_m[2]) if pose is not None else None
        velocity_mps, turn_radps = steer(front.depth, height_m)
        return vizflyt.Setpoint.velocity(velocity_mps, axes="heading", yaw_rate=turn_radps)


if __name__ == "__main__":
    vizflyt.run({{class}})
