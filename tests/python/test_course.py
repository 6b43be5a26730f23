"""The course's first projects: their printed commands run; solutions reach the bounds, starters do not."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.course

COURSE = Path(__file__).parents[2] / "docs/course"
PROJECTS = ("p0", "p1")
# Not run: the environment exists already, and flights in real time belong to the lab.
NOT_RUN = ("python3 -m venv", "pip ", "python -m pytest", "vizflyt demo")
# Scores of flights in real time.
LIVE = re.compile(r"score_attitude\.py live")
# Exactly the tests that fail for a starter.
UNFINISHED = {
    "p0": {"test_a_tilted_body_at_rest_is_seen_as_tilted", "test_a_bias_does_not_add_up_at_rest"},
    "p1": {
        "test_a_tilted_body_at_rest_is_seen_as_tilted",
        "test_a_bias_does_not_add_up_at_rest",
        "test_it_finds_level_and_bias_while_it_moves",
        "test_the_mean_of_turns_is_the_one_they_lie_around",
        "test_it_knows_what_it_knows",
    },
}


def commands(project):
    """Returns the commands of an assignment that this test runs."""
    printed = re.findall(r"^\$ (.+)$", (COURSE / project / "README.md").read_text(), re.M)
    assert len(printed) > 8
    return [line for line in printed if not line.startswith(NOT_RUN) and not LIVE.search(line)]


class Student:
    """A student's folder for the course."""

    def __init__(self, folder, program):
        self.course = folder / "course"
        self.starters, self.solutions = {}, {}
        self.course.mkdir()
        path = os.pathsep.join([str(Path(program).parent), str(Path(sys.executable).parent), os.environ["PATH"]])
        keys = str(folder / "config")
        self.environment = os.environ | {"PATH": path, "XDG_CONFIG_HOME": keys, "PYTHONDONTWRITEBYTECODE": "1"}

    def run(self, line, status=0):
        done = subprocess.run(
            line, shell=True, cwd=self.course, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, timeout=300,
        )
        assert done.returncode == status, f"{line}\n{done.stdout}"
        return done.stdout

    def scores(self, lines):
        """Runs commands; returns the tilt points of each case, and their maximum."""
        found = {}
        for line in lines:
            said = self.run(line)
            if "--case" in line and "score_attitude.py" in line:
                got, most = re.search(r"^points +tilt (\S+) of (\S+)$", said, re.M).groups()
                found[line.split("--case ")[1]] = (float(got), float(most))
        return found


@pytest.fixture(scope="module")
def student(request, tmp_path_factory):
    """A student who has followed both assignments without changing any code; `starters` are the points."""
    program = request.config.getoption("--vizflyt")
    if program is None:
        pytest.skip("no --vizflyt given")
    folder = tmp_path_factory.mktemp("course")
    folder.chmod(0o755)
    student = Student(folder, Path(program).absolute())
    # Project 1 records the same flight again; its text permits to omit it.
    second = [line for line in commands("p1") if line.startswith("vizflyt new") or not line.startswith("vizflyt")]
    student.starters = student.scores(commands("p0")) | student.scores(second)
    return student


@pytest.fixture(scope="module")
def finished(student):
    """The same student with the reference solutions in place; `solutions` are the points."""
    for project in PROJECTS:
        student.run(f"cp {COURSE}/{project}/solution/*.py my-{project}/")
        again = [line for line in commands(project) if line.startswith("python ")]
        student.solutions |= student.scores(again)
    return student


def test_starters_run_and_get_nothing_for_tilt(student):
    assert len(student.starters) == 6
    assert {case: got for case, (got, _) in student.starters.items() if got} == {}


def test_solutions_get_all(finished):
    assert finished.solutions.keys() == finished.starters.keys()
    assert {case: points for case, points in finished.solutions.items() if points[0] != points[1]} == {}


def test_the_reference_flies_within_its_bound(finished):
    finished.run(
        "vizflyt grade my-p0/live_complementary.py --project my-p0/attitude.toml --imu frame --seeds 1 --first-seed 5 "
        "--report live --log full"
    )
    live = finished.scores(["python my-p0/score_attitude.py live/logs/day-5.mcap --case p0/live"])
    assert live == {"p0/live": (10.0, 10.0)}


