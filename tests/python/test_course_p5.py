"""The course's project 5: what a starter's tests find, and what starter and solution get for a flight."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

COURSE = Path(__file__).parents[2] / "docs/course"
PROJECT = COURSE / "p5"
# What the starter fails in, and nothing else.
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


def handed_in(folder, who):
    """Makes a student's folder: the starter, and for `solution` the references of p4 and p5 over it."""
    shutil.copytree(PROJECT / "starter", folder, ignore=shutil.ignore_patterns("__pycache__"))
    if who == "solution":
        for file in (COURSE / "p4/solution/gap.py", *(PROJECT / "solution").glob("*.py")):
            shutil.copy(file, folder)
    return folder


@pytest.mark.parametrize("who", ["starter", "solution"])
def test_tests_of_the_starter_pass_where_the_work_is_done(tmp_path, who):
    folder = handed_in(tmp_path / "my-p5", who)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rf", "--tb=no", "-W", "error", "-p", "no:cacheprovider", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, cwd=tmp_path,
    )
    failed = set(re.findall(r"^FAILED \S+::(\w+)", done.stdout, re.M))
    assert " passed" in done.stdout, done.stdout
    assert failed == (UNFINISHED if who == "starter" else set()), done.stdout


def test_a_starter_says_which_of_its_tests_fail():
    text = "\n".join(file.read_text() for file in sorted((PROJECT / "starter").glob("test_*.py")))
    said = re.findall(r'^def (test_\w+)\([^\n]*\n    """([^"]+)', text, re.M)
    assert {name for name, words in said if words.startswith("So far fails")} == UNFINISHED


def grade(program, folder, level, first):
    """Grades a plugin on one seed of the project; returns its flight."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        [program, "grade", folder.name, "--project=p5", f"--level={level}", "--seeds=1", f"--first-seed={first}",
         "--log=none", "--json"],
        env=os.environ | {"PATH": path, "XDG_CONFIG_HOME": str(folder.parent / "config"), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=300, cwd=folder.parent,
    )
    assert done.returncode == 0, done.stderr
    (run,) = json.loads(done.stdout)["runs"]
    return run


@pytest.mark.parametrize("level", ["ug", "g"])
def test_a_starter_flies_and_gets_nothing(program, tmp_path, level):
    run = grade(program, handed_in(tmp_path / "my-p5", "starter"), level, 1)
    assert (run["outcome"], run["score"]) == ("landed", 0.0), run


@pytest.mark.parametrize(("level", "first"), [("ug", 103), ("g", 116)])
def test_a_solution_finishes_in_the_time_for_half_of_the_points(program, tmp_path, level, first):
    text = (PROJECT / "README.md").read_text()
    half = re.search(r"^\| mean time to the finish[^|]*\| \d+ \|[^|]*\| ([^|]*) \|", text, re.M)[1]
    most_s = float(re.search(rf"`{level}` <= (\d+) s", half)[1])
    run = grade(program, handed_in(tmp_path / "my-p5", "solution"), level, first)
    assert (run["outcome"], run["score"], run["stages_passed"]) == ("finished", 100.0, 4), run
    assert run["seconds"] + run["penalty_s"] <= most_s, run


def test_a_solutions_scores_are_those_of_the_answers():
    """Quiz 1 and 4, by the reference's own functions."""
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
    points = re.findall(r"^\|[^|]+\| (\d+) \|", (PROJECT / "README.md").read_text(), re.M)
    assert sum(map(int, points)) == 100
