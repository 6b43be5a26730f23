"""The course's project 5: results of a starter's tests, and grades of starter and solution."""

import re
import shutil
import sys

import pytest
from starters import COURSE, failing, grade, handed_in, points_of, said_to_fail

pytestmark = pytest.mark.course

PROJECT = COURSE / "p5"
# Exactly the tests that fail for the starter.
UNFINISHED = {
    "test_rays_meet_the_plane_where_the_hand_is",
    "test_the_angle_is_where_the_free_end_is",
    "test_a_part_of_the_hand_has_its_angle",
    "test_a_turning_is_followed_either_way_and_across_pi",
    "test_noise_is_averaged",
    "test_pauses_do_not_matter",
    "test_it_is_known_how_well_it_turns",
    "test_a_place_is_blocked_while_the_hand_is_too_near",
    "test_beyond_the_hand_nothing_is_blocked_and_at_the_axle_all",
    "test_away_is_what_keeps_its_distance_all_the_time",
    "test_a_start_is_the_first_after_which_it_is_away",
    "test_stages_count_as_long_as_all_before_them_are_passed",
    "test_the_first_stage_weighs_most",
    "test_a_difference_may_be_luck",
    "test_a_state_that_takes_too_long_is_left",
    "test_the_time_counts_from_the_first_image",
    "test_every_state_is_left_in_time",
    "test_a_state_that_finds_nothing_does_not_end_the_flight",
}


def folder_of(folder, who):
    """Makes a student's folder; the reference solution takes the code for the gap from project 4."""
    handed_in(folder, "p5", who)
    if who == "solution":
        shutil.copy(COURSE / "p4/solution/gap.py", folder)
    return folder


@pytest.mark.parametrize("who", ["starter", "solution"])
def test_tests_of_the_starter_pass_where_the_work_is_done(tmp_path, who):
    failed, said = failing(folder_of(tmp_path / "my-p5", who))
    assert failed == (UNFINISHED if who == "starter" else set()), said


def test_a_starter_says_which_of_its_tests_fail():
    assert said_to_fail("p5") == UNFINISHED


@pytest.mark.parametrize("level", ["ug", "g"])
def test_a_starter_flies_and_gets_nothing(program, tmp_path, level):
    (run,) = grade(program, folder_of(tmp_path / "my-p5", "starter"), "p5", level)
    assert (run["outcome"], run["score"]) == ("landed", 0.0), run


@pytest.mark.parametrize(("level", "first"), [("ug", 103), ("g", 116)])
def test_a_solution_finishes_in_the_time_for_half_of_the_points(program, tmp_path, level, first):
    text = (PROJECT / "README.md").read_text()
    half = re.search(r"^\| mean time to the finish[^|]*\| \d+ \|[^|]*\| ([^|]*) \|", text, re.M)[1]
    most_s = float(re.search(rf"`{level}` <= (\d+) s", half)[1])
    (run,) = grade(program, folder_of(tmp_path / "my-p5", "solution"), "p5", level, first=first)
    assert (run["outcome"], run["score"], run["stages_passed"]) == ("finished", 100.0, 4), run
    assert run["seconds"] + run["penalty_s"] <= most_s, run


def test_a_solutions_scores_are_those_of_the_answers():
    """Quiz 1 and 4, with the reference solution's functions."""
    sys.path.insert(0, str(PROJECT / "solution"))
    try:
        from score import by_luck, mean_score
    finally:
        sys.path.pop(0)
    text = (PROJECT / "solution/answers.md").read_text()
    said = float(re.search(r"^1\. \(.*\) / 80 = ([\d.]+)\. ", text, re.M)[1])
    assert mean_score([15 / 20, 14 / 15, 12 / 14, 6 / 12]) == pytest.approx(said, abs=0.051)
    assert f"= {by_luck(4, 1):.2f}" in text and f"(12 of 15: {by_luck(12, 3):.3f})" in text


def test_the_points_add_up():
    assert points_of("p5") == 100
