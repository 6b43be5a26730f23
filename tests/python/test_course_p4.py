"""The course's project 4: results of a starter's tests, and grades of starter and solution."""

import re

import pytest
from starters import COURSE, failing, grade, handed_in, points_of, said_to_fail

pytestmark = pytest.mark.course

PROJECT = COURSE / "p4"
# Exactly the tests that fail for the starter.
UNFINISHED = {
    "test_a_gap_is_found_by_depth",
    "test_noise_and_pixels_without_return_hide_no_gap",
    "test_a_wall_that_is_seen_from_the_side_has_its_gap_where_it_is",
    "test_a_turn_is_taken_away",
    "test_a_gap_is_found_by_motion",
    "test_two_images_are_enough",
    "test_one_colour_in_the_middle_of_the_hall_hides_no_gap",
}


@pytest.mark.parametrize("who", ["starter", "solution"])
def test_tests_of_the_starter_pass_where_the_work_is_done(tmp_path, who):
    failed, said = failing(handed_in(tmp_path / "my-p4", "p4", who))
    assert failed == (UNFINISHED if who == "starter" else set()), said


def test_a_starter_says_which_of_its_tests_fail():
    assert said_to_fail("p4") == UNFINISHED


@pytest.mark.parametrize("level", ["ug", "g"])
def test_a_starter_flies_and_gets_nothing(program, tmp_path, level):
    (run,) = grade(program, handed_in(tmp_path / "my-p4", "p4", "starter"), "p4", level)
    assert (run["outcome"], run["score"]) == ("landed", 0.0), run


@pytest.mark.parametrize(("level", "seeds"), [("ug", 2), ("g", 1)])
def test_a_solution_gets_through_within_all_bounds(program, tmp_path, level, seeds):
    text = (PROJECT / "README.md").read_text()
    least_m = float(re.search(r"^\| least clearance [^|]*\| \d+ \| >= (\S+) m \|", text, re.M)[1])
    most_s = float(re.search(rf"^\| mean time [^|]*\| \d+ \|[^|]*`{level}` <= (\d+) s", text, re.M)[1])
    for run in grade(program, handed_in(tmp_path / "my-p4", "p4", "solution"), "p4", level, seeds):
        assert (run["outcome"], run["score"], run["stages_passed"]) == ("finished", 100.0, 1), run
        assert run["min_clearance_m"] >= least_m and run["seconds"] <= most_s, run


def test_the_points_add_up():
    assert points_of("p4") == 100
