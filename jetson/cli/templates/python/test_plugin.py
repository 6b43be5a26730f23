"""Runs without a vehicle: .venv/bin/python3 -m unittest"""

import unittest

import numpy as np

from plugin import steer


def room(left_m, right_m):
    """Returns a depth image with these depths in the left and right half."""
    depth_m = np.full((48, 64), left_m, np.float32)
    depth_m[:, 32:] = right_m
    return depth_m


class Steering(unittest.TestCase):
    def test_it_flies_where_there_is_room(self):
        (forward_mps, _, _), turn_radps = steer(room(8.0, 8.0), 1.0)
        self.assertGreater(forward_mps, 0.5)
        self.assertAlmostEqual(turn_radps, 0.0)

    def test_it_turns_to_the_deeper_side(self):
        self.assertGreater(steer(room(8.0, 3.0), 1.0)[1], 0.2)
        self.assertLess(steer(room(3.0, 8.0), 1.0)[1], -0.2)

    def test_it_stops_before_a_wall_and_turns(self):
        (forward_mps, _, _), turn_radps = steer(room(0.8, 0.8), 1.0)
        self.assertEqual(forward_mps, 0.0)
        self.assertNotEqual(turn_radps, 0.0)

    def test_it_keeps_its_height(self):
        self.assertGreater(steer(room(8.0, 8.0), 0.5)[0][2], 0.0)
        self.assertLess(steer(room(8.0, 8.0), 1.5)[0][2], 0.0)
        self.assertEqual(steer(room(8.0, 8.0), None)[0][2], 0.0)

    def test_nothing_seen_is_room(self):
        self.assertGreater(steer(room(0.0, 0.0), 1.0)[0][0], 0.5)


if __name__ == "__main__":
    unittest.main()
