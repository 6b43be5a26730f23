"""Project 2 of the course: its printed commands run; the reference solution reaches the bounds, the starter does
not."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest
from test_course import COURSE, Student

pytestmark = pytest.mark.course

P2 = COURSE / "p2"
# Exactly the tests that fail for the starter.
UNFINISHED = {
    "test_no_segment_through_something_is_free",
    "test_a_wall_is_passed_by_its_door",
    "test_a_goal_beside_the_grid_is_reached",
    "test_no_way_is_none",
    "test_a_start_or_goal_too_near_to_something_is_none",
    "test_points_that_it_can_do_without_are_left_out",
    "test_the_tree_finds_the_door",
    "test_no_tree_is_none",
    "test_one_piece_from_rest_to_rest",
    "test_they_begin_and_end_at_rest",
    "test_pieces_meet_in_every_derivative",
    "test_limits_are_kept_and_used",
    "test_the_whole_curve_is_free",
    "test_what_does_not_fit_is_none",
}


def printed(*beginnings):
    """Returns the assignment's commands with one of these beginnings."""
    lines = re.findall(r"^\$ (.+)$", (P2 / "README.md").read_text(), re.M)
    return [line for line in lines if line.startswith(beginnings)]


def bounds(row):
    """Returns the bound for full points in a row of the grading table: a number, or one for each level."""
    (cell,) = re.findall(rf"^\| {row}[^|]*\| \d+ \| ([^|]+) \|", (P2 / "README.md").read_text(), re.M)
    return [float(number) for number in re.findall(r"[<>]= ([\d.]+)", cell)]


def summary_and_flights(student, report):
    grade = json.loads((student.course / report / "grade.json").read_text())
    return grade["summary"], grade["runs"]


@pytest.fixture
def student(request, tmp_path):
    """Makes a student's folder after step 1, with the starter ("starter") or the reference solution ("solution")."""
    program = request.config.getoption("--vizflyt")
    if program is None:
        pytest.skip("no --vizflyt given")
    made = Student(tmp_path, Path(program).absolute())
    for line in printed("vizflyt new", "vizflyt arena check"):
        made.run(line)
    if request.param == "solution":
        made.run(f"cp {P2}/solution/*.py my-p2/")
    return made


@pytest.mark.parametrize("who", ["starter", "solution"])
def test_unit_tests_pass_where_the_work_is_done(tmp_path, who):
    folder = tmp_path / "mine"
    for source in ("starter", *(["solution"] if who == "solution" else [])):
        shutil.copytree(P2 / source, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rf", "--tb=no", "-p", "no:cacheprovider", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, cwd=tmp_path,
    )
    failed = set(re.findall(r"^FAILED \S+::(\w+)", done.stdout, re.M))
    assert " passed" in done.stdout, done.stdout
    assert failed == (UNFINISHED if who == "starter" else set()), done.stdout


@pytest.mark.parametrize("student", ["starter"], indirect=True)
def test_the_starter_flies_and_does_not_arrive(student):
    (line,) = printed("vizflyt grade my-p2 --project p2 --seeds 1 ")
    for level in ("ug", "g"):
        student.run(f"{line} --level {level}")
        summary, (flight,) = summary_and_flights(student, "graded/p2")
        assert summary["score"]["value"] == 0 and flight["outcome"] == "collided", flight
        assert flight["path_m"] > 1.0, flight


@pytest.mark.parametrize("student", ["solution"], indirect=True)
def test_the_reference_reaches_every_bound(student):
    """Flies two of the 20 maps at each level; then submits, and is graded with the class."""
    all_s, all_m = bounds("mean time"), bounds("least clearance")
    for level, least_s in zip(("ug", "g"), all_s):
        (line,) = printed(f"vizflyt grade my-p2 --project p2 --level {level} --seeds 20 ")
        student.run(line.replace("--seeds 20", "--seeds 2") + " --least 100")
        summary, flights = summary_and_flights(student, f"graded/p2-{level}")
        assert len(flights) == 2 and summary["score"]["value"] == 100
        assert summary["mean_finish_s"] <= least_s and summary["min_clearance_m"] >= all_m[0], summary

    follow = printed("vizflyt grade my-p2 --project p2 --level g --seeds 1 ", "vizflyt evaluate")
    assert len(follow) == 2
    said = [student.run(line) for line in follow][1]
    assert float(re.search(r"absolute +rmse (\S+) m", said)[1]) <= bounds("unit tests")[0], said

    (line,) = printed("vizflyt submit my-p2")
    student.run(line)
    assert {"plugin.py", "planner.py", "planner_g.py"} <= set(ZipFile(student.course / "TEAM.zip").namelist())
    student.run("mkdir submissions && mv TEAM.zip submissions/ && echo team > roster.csv && echo TEAM >> roster.csv")
    student.run("echo 100 > secret.txt")
    (line,) = printed("vizflyt grade-class")
    student.run(line.replace("--seeds 20", "--seeds 1"))
    summary, _ = summary_and_flights(student, "graded/p2-class/reports/TEAM")
    assert summary["score"]["value"] == 100


def test_the_points_of_the_assignment_are_a_hundred():
    table = re.search(r"^\|[^\n]*\| points \|.*?(?=\n\n)", (P2 / "README.md").read_text(), re.M | re.S)[0]
    assert sum(int(row) for row in re.findall(r"^\|[^|]+\| (\d+) \|", table, re.M)) == 100, table
