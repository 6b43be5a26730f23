"""The course's elective "forest": results of a starter's tests, and the speed of the reference solution."""

import re

import pytest
from starters import COURSE, failing, grade, handed_in, points_of, said_to_fail

pytestmark = pytest.mark.course

# Exactly the tests that fail for the starter.
UNFINISHED = {
    "test_nothing_in_the_way_is_straight_on_and_fast",
    "test_a_trunk_in_the_way_is_passed_without_a_touch",
    "test_a_gap_between_trunks_is_taken_in_its_middle",
    "test_an_obstacle_is_where_it_stands",
    "test_two_pixels_are_no_obstacle",
}


@pytest.mark.parametrize("who", ["starter", "solution"])
def test_tests_of_the_starter_pass_where_the_work_is_done(tmp_path, who):
    failed, said = failing(handed_in(tmp_path / "my-forest", "forest", who))
    assert failed == (UNFINISHED if who == "starter" else set()), said


def test_a_starter_says_which_of_its_tests_fail():
    assert said_to_fail("forest") == UNFINISHED


def test_a_starter_flies_into_a_trunk(program, tmp_path):
    (run,) = grade(program, handed_in(tmp_path / "my-forest", "forest", "starter"), "forest", "ug")
    assert (run["outcome"], run["score"]) == ("collided", 0.0), run


def test_a_solution_is_fast_and_touches_nothing(program, tmp_path):
    """Uses the project's file from the source tree, even if the program was built with other limits."""
    project = COURSE.parents[1] / "render-server/scenes/projects/forest.toml"
    text = (COURSE / "forest/README.md").read_text()
    all_mps = float(re.search(r"^\| greatest speed [^|]*\| \d+ \| >= (\S+) m/s \|", text, re.M)[1])
    (run,) = grade(program, handed_in(tmp_path / "my-forest", "forest", "solution"), project, "ug", first=305)
    assert (run["outcome"], run["score"]) == ("finished", 100.0), run
    assert run["max_speed_mps"] >= all_mps and run["seconds"] < 10.5, run


def test_the_points_add_up():
    assert points_of("forest") == 100
