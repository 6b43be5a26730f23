"""Tests of sight.py, without a flight."""

import numpy as np
import sight

import vizflyt

CAMERA = vizflyt.Intrinsics.from_horizontal_fov(320, 240, np.pi / 2)
# A level camera along world x: right is -y, down is -z.
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CAMERA_M = np.array([2.0, 1.0, 1.2])


def seen(depth_mm):
    return sight.obstacles(depth_mm.astype(np.uint16), sight.Rays(CAMERA), LEVEL, CAMERA_M, 0.7, 1.7)


def test_an_obstacle_is_where_it_stands():
    """So far fails: there are no obstacles. A trunk of 20 columns, 4 m ahead; its nearest point counts."""
    depth_mm = np.full((240, 320), 9000)
    depth_mm[:, 150:170] = 4000
    points_m = seen(depth_mm)
    trunk = points_m[points_m[:, 0] < 7.0]
    assert len(points_m) == 320 and len(trunk) == 20
    np.testing.assert_allclose(trunk[:, 0], 6.0, atol=0.01)
    assert 0.72 < trunk[:, 1].min() < 0.78 and 1.22 < trunk[:, 1].max() < 1.28


def test_floor_crowns_distance_and_no_return_are_no_obstacles():
    """A floor 1.2 m below, a crown above the band, a distance of 20 m, and 0 are not obstacles."""
    rows = np.arange(240)[:, None] + 0.5 - CAMERA.cy_px
    down = np.where(rows > 0, CAMERA.fy_px * 1200.0 / np.maximum(rows, 1e-9), 0.0)
    floor_mm = np.broadcast_to(np.where(down < 60_000, down, 0.0), (240, 320))
    for depth_mm in (floor_mm, np.zeros((240, 320)), np.full((240, 320), 20_000)):
        assert len(seen(depth_mm)) == 0
    above = np.zeros((240, 320))
    above[:60] = 3000
    assert len(seen(above)) == 0


def test_two_pixels_are_no_obstacle():
    """So far fails: there are no obstacles. The surface behind the two pixels is an obstacle."""
    depth_mm = np.full((240, 320), 9000)
    depth_mm[118:122:2, 40] = 1500
    points_m = seen(depth_mm)
    assert len(points_m) == 320 and points_m[:, 0].min() > 10.9


def test_a_map_keeps_what_is_out_of_sight_and_forgets_what_is_seen_through():
    known = sight.Map(np.array([-1.0, -7.0]), np.array([41.0, 7.0]))
    for _ in range(3):
        known.add(np.array([[6.03, 1.04], [1.04, 1.04]]))
    known.measure(CAMERA_M[:2], 20.0)
    assert known.room_m(np.array([6.05, 1.05])) == 0.0
    np.testing.assert_allclose(known.room_m(np.array([[6.05, 1.65], [9.0, 1.0]])), [0.6, 1.2], atol=1e-3)
    for _ in range(3):
        known.see_through(np.full((240, 320), 9000, np.uint16), CAMERA, LEVEL, CAMERA_M, 1.2)
    known.measure(CAMERA_M[:2], 20.0)
    np.testing.assert_allclose(known.room_m(np.array([[6.05, 1.05], [1.05, 1.05]])), [1.2, 0.0], atol=1e-3)
