#!/usr/bin/env python3
"""Flies to the goal through a forest with a potential field on the depth image.

The same algorithm and numbers as the Rust plugin in jetson/plugins/avoid, where each number has a comment with its
reason. Steps at every image:

1. scan: convert depth pixels to obstacle points in the world frame, without floor and sky;
2. memory: keep the points of the last seconds, because the camera no longer sees some of them;
3. field: compute the distance to obstacles and (10 times per second) the length of the way to the goal;
4. steer: choose the velocity with the most progress and enough clearance;
5. height, heading and arrival; return the velocity as a setpoint.

All arithmetic uses numpy on complete arrays: about 5 ms per image. A Python loop over pixels would take a second.
"""

import math

import numpy as np

import vizflyt
from vizflyt import Setpoint

# --- flight
CRUISE_MPS = 3.6
CRUISE_SHARE = 0.7
BRAKE_MPS2 = 2.5
ARRIVED = 0.5
MAX_LEAD_MPS = 1.6
MAX_DT_S = 0.1
BLIND_S = 0.3
USUAL_GAP_S = 0.04
GAP_FORGOTTEN_PER_S = 0.1
BLIND_WAY_M = 0.2
CLIMB_PER_S = 1.5
CLIMB_MPS = 1.0
LOOK_MPS = 0.3
# --- scan
COLUMNS = 80
FAR_M = 9.0
NEAR_M = 0.1
BINS_PER_OCTAVE = 9.0
BINS = 60
SUPPORT = 3
HALF_BAND_M = 0.45
FLOOR_M = 0.3
FLOOR_RATIO = 0.03
SEE_THROUGH_M = 0.25
SEE_THROUGH_RATIO = 0.05
BLIND_FRACTION = 0.05
# --- memory
KEEP_S = 15.0
KEEP_M = 9.0
MERGE_M = 0.15
MAX_POINTS = 512
# --- field
CELL_M = 0.25
SIDE = 64
COMFORT_M = 0.7
TOUCH_M = 0.08
FENCE_MARGIN_M = 0.3
COST_OF_DISCOMFORT = 4.0
COST_OF_TOUCH = 60.0
UNREACHED_M = 1e6
SETTLED_M = 0.02
MAX_ROUNDS = 8
# The Rust plugin sweeps the complete field at every image (0.4 ms), this one 10 times per second (8 ms). At 3.6 m/s the
# vehicle moves by 1.5 cells in that time. [s]
WAY_EVERY_S = 0.1
# --- steer
DIRECTIONS = 72
SPEEDS = 5
STEPS = 15
STEP_S = 0.1
LATENCY_S = 0.08
LAG_S = 0.35
SLEW_MPS2 = 3.5
IN_SIGHT_RAD = 0.7
UNSEEN_MPS = 1.2
HIT_MPS = 100.0
WANTED_M = 0.3
WANTED_PER_MPS = 0.06
REPULSION_MPS = 8.0
INERTIA = 0.05


