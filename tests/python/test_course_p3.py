"""The course's project 3: what a starter's tests find, and what starter and solution get for a flight."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2] / "docs/course/p3"
# What the starter fails in, and nothing else.
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


def handed_in(folder, who):
    """Makes a student's folder: the starter, and for `solution` the reference over it."""
    for source in ("starter", "solution")[: 1 + (who == "solution")]:
        shutil.copytree(PROJECT / source, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.mark.parametrize("who", ["starter", "solution"])
def test_tests_of_the_starter_pass_where_the_work_is_done(tmp_path, who):
    folder = handed_in(tmp_path / "my-p3", who)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rf", "--tb=no", "-W", "error", "-p", "no:cacheprovider", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, cwd=tmp_path,
    )
    failed = set(re.findall(r"^FAILED \S+::(\w+)", done.stdout, re.M))
    assert " passed" in done.stdout, done.stdout
    assert failed == (UNFINISHED if who == "starter" else set()), done.stdout


def test_a_starter_says_which_of_its_tests_fail():
    text = (PROJECT / "starter/test_windows.py").read_text()
    said = re.findall(r'^def (test_\w+)\([^\n]*\n    """([^"]+)', text, re.M)
    assert {name for name, words in said if words.startswith("So far fails")} == UNFINISHED


def grade(program, folder, level, seeds, *more):
    """Grades a plugin on seeds of the project from 100 on; returns its flights."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        [
            program, "grade", folder.name, "--project=p3", f"--level={level}", f"--seeds={seeds}", "--first-seed=100",
            "--log=none", "--json", *more,
        ],
        env=os.environ | {"PATH": path, "XDG_CONFIG_HOME": str(folder.parent / "config"), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=300, cwd=folder.parent,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["runs"]


def test_a_starter_flies_and_gets_nothing(program, tmp_path):
    (run,) = grade(program, handed_in(tmp_path / "my-p3", "starter"), "ug", 1)
    assert (run["outcome"], run["score"]) == ("landed", 0.0), run


@pytest.mark.parametrize("level", ["ug", "g"])
def test_a_solution_passes_all_windows_within_all_bounds(program, tmp_path, level):
    """With the network as it is in the folder, by day; one of the twenty courses that the figures are from."""
    text = (PROJECT / "README.md").read_text()
    least_mps = float(re.search(r"^\| greatest speed [^|]*\| \d+ \| >= (\S+) m/s \|", text, re.M)[1])
    most_s = float(re.search(r"^\| mean time [^|]*\| \d+ \| <= (\S+) s \|", text, re.M)[1])
    (run,) = grade(program, handed_in(tmp_path / "my-p3", "solution"), level, 1)
    assert (run["outcome"], run["score"], run["stages_passed"]) == ("finished", 100.0, 3), run
    assert run["max_speed_mps"] >= least_mps and run["seconds"] <= most_s, run


def test_the_starter_finds_by_the_same_network(tmp_path):
    """The network that a student trains has the form that the starter's plugin reads: the reference's is one."""
    folder = handed_in(tmp_path / "my-p3", "starter")
    shutil.copy(PROJECT / "solution/windows.onnx", folder)
    ask = "import numpy as np, plugin; print(plugin.Network()(np.zeros((240, 320, 3), np.uint8)).shape)"
    said = subprocess.run(
        [sys.executable, "-c", ask],
        capture_output=True, text=True, timeout=100, cwd=folder,
    )
    assert said.stdout == "(120, 160)\n", said


def test_the_points_add_up():
    points = re.findall(r"^\|[^|]+\| (\d+) \|", (PROJECT / "README.md").read_text(), re.M)
    assert sum(map(int, points)) == 100