@pytest.mark.parametrize(
    ("estimate", "said"),
    [
        ("", "is not an MCAP file; give a flight's log"),
        ("none.tum", "No such file"),
        ("empty.tum", "no attitude of a time in the air"),
        ("words.tum", "could not convert"),
        ("half.tum", "only 5\\d% of the time in the air has an attitude"),
        ("long.tum", "no unit quaternion"),
    ],
)
def test_what_cannot_be_scored_is_said(finished, estimate, said):
    whole = (finished.course / "my-p0/calibrated.tum").read_text().splitlines()
    for name, lines in (
        ("empty", ["# nothing"]),
        ("words", ["1.0 0 0 0 zero 0 0 1"]),
        ("half", whole[: len(whole) * 11 // 20]),
        ("long", [line.rsplit(" ", 1)[0] + " 1.5" for line in whole]),
    ):
        (finished.course / f"{name}.tum").write_text("\n".join(lines))
    truth = "data/mav0/state_groundtruth_estimate0/data.csv"
    found = finished.run(f"python my-p0/score_attitude.py {truth} {estimate}", status=1)
    assert re.search(said, found) and "Traceback" not in found, found


def test_the_whole_error_is_that_of_evaluate(finished):
    """Checks with `vizflyt evaluate` on the same files: tilt and heading together, on the floor too."""
    truth, estimate = "data/mav0/state_groundtruth_estimate0/data.csv", "my-p0/uncalibrated.tum"
    said = finished.run(f"vizflyt evaluate {truth} {estimate}")
    rmse_deg = float(re.search(r"attitude rmse (\S+) deg", said)[1])
    found = finished.run(
        "PYTHONPATH=my-p0 python -c 'import numpy as np, score_attitude as s; "
        f'f = s.first_ns("{truth}"); t, e = s.read("{truth}", f), s.read("{estimate}", f); '
        "q, _, k = s.truth_at(t, e.at_s); w = s.errors(e.q_xyzw[k], q[k])[2]; print(np.degrees((w**2).mean() ** 0.5))'"
    )
    assert float(found) == pytest.approx(rmse_deg, abs=0.01)


@pytest.mark.parametrize("project", PROJECTS)
@pytest.mark.parametrize("who", ["starter", "solution"])
def test_unit_tests_pass_where_the_work_is_done(tmp_path, project, who):
    folder = tmp_path / "mine"
    for source in ("given", f"{project}/starter", *([f"{project}/solution"] if who == "solution" else [])):
        shutil.copytree(COURSE / source, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rf", "--tb=no", "-p", "no:cacheprovider", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, cwd=tmp_path,
    )
    failed = set(re.findall(r"^FAILED \S+::(\w+)", done.stdout, re.M))
    assert " passed" in done.stdout, done.stdout
    assert failed == (UNFINISHED[project] if who == "starter" else set()), done.stdout


def test_assignments_say_the_bounds():
    sys.path.insert(0, str(COURSE))
    import score_attitude as score

    sys.path.remove(str(COURSE))
    for case, bounds in score.CASES.items():
        text = (COURSE / case[:2] / "README.md").read_text()
        for points, limits, unit in (
            (bounds.tilt_points, bounds.tilt_deg, "deg"),
            (bounds.heading_points, bounds.heading_deg_per_min, "deg/min"),
        ):
            row = f"| {points:g} | <= {limits[0]:g} {unit} | <= {limits[1]:g} {unit} |"
            assert not points or row in text, (case, row)
    for text in ((COURSE / project / "README.md").read_text() for project in PROJECTS):
        tables = re.findall(r"^\|[^\n]*\| points \|.*?(?=\n\n)", text, re.M | re.S)
        for table in tables:
            assert sum(int(row) for row in re.findall(r"^\|[^|]+\| (\d+) \|", table, re.M)) == 100, table


@pytest.mark.parametrize("project", ["p2", "p3", "p4", "p5"])
def test_assignments_say_the_points_that_the_program_gives(project):
    text = (COURSE / project / "README.md").read_text()
    file = (COURSE.parents[1] / f"render-server/scenes/projects/{project}.toml").read_text()
    rows = {"time_s": "mean time", "clearance_m": "least clearance", "speed_mps": "greatest speed"}
    for level in ("ug", "g"):
        section = re.search(rf"^\[levels\.{level}\.points\]\n((?:[^\n\[]+\n)+)", file, re.M)[1]
        table = dict(line.split(" = ", 1) for line in section.splitlines())
        (score,) = re.findall(r"^\| `score`(?: by day)? \| (\d+) \|", text, re.M)
        assert float(score) == float(table.pop("score")) and float(table.pop("least_score")) == 50
        assert "from a `score` of 50 on" in " ".join(text.split())
        assert table.keys() <= rows.keys() and table
        for key, bounds in table.items():
            points, *cells = re.search(rf"^\| {rows[key]}[^|]* \| (\d+) \| ([^|]+) \| ([^|]+) \|", text, re.M).groups()
            # A bound for each level, or one for both.
            said = [re.search(rf"(?:`{level}` )?[<>]= ([\d.]+)(?!.*`{level}`)", cell)[1] for cell in cells]
            given = [re.search(rf"{name} = ([\d.]+)", bounds)[1] for name in ("points", "all", "half")]
            assert [*map(float, (points, *said))] == [*map(float, given)], (level, key)


def test_errors_are_split_into_tilt_and_heading():
    sys.path.insert(0, str(COURSE / "given"))
    sys.path.insert(0, str(COURSE))
    import attitude
    import score_attitude as score

    del sys.path[:2]
    random = np.random.default_rng(1)
    true = attitude.exp(random.uniform(-2, 2, (50, 3)))
    np.testing.assert_allclose(attitude.rotate(true, attitude.up_in_body(true)), [[0, 0, 1]] * 50, atol=1e-12)
    np.testing.assert_allclose(attitude.exp(attitude.log(true)), np.where(true[:, 3:] < 0, -true, true), atol=1e-12)
    for tilt, heading in ((0.2, 0.0), (0.0, -0.7), (0.3, 0.5)):
        off = attitude.multiply(attitude.exp(np.array([0, 0, heading])), attitude.exp(np.array([0, tilt, 0])))
        found = score.errors(attitude.multiply(off, true), true)
        up, felt = attitude.up_in_body(true), attitude.up_in_body(attitude.multiply(off, true))
        np.testing.assert_allclose(np.cos(found[0]), (up * felt).sum(axis=1), atol=1e-12)
        np.testing.assert_allclose(found[0], tilt, atol=1e-9)
        np.testing.assert_allclose(found[1], heading, atol=1e-9)