class Avoid(vizflyt.Plugin):
    def on_start(self, info):
        self.info = info
        self.memory = Memory()
        self.field = Field(info)
        self.setpoint_mps = np.zeros(2)
        self.last_s = None
        self.longest_gap_s = 0.0
        self.seen_s = -math.inf
        self.finished = False

    def on_event(self, event):
        if event.kind == "finished":
            self.finished = True

    def on_image(self, obs):
        goal_m = self.info.goal_m
        if goal_m is None or self.finished:
            return Setpoint.hold()
        vehicle = obs.vehicle
        camera = obs.camera("front")
        # Without a pose, return no setpoint: the guard holds, then lands.
        if vehicle is None or vehicle.p_world_m is None or camera is None:
            return None
        now_s = vehicle.stamp_ns * 1e-9
        gap_s = 0.0 if self.last_s is None else min(max(now_s - self.last_s, 0.0), BLIND_S)
        dt_s = min(gap_s, MAX_DT_S)
        self.last_s = now_s
        # The longest gap decays over seconds, because gaps usually come in series.
        self.longest_gap_s = max(gap_s, self.longest_gap_s - GAP_FORGOTTEN_PER_S * gap_s)
        late_s = max(self.longest_gap_s - USUAL_GAP_S, 0.0)

        # 1. Update the map.
        p_m, v_mps = vehicle.p_world_m, vehicle.v_world_mps
        view = View(vehicle, camera)
        points_m, valid_fraction = scan(view, p_m[2])
        if valid_fraction >= BLIND_FRACTION:
            self.seen_s = now_s
        self.memory.update(now_s, view, points_m)

        # 2. Compute the field.
        self.field.update(now_s, p_m, goal_m[:2], self.memory.points_m)

        # 3. Choose a velocity.
        to_goal_m = (goal_m - p_m)[:2]
        distance_m = math.hypot(*to_goal_m)
        if distance_m < ARRIVED * self.info.goal_radius_m:
            self.setpoint_mps = v_mps[:2]
            return Setpoint.position(goal_m)
        # Before take-off the vehicle does not follow the setpoint, so limit their difference.
        lead_mps = shortened(self.setpoint_mps - v_mps[:2], MAX_LEAD_MPS)
        setpoint_mps = v_mps[:2] + lead_mps
        wanted_mps = np.zeros(2)
        if now_s - self.seen_s < BLIND_S:
            cruise_mps = min(CRUISE_MPS, CRUISE_SHARE * self.info.limits.max_speed_mps)
            stop_mps = math.sqrt(2.0 * BRAKE_MPS2 * distance_m)
            heading_rad = vehicle.yaw_rad
            # Between two images the last setpoint stays in force: limit the distance flown with it.
            blind_mps = BLIND_WAY_M / late_s if late_s > 0.0 else math.inf
            speed_mps = min(cruise_mps, stop_mps, blind_mps)
            wanted_mps = choose_velocity(
                self.field, p_m[:2], v_mps[:2], setpoint_mps, heading_rad, speed_mps, late_s
            )
        self.setpoint_mps = setpoint_mps + shortened(wanted_mps - setpoint_mps, SLEW_MPS2 * dt_s)

        climb_mps = min(max(CLIMB_PER_S * (goal_m[2] - p_m[2]), -CLIMB_MPS), CLIMB_MPS)
        look = wanted_mps if math.hypot(*wanted_mps) > LOOK_MPS else to_goal_m
        return Setpoint.velocity([*self.setpoint_mps, climb_mps], yaw=math.atan2(look[1], look[0]))


def shortened(vector, length):
    """Returns the vector, shortened to at most `length`."""
    now = math.hypot(*vector)
    return vector if now <= length else vector * (length / now)


