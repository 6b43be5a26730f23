"""Sensors other than cameras: their records are views of the memory, with the documented layout."""

import struct

import numpy as np
import pytest
from conftest import camera

import vizflyt


def buffer():
    mounted = vizflyt.Pose("body", "sensor", [0, 0, 0.1])
    return vizflyt.ObservationBuffer(
        [camera()],
        [
            vizflyt.SensorInfo("top", "lidar", most_records=8, body_from_sensor=mounted),
            vizflyt.SensorInfo("down", "range_finder"),
            vizflyt.SensorInfo("nose", "radar", most_records=4),
        ],
    )


def test_records_are_views_of_the_documented_layout():
    made = buffer()
    # As C would write it: three floats, an unsigned, two shorts.
    points = b"".join(struct.pack("<3fIHH", n, 2 * n, 3 * n, 7, 255, n) for n in range(5))
    made.set_reading("top", points, seq=3, stamp_ns=9, pose_at_reading=vizflyt.Pose("world", "body", [1, 2, 3]))
    made.set_reading("down", struct.pack("<2f", 1.25, 0.5))
    obs = made.observation()
    assert obs.sensor("nose") is None and [one.name for one in obs.sensors] == ["top", "down"]
    top = obs.sensor("top")
    assert (top.kind, top.seq, top.stamp_ns, top.shown_ns, top.range_m) == ("lidar", 3, 9, 9, None)
    assert (top.points_m.shape, top.points_m.dtype) == ((5, 3), np.float32)
    assert (top.points_m[4] == [4, 8, 12]).all() and (top.records["ring"] == np.arange(5)).all()
    assert (top.records["before_ns"] == 7).all() and (top.records["intensity"] == 255).all()
    assert top.records.dtype.itemsize == 20 and np.shares_memory(top.points_m, top.records)
    assert (top.pose_at_reading.translation_m == [1, 2, 3]).all()
    assert (top.body_from_sensor.translation_m == [0, 0, 0.1]).all()
    down = obs.sensor("down")
    assert (down.range_m, down.points_m, down.pose_at_reading) == (1.25, None, None)
    assert (down.records["range_m"][0], down.records["signal"][0]) == (1.25, 0.5)


def test_records_cannot_be_written_and_go_back_in():
    made = buffer()
    made.set_reading("nose", struct.pack("<5f", 4, 0.5, -1, 20, 0.3))
    records = made.observation().sensor("nose").records
    with pytest.raises(ValueError, match="read-only"):
        records["range_m"][0] = 1
    assert (records["radial_mps"][0], records.shape) == (-1, (1,))
    other = buffer()
    other.set_reading("nose", records)
    assert (other.observation().sensor("nose").records == records).all()


def test_mistakes_are_named():
    with pytest.raises(LookupError, match="there is no sensor 'left'; this vehicle has 'top', 'down', 'nose'"):
        buffer().observation().sensor("left")
    with pytest.raises(LookupError, match="without a sensor 'left'"):
        buffer().set_reading("left", b"")
    with pytest.raises(ValueError, match="known kinds: lidar, range_finder, sonar, radar"):
        vizflyt.SensorInfo("x", "camera")
    with pytest.raises(ValueError, match="at most 8 sensors"):
        vizflyt.ArenaInfo(sensors=[vizflyt.SensorInfo(str(n), "sonar") for n in range(9)])
    assert vizflyt.ArenaInfo(sensors=[vizflyt.SensorInfo("a", "sonar")]).sensors[0].kind == "sonar"
