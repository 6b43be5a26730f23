"""The course's project 4: what a starter's tests find, and what starter and solution get for a flight."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2] / "docs/course/p4"
# What the starter fails in, and nothing else.
UNFINISHED = {
    "test_a_gap_is_found_by_depth",
    "test_noise_and_pixels_without_return_hide_no_gap",
    "test_a_wall_that_is_seen_from_the_side_has_its_gap_where_it_is",
    "test_a_turn_is_taken_away",
    "test_a_gap_is_found_by_motion",
    "test_two_images_are_enough",
    "test_one_colour_in_the_middle_of_the_hall_hides_no_gap",
}


def handed_in(folder, who):
    """Makes a student's folder: the starter, and for `solution` the reference over it."""
    for source in ("starter", "solution")[: 1 + (who == "solution")]:
        shutil.copytree(PROJECT / source, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.mark.parametrize("who", ["starter", "solution"])
def test_tests_of_the_starter_pass_where_the_work_is_done(tmp_path, who):
    folder = handed_in(tmp_path / "my-p4", who)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rf", "--tb=no", "-W", "error", "-p", "no:cacheprovider", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, cwd=tmp_path,
    )
    failed = set(re.findall(r"^FAILED \S+::(\w+)", done.stdout, re.M))
    assert " passed" in done.stdout, done.stdout
    assert failed == (UNFINISHED if who == "starter" else set()), done.stdout


def test_a_starter_says_which_of_its_tests_fail():
    text = (PROJECT / "starter/test_gap.py").read_text()
    said = re.findall(r'^def (test_\w+)\([^\n]*\n    """([^"]+)', text, re.M)
    assert {name for name, words in said if words.startswith("So far fails")} == UNFINISHED


def grade(program, folder, level, seeds):
    """Grades a plugin on the first seeds of the project; returns its flights."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        [program, "grade", folder.name, "--project=p4", f"--level={level}", f"--seeds={seeds}", "--log=none", "--json"],
        env=os.environ | {"PATH": path, "XDG_CONFIG_HOME": str(folder.parent / "config"), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=300, cwd=folder.parent,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["runs"]


@pytest.mark.parametrize("level", ["ug", "g"])
def test_a_starter_flies_and_gets_nothing(program, tmp_path, level):
    (run,) = grade(program, handed_in(tmp_path / "my-p4", "starter"), level, 1)
    assert (run["outcome"], run["score"]) == ("landed", 0.0), run


@pytest.mark.parametrize(("level", "seeds"), [("ug", 2), ("g", 1)])
def test_a_solution_gets_through_within_all_bounds(program, tmp_path, level, seeds):
    text = (PROJECT / "README.md").read_text()
    least_m = float(re.search(r"^\| least clearance [^|]*\| \d+ \| >= (\S+) m \|", text, re.M)[1])
    most_s = float(re.search(rf"^\| mean time [^|]*\| \d+ \|[^|]*`{level}` <= (\d+) s", text, re.M)[1])
    for run in grade(program, handed_in(tmp_path / "my-p4", "solution"), level, seeds):
        assert (run["outcome"], run["score"], run["stages_passed"]) == ("finished", 100.0, 1), run
        assert run["min_clearance_m"] >= least_m and run["seconds"] <= most_s, run


def test_the_points_add_up():
    points = re.findall(r"^\|[^|]+\| (\d+) \|", (PROJECT / "README.md").read_text(), re.M)
    assert sum(map(int, points)) == 100