class View:
    """A depth image and the pose of its camera. The vehicle's state is some milliseconds newer or older than the image;
    it is extrapolated with constant velocity and angular velocity."""

    def __init__(self, vehicle, camera):
        ahead_s = (camera.stamp_ns - vehicle.stamp_ns) * 1e-9
        ahead_s = min(max(ahead_s, -BLIND_S), BLIND_S)
        self.depth_mm = camera.depth_mm  # (H, W) uint16, 0: no return
        self.k = camera.intrinsics
        now = vehicle.world_from_body
        body_from_cam = camera.body_from_cam
        turn = rotation_matrix(vehicle.omega_body_radps * ahead_s)
        world_from_body = now.rotation_matrix @ turn
        self.origin_m = (
            now.translation_m
            + vehicle.v_world_mps * ahead_s
            + world_from_body @ body_from_cam.translation_m
        )
        # Columns: the camera's right, down and forward axes in world axes.
        self.axes = world_from_body @ body_from_cam.rotation_matrix

    def sees_through(self, points_m):
        """Returns for each point (N, 3) whether the image shows a surface well behind it, so that the point is free.
        Pixels without a return do not count, because they do not prove free space."""
        k, (height, width) = self.k, self.depth_mm.shape
        p_cam_m = (points_m - self.origin_m) @ self.axes
        z_m = np.maximum(p_cam_m[:, 2], 1e-6)
        x = k.fx_px * p_cam_m[:, 0] / z_m + k.cx_px
        y = k.fy_px * p_cam_m[:, 1] / z_m + k.cy_px
        ahead = (p_cam_m[:, 2] > 0) & (x >= 2) & (y >= 2) & (x < width - 2) & (y < height - 2)
        column = np.where(ahead, x, 2).astype(int)
        row = np.where(ahead, y, 2).astype(int)
        behind_m = z_m * (1.0 + SEE_THROUGH_RATIO) + SEE_THROUGH_M
        # Check the point and four neighbours, because one pixel next to a trunk's edge proves nothing.
        for dx, dy in ((0, 0), (-2, 0), (2, 0), (0, -2), (0, 2)):
            ahead &= self.depth_mm[row + dy, column + dx] * 1e-3 > behind_m
        return ahead


