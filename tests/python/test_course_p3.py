"""The course's project 3: results of a starter's tests, and grades of starter and solution."""

import re
import shutil
import subprocess
import sys

import pytest
from starters import COURSE, failing, grade, handed_in, points_of, said_to_fail

pytestmark = pytest.mark.course

PROJECT = COURSE / "p3"
# Exactly the tests that fail for the starter.
UNFINISHED = {
    "test_corners_of_a_frame_are_found",
    "test_a_corner_that_is_hidden_is_where_the_sides_meet",
    "test_specks_move_no_corner",
    "test_of_a_frame_that_leaves_the_image_corners_are_right_or_unknown",
    "test_a_square_is_where_its_corners_say",
    "test_of_two_answers_the_upright_one_is_taken",
    "test_a_noisy_corner_moves_a_place_as_far_as_it_should",
    "test_the_frame_tells_how_large_the_opening_is",
    "test_from_afar_one_knows_less",
    "test_a_filter_comes_nearer_with_each_image",
    "test_a_filter_takes_nothing_that_chance_does_not_explain",
    "test_while_nothing_is_seen_a_filter_knows_less",
    "test_a_heading_of_a_full_turn_is_none",
}


@pytest.mark.parametrize("who", ["starter", "solution"])
def test_tests_of_the_starter_pass_where_the_work_is_done(tmp_path, who):
    failed, said = failing(handed_in(tmp_path / "my-p3", "p3", who))
    assert failed == (UNFINISHED if who == "starter" else set()), said


def test_a_starter_says_which_of_its_tests_fail():
    assert said_to_fail("p3") == UNFINISHED


def test_a_starter_flies_and_gets_nothing(program, tmp_path):
    (run,) = grade(program, handed_in(tmp_path / "my-p3", "p3", "starter"), "p3", "ug")
    assert (run["outcome"], run["score"]) == ("landed", 0.0), run


@pytest.mark.parametrize("level", ["ug", "g"])
def test_a_solution_passes_all_windows_within_all_bounds(program, tmp_path, level):
    """Uses the network in the folder, by day; one of the twenty courses behind the published figures."""
    text = (PROJECT / "README.md").read_text()
    least_mps = float(re.search(r"^\| greatest speed [^|]*\| \d+ \| >= (\S+) m/s \|", text, re.M)[1])
    most_s = float(re.search(r"^\| mean time [^|]*\| \d+ \| <= (\S+) s \|", text, re.M)[1])
    (run,) = grade(program, handed_in(tmp_path / "my-p3", "p3", "solution"), "p3", level, first=100)
    assert (run["outcome"], run["score"], run["stages_passed"]) == ("finished", 100.0, 3), run
    assert run["max_speed_mps"] >= least_mps and run["seconds"] <= most_s, run


def test_the_starter_finds_by_the_same_network(tmp_path):
    """A trained network has the form that the starter's plugin reads; checked with the reference network."""
    folder = handed_in(tmp_path / "my-p3", "p3", "starter")
    shutil.copy(PROJECT / "solution/windows.onnx", folder)
    ask = "import numpy as np, plugin; print(plugin.Network()(np.zeros((240, 320, 3), np.uint8)).shape)"
    said = subprocess.run(
        [sys.executable, "-c", ask],
        capture_output=True, text=True, timeout=100, cwd=folder,
    )
    assert said.stdout == "(120, 160)\n", said


def test_the_points_add_up():
    assert points_of("p3") == 100
