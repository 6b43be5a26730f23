"""{{name}}: climbs to 1 m, flies forward, and turns towards larger depth.

Fly it:   vizflyt fly {{folder}}
Test it:  .venv/bin/python3 -m unittest
"""

import numpy as np
import vizflyt

HEIGHT_M = 1.0  # height to fly at
FAR_M = 8.0  # limit of depth; pixels without a return count as this far
STOP_M = 1.2  # below this distance, only turn


def steer(depth_m, height_m):
    """Returns a velocity and a turn rate for one depth image.

    depth_m: (H, W) float32, metres along the camera's axis; 0 means no return.
    height_m: above the floor, or None if the course withholds it.
    The velocity is (forward, left, up) in m/s; the turn rate is in rad/s, positive to the left.
    """
    depth_m = np.where(depth_m > 0, np.minimum(depth_m, FAR_M), FAR_M)
    rows, columns = depth_m.shape
    band = depth_m[rows // 3 : 2 * rows // 3]  # at the height of the vehicle
    profile = band.mean(axis=0)  # mean depth of each column, left to right

    # Gradient: the slope of the depth from the middle to the right edge, by least squares.
    x = np.linspace(-1.0, 1.0, columns)
    gradient_m = float(x @ profile / (x @ x))

    ahead_m = float(np.percentile(band[:, columns // 3 : 2 * columns // 3], 5))
    forward_mps = np.clip(0.5 * (ahead_m - STOP_M), 0.0, 1.0)
    turn_radps = np.clip(-0.4 * gradient_m, -1.0, 1.0)
    if ahead_m < STOP_M:
        # A wall: turn until there is free space.
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