def rotation_matrix(turn_rad):
    """Returns the rotation by a small vector (Rodrigues). [rad]"""
    angle = math.sqrt(turn_rad @ turn_rad)
    if angle < 1e-9:
        return np.eye(3)
    x, y, z = turn_rad / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def scan(view, flight_z_m):
    """Returns obstacle points (N, 3) [m, world], at most one per vertical strip of the image: the nearest surface
    between the floor and a little above the vehicle. Also returns the fraction of pixels with a return."""
    k = view.k
    height, width = view.depth_mm.shape
    columns = min(COLUMNS, width)
    stride_x, stride_y = max(width // 160, 1), max(height // 120, 1)
    depth_m = view.depth_mm[::stride_y, ::stride_x] * np.float32(1e-3)
    x, y = np.arange(0, width, stride_x), np.arange(0, height, stride_y)
    right, down, forward = view.axes.T.astype(np.float32)
    a = ((x + 0.5 - k.cx_px) / k.fx_px).astype(np.float32)
    b = ((y + 0.5 - k.cy_px) / k.fy_px).astype(np.float32)

    # A pixel (x, y) at depth d lies at origin + d * (forward + right * a(x) + down * b(y)).
    ox, oy, oz = (
        depth_m * (forward[i] + right[i] * a[None, :] + down[i] * b[:, None]) for i in range(3)
    )
    range_m = np.sqrt(ox * ox + oy * oy)
    z_m = oz + np.float32(view.origin_m[2])
    hit = (
        (depth_m > 0)
        & (range_m < FAR_M)
        & (z_m > FLOOR_M + FLOOR_RATIO * range_m)
        & (np.abs(z_m - flight_z_m) < HALF_BAND_M)
    )
    valid_fraction = np.count_nonzero(depth_m) / max(depth_m.size, 1)
    row, column = np.nonzero(hit)
    octaves = np.log2(np.maximum(range_m[row, column], NEAR_M) / NEAR_M)
    distance = np.minimum((octaves * BINS_PER_OCTAVE).astype(int), BINS - 1)
    at = (x[column] * columns // width) * BINS + distance

    def binned(weights=None):
        return np.bincount(at, weights, columns * BINS).reshape(columns, BINS)

    count = binned()
    # Add two neighbouring bins, because a surface may lie on their border.
    pair = count[:, :-1] + count[:, 1:]
    strip = np.nonzero((pair >= SUPPORT).any(axis=1))[0]
    near = (pair[strip] >= SUPPORT).argmax(axis=1)
    alone = count[strip, near] >= SUPPORT
    total = count[strip, near] + np.where(alone, 0, count[strip, near + 1])
    points_m = np.empty((len(strip), 3))
    for i, offset in enumerate((ox, oy, oz)):
        sums = binned(offset[row, column])
        sums = sums[strip, near] + np.where(alone, 0, sums[strip, near + 1])
        points_m[:, i] = view.origin_m[i] + sums / total
    return points_m, valid_fraction


class Memory:
    """Obstacle points of the last seconds, in the world frame. A point is kept until it is old, far away, or the camera
    sees through its position."""

    def __init__(self):
        self.points_m = np.empty((0, 3))
        self.range_m = np.empty(0)  # at the sighting that placed the point; nearer is more exact
        self.seen_s = np.empty(0)

    def update(self, now_s, view, points_m):
        far_m = np.linalg.norm(self.points_m - view.origin_m, axis=1)
        keep = (now_s - self.seen_s < KEEP_S) & (far_m < KEEP_M)
        keep &= ~view.sees_through(self.points_m)
        self._select(keep)

        range_m = np.linalg.norm(points_m - view.origin_m, axis=1)
        if len(points_m) and len(self.points_m):
            gap_m = np.linalg.norm(points_m[:, None, :2] - self.points_m[None, :, :2], axis=2)
            nearest = gap_m.argmin(axis=1)
            same = gap_m[np.arange(len(points_m)), nearest] < MERGE_M
            known = nearest[same]
            self.seen_s[known] = now_s
            better = range_m[same] < self.range_m[known]
            self.points_m[known[better]] = points_m[same][better]
            self.range_m[known[better]] = range_m[same][better]
            points_m, range_m = points_m[~same], range_m[~same]
        # Neighbouring strips of one trunk give only one point.
        _, first = np.unique(np.round(points_m[:, :2] / MERGE_M), axis=0, return_index=True)
        self.points_m = np.concatenate([self.points_m, points_m[first]])
        self.range_m = np.concatenate([self.range_m, range_m[first]])
        self.seen_s = np.concatenate([self.seen_s, np.full(len(first), now_s)])
        if len(self.seen_s) > MAX_POINTS:
            self._select(np.argsort(self.seen_s)[-MAX_POINTS:])

    def _select(self, which):
        self.points_m = self.points_m[which]
        self.range_m = self.range_m[which]
        self.seen_s = self.seen_s[which]


class Field:
    """Clearance and distance to the goal for every point within 8 m.

    The way to the goal is the shortest one around all remembered obstacles, where a metre close to an obstacle counts
    several times. The only minimum of this potential is the goal. It solves the eikonal equation |grad T| = cost by
    fast sweeping (H. Zhao, Math. Comp. 74, 2005).
    """

    def __init__(self, info):
        self.info = info
        self.origin_m = np.zeros(2)
        self.clearance_m = np.zeros((SIDE, SIDE))  # row y, column x
        self.to_go_m = np.zeros((SIDE, SIDE))
        self.way_origin_m = np.zeros(2)
        self.way_at_s = -math.inf
        # Cell offsets around a point, up to its reach.
        self.reach_m = COMFORT_M + info.body_radius_m
        reach = math.ceil(self.reach_m / CELL_M) + 1
        self.around = np.arange(-reach, reach + 1)

    def update(self, now_s, p_m, goal_m, points_m):
        # Aligned to whole cells, so that the same obstacle is in the same cells in every image.
        half_m = CELL_M * (SIDE - 1) / 2
        self.origin_m = np.round((p_m[:2] - half_m) / CELL_M) * CELL_M
        self._fill_clearance(p_m[2], points_m)
        if now_s - self.way_at_s >= WAY_EVERY_S:
            self.way_at_s = now_s
            self._fill_to_go(goal_m)

    def clearance_at(self, p_m):
        """Returns the distance from the body to the nearest obstacle at points (N, 2). [m]"""
        return interpolate(self.clearance_m, self.origin_m, p_m)

    def to_go_at(self, p_m):
        """Returns the length of the way to the goal from points (N, 2). [m]"""
        return interpolate(self.to_go_m, self.way_origin_m, p_m)

    def _fill_clearance(self, z_m, points_m):
        axis = np.arange(SIDE) * CELL_M
        x, y = np.meshgrid(self.origin_m[0] + axis, self.origin_m[1] + axis)
        cells_m = np.stack([x.ravel(), y.ravel(), np.full(SIDE * SIDE, z_m)], axis=1)
        inside_m = -self.info.geofence.signed_distance_m(cells_m).reshape(SIDE, SIDE)
        body_m = self.info.body_radius_m
        clearance_m = np.minimum(inside_m - body_m - FENCE_MARGIN_M, COMFORT_M)
        if len(points_m):
            at = (points_m[:, :2] - self.origin_m) / CELL_M
            nearest = np.round(at).astype(int)
            column = nearest[:, 0, None, None] + self.around[None, None, :]
            row = nearest[:, 1, None, None] + self.around[None, :, None]
            dx = column - at[:, 0, None, None]
            dy = row - at[:, 1, None, None]
            distance_m = CELL_M * np.sqrt(dx * dx + dy * dy) - body_m
            on_grid = (column >= 0) & (column < SIDE) & (row >= 0) & (row < SIDE)
            on_grid &= distance_m < COMFORT_M
            np.minimum.at(
                clearance_m.reshape(-1), (row * SIDE + column)[on_grid], distance_m[on_grid]
            )
        self.clearance_m = clearance_m

    def _fill_to_go(self, goal_m):
        self.way_origin_m = self.origin_m
        discomfort = np.maximum(1.0 - self.clearance_m / COMFORT_M, 0.0)
        cost = 1.0 + COST_OF_DISCOMFORT * discomfort * discomfort
        step_m = CELL_M * np.where(self.clearance_m < TOUCH_M, COST_OF_TOUCH, cost)
        # With a border of one cell that blocks all ways.
        to_go_m = np.full((SIDE + 2, SIDE + 2), UNREACHED_M)
        inner = to_go_m[1:-1, 1:-1]
        goal_cell = (goal_m - self.origin_m) / CELL_M
        if (goal_cell >= 0).all() and (goal_cell <= SIDE - 1).all():
            column, row = np.round(goal_cell).astype(int)
            inner[row, column] = 0.0
        else:
            # The goal is outside the grid: leave over an edge on the goal's side, then fly straight.
            faces = np.zeros((SIDE, SIDE), bool)
            faces[:, 0] |= goal_cell[0] < 0
            faces[:, -1] |= goal_cell[0] > SIDE - 1
            faces[0, :] |= goal_cell[1] < 0
            faces[-1, :] |= goal_cell[1] > SIDE - 1
            row, column = np.nonzero(faces & (self.clearance_m > TOUCH_M))
            inner[row, column] = CELL_M * np.hypot(column - goal_cell[0], row - goal_cell[1])
        for _ in range(MAX_ROUNDS):
            before = inner.copy()
            # The same sweep on the grid rotated by 90 degrees covers all four directions.
            for turned in range(4):
                sweep(np.rot90(to_go_m, turned), np.rot90(step_m, turned))
            if (before - inner).max() < SETTLED_M:
                break
        self.to_go_m = inner


def sweep(to_go_m, step_m):
    """Updates every row from the row above, in place. If the way comes from a point between the cell above and its
    neighbour: T = above + sqrt(step^2 - (above - beside)^2)."""
    diagonal_m, half_m = step_m * math.sqrt(2.0), step_m / math.sqrt(2.0)
    for row in range(SIDE):
        above = to_go_m[row, 1:-1]
        beside = np.minimum(to_go_m[row, :-2], to_go_m[row, 2:])
        step = step_m[row]
        lead = np.maximum(above - beside, 0.0)
        between = above + np.sqrt(np.maximum(step * step - lead * lead, 0.0))
        new = np.where(lead < half_m[row], between, beside + diagonal_m[row])
        here = to_go_m[row + 1, 1:-1]
        np.minimum(here, new, out=here)


def interpolate(values, origin_m, p_m):
    """Interpolates bilinearly; constant outside the grid."""
    cell = np.clip((p_m - origin_m) / CELL_M, 0.0, SIDE - 1.0)
    corner = np.minimum(cell.astype(np.intp), SIDE - 2)
    fx, fy = (cell - corner).T
    at = corner[:, 1] * SIDE + corner[:, 0]
    flat = values.ravel()
    a, b, c, d = flat[at], flat[at + 1], flat[at + SIDE], flat[at + SIDE + 1]
    low = a + fx * (b - a)
    return low + fy * (c + fx * (d - c) - low)


def choose_velocity(field, p_m, v_mps, setpoint_mps, heading_rad, max_speed_mps, late_s=0.0):
    """Returns the best velocity (2,). Every candidate is simulated for 1.5 s with the lag and acceleration of a real
    vehicle (compare D. Fox et al., IEEE RAM 4(1), 1997). [m/s, world]"""
    # The first candidate is zero. The ring starts at the last velocity, so that keeping it is another candidate.
    start_rad = math.atan2(setpoint_mps[1], setpoint_mps[0])
    angle = start_rad + 2 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS
    off = np.abs((angle - heading_rad + math.pi) % (2 * math.pi) - math.pi)
    # Obstacles outside the image may be new, so limit the speed there.
    cap_mps = np.where(off < IN_SIGHT_RAD, max_speed_mps, min(UNSEEN_MPS, max_speed_mps))
    speed = cap_mps[:, None] * np.arange(1, SPEEDS + 1) / SPEEDS
    ring = np.stack([speed * np.cos(angle)[:, None], speed * np.sin(angle)[:, None]], axis=2)
    wanted = np.concatenate([np.zeros((1, 2)), ring.reshape(-1, 2)])

    count = len(wanted)
    p = np.tile(p_m + v_mps * (LATENCY_S + late_s), (count, 1))  # the setpoint takes effect later
    v = np.tile(v_mps, (count, 1))
    asked = np.tile(setpoint_mps, (count, 1))
    start_m = field.to_go_at(p[:1])[0]
    nearest_m = np.full(count, start_m)
    worst = np.zeros(count)
    hit = np.full(count, -math.inf)
    for step in range(STEPS):
        change = wanted - asked
        length = np.hypot(change[:, 0], change[:, 1])
        share = np.minimum(1.0, SLEW_MPS2 * STEP_S / np.maximum(length, 1e-9))
        asked += change * share[:, None]
        v += (asked - v) * (STEP_S / (LAG_S + STEP_S))
        p += v * STEP_S
        clearance_m = field.clearance_at(p)
        speed_mps = np.hypot(v[:, 0], v[:, 1])
        # Collision. A later, slower and more glancing one gets a better score.
        first = (clearance_m < TOUCH_M) & np.isneginf(hit)
        left = (STEPS - step) / STEPS
        fault = -HIT_MPS * (1.0 + left) - speed_mps + np.maximum(clearance_m, -1.0)
        hit = np.where(first, fault, hit)
        wanted_m = WANTED_M + WANTED_PER_MPS * speed_mps
        worst = np.maximum(worst, 1.0 - clearance_m / wanted_m)
        nearest_m = np.minimum(nearest_m, field.to_go_at(p))
    gain_mps = (start_m - nearest_m) / (STEPS * STEP_S)
    change = wanted - setpoint_mps
    change_mps = np.hypot(change[:, 0], change[:, 1])
    score = gain_mps - REPULSION_MPS * worst * worst - INERTIA * change_mps
    return wanted[np.where(np.isneginf(hit), score, hit).argmax()]


if __name__ == "__main__":
    vizflyt.run(Avoid)
