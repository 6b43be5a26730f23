"""Setpoints, poses, volumes: accepted values, and the one-sentence error for others."""

import math

import numpy as np
import pytest

import vizflyt
from vizflyt import Pose, Setpoint, Volume


class Tensor:
    """Replaces a torch tensor: numbers by the array protocol."""

    def __array__(self, dtype=None, copy=None):
        return np.array([1, 2, 3], dtype or np.float32)


@pytest.mark.parametrize("value", [[1, 2, 3], (1.0, 2.0, 3.0), np.array([1, 2, 3]), Tensor()])
def test_whatever_holds_three_numbers_is_a_vector(value):
    assert Setpoint.velocity(value) == Setpoint.velocity([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    "make, error, sentence",
    [
        (lambda: Setpoint.velocity("fast"), TypeError, "v_mps must be three numbers [x, y, z], not a str"),
        (lambda: Setpoint.velocity(None), TypeError, "v_mps must be three numbers [x, y, z], not None"),
        (lambda: Setpoint.velocity([1, 2]), ValueError, "v_mps must be three numbers [x, y, z], not a list of 2"),
        (
            lambda: Setpoint.velocity(np.zeros((3, 1))),
            ValueError,
            "v_mps must be three numbers [x, y, z], not a numpy.ndarray of shape (3, 1) and dtype float64",
        ),
        (
            lambda: Setpoint.velocity([math.nan, 0, 0]),
            ValueError,
            "v_mps is [NaN, 0.0, 0.0]: every number must be finite",
        ),
        (lambda: Setpoint.position([0, 0, math.inf]), ValueError, "p_world_m is [0.0, 0.0, inf]"),
        (
            lambda: Setpoint.velocity([1, 0, 0], axes="ned"),
            ValueError,
            "not 'ned'",
        ),
        (lambda: Setpoint.velocity([1, 0, 0], axes=3), TypeError, "axes must be 'world'"),
        (
            lambda: Setpoint.velocity([1, 0, 0], yaw="north"),
            TypeError,
            "yaw must be an angle from world x, counter-clockwise, in radians, not a str",
        ),
        (lambda: Setpoint.velocity([1, 0, 0], yaw=math.nan), ValueError, "yaw is NaN"),
        (
            lambda: Setpoint.velocity([1, 0, 0], yaw=1, yaw_rate=1),
            TypeError,
            "give yaw (where to look) or yaw_rate (how fast to turn), not both",
        ),
        (
            lambda: Setpoint.waypoints([[0, 0, 1], [1, 0, 1]], [1, 2, 3]),
            ValueError,
            "speed_mps must be one number, or 2: one per point, not a list of 3",
        ),
        (lambda: Setpoint.waypoints([[0, 0, 1]], 0.0), ValueError, "a waypoint's speed is 0 m/s"),
        (lambda: Setpoint.waypoints([[0, 0, math.nan]]), ValueError, "not finite"),
        (
            lambda: Setpoint.waypoints(np.zeros((33, 3))),
            ValueError,
            "points_m has 33 points, but a path has at most 32: send the rest, under another id",
        ),
        (
            lambda: Setpoint.polynomial(1.0, np.zeros((1, 9, 3))),
            ValueError,
            "coefficients must be an array of shape (pieces, up to 8, 3), not a numpy.ndarray of shape (1, 9, 3)",
        ),
        (lambda: Setpoint.polynomial(-1.0, np.zeros((1, 4, 3))), ValueError, "a trajectory's piece lasts -1 s"),
        (lambda: Setpoint.attitude_rate([0, 0, 0], "full"), TypeError, "thrust must be a number"),
        (lambda: Setpoint([1, 0, 0]), TypeError, "Setpoint.velocity([x, y, z])"),
        (lambda: Pose("ned", "body", [0, 0, 0]), ValueError, "unknown frame 'ned'; known frames: 'world'"),
        (
            lambda: Pose("world", "body", [0, 0, 0], [0, 0, 0, 0]),
            ValueError,
            "a rotation is a quaternion [x, y, z, w] of length 1",
        ),
    ],
)
def test_the_sentence(make, error, sentence):
    with pytest.raises(error) as raised:
        make()
    assert sentence in str(raised.value)
    assert "\n" not in str(raised.value)


def test_setpoints_show_how_to_make_them():
    for setpoint in (
        Setpoint.hold(),
        Setpoint.land(),
        Setpoint.position([1, 2, 3], yaw=0.5),
        Setpoint.velocity([1, 0, 0.5], axes="heading", yaw_rate=-0.2),
        Setpoint.acceleration([0, 0, 1]),
        Setpoint.take_off(),
        Setpoint.offset([1, 0, 0], axes="body"),
        Setpoint.attitude_rate([0, 0, 0.1], 1.1),
        Setpoint.waypoints([[0, 0, 1], [1, 0, 1]], 0.5, id=3, yaw=0.1),
        Setpoint.polynomial([1, 2], np.ones((2, 4, 3)), axes="heading"),
    ):
        assert eval(repr(setpoint)) == setpoint
    assert Setpoint.velocity([1, 0, 0]).kind == "velocity"
    assert Setpoint.hold() != Setpoint.land()
    assert Setpoint.waypoints([0, 0, 1]) == Setpoint.waypoints([[0, 0, 1]], [1.0])


def test_poses_compose_only_where_frames_meet():
    half = math.sqrt(0.5)
    # At (1, 2, 3), nose to north.
    world_from_body = Pose("world", "body", [1, 2, 3], [0, 0, half, half])
    assert np.allclose(world_from_body.transform_point([1, 0, 0]), [1, 3, 3])
    assert np.allclose(world_from_body.rotate([[1, 0, 0], [0, 0, 1]]), [[0, 1, 0], [0, 0, 1]])
    assert world_from_body.yaw_rad == pytest.approx(math.pi / 2)
    body_from_cam = vizflyt.CameraInfo(
        "front", vizflyt.Intrinsics.from_horizontal_fov(4, 2, 1.0)
    ).body_from_cam
    world_from_cam = world_from_body @ body_from_cam
    # One metre along the optical axis is one metre ahead, which is north.
    assert np.allclose(world_from_cam.transform_point([0, 0, 1]), [1, 3, 3])
    assert np.allclose(world_from_cam.matrix, world_from_body.matrix @ body_from_cam.matrix)
    back = (world_from_cam @ world_from_cam.inverse()).matrix
    assert np.allclose(back, np.eye(4))
    with pytest.raises(ValueError, match="world_from_body @ cam_from_body: the frames that meet, 'body' and 'cam'"):
        world_from_body @ body_from_cam.inverse()
    with pytest.raises(TypeError, match="for points use transform_point"):
        world_from_body @ np.zeros(3)
    with pytest.raises(ValueError, match="expected world_from_body, got body_from_cam"):
        vizflyt.Vehicle(body_from_cam)


def test_volumes_measure_one_point_or_many():
    box = Volume.aabb([-1, -1, 0], [1, 1, 2])
    assert box.signed_distance_m([0, 0, 1]) == pytest.approx(-1)
    assert np.allclose(box.signed_distance_m(np.array([[3.0, 0, 1], [0, 0, 2]])), [2, 0])
    with pytest.raises(ValueError, match=r"p_world_m must be a point \[x, y, z\] or points of shape \(N, 3\)"):
        box.signed_distance_m([[1, 2]])


def test_the_camera_projects():
    k = vizflyt.Intrinsics(320, 240, 200, 200, 160, 120)
    assert np.allclose(k.project([0.5, -0.25, 2.0]), [210, 95])
    assert np.isnan(k.project([[0, 0, -1.0]])).all()
    assert np.allclose(k.matrix @ [0, 0, 1], [160, 120, 1])
    assert np.allclose(k.opencv_matrix @ [0, 0, 1], [159.5, 119.5, 1])


def test_an_arena_for_tests_is_made_by_hand():
    info = vizflyt.ArenaInfo(goal_m=[1, 2, 3], limits=vizflyt.Limits(max_speed_mps=2, max_acceleration_mps2=3))
    assert (info.goal_m == [1, 2, 3]).all() and info.limits.max_speed_mps == 2
    assert info.geofence.signed_distance_m([0, 0, 0]) < 0 and info.cameras == []
    assert vizflyt.ArenaInfo().goal_m is None
    table = vizflyt.Volume.aabb([0, 0, 0], [1, 1, 1])
    info = vizflyt.ArenaInfo(no_fly=[table], floor_z_m=0.25, setpoints=["position"], attitude_rate=True)
    assert info.no_fly == [table] and info.floor_z_m == 0.25
    assert info.setpoints == ["position", "attitude_rate"] and info.attitude_rate
    assert "velocity" in vizflyt.ArenaInfo().setpoints and not vizflyt.ArenaInfo().attitude_rate
    with pytest.raises(ValueError, match=r"unknown kind of setpoint ['\"]speed['\"]"):
        vizflyt.ArenaInfo(setpoints=["speed"])
    with pytest.raises(ValueError, match="at most 8 no-fly boxes"):
        vizflyt.ArenaInfo(no_fly=[table] * 9)


def test_the_course_s_map_is_every_obstacle(monkeypatch):
    monkeypatch.delenv("VIZFLYT_MAP", raising=False)
    assert vizflyt.course_map() is None
    monkeypatch.setenv("VIZFLYT_MAP", '[{"sphere": {"center_m": [1, 2, 3], "radius_m": 0.5}}]')
    (ball,) = vizflyt.course_map()
    assert ball.signed_distance_m([1, 2, 4]) == pytest.approx(0.5)
    monkeypatch.setenv("VIZFLYT_MAP", "[1]")
    with pytest.raises(ValueError, match=r"map\.json"):
        vizflyt.course_map()
