"""Shared by the tests of the course's projects: students' folders, their own tests, graded flights."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

COURSE = Path(__file__).parents[2] / "docs/course"


def handed_in(folder, project, who):
    """Makes a student's folder: the project's starter; for `solution`, with the reference solution on top."""
    for source in ("starter", "solution")[: 1 + (who == "solution")]:
        shutil.copytree(
            COURSE / project / source, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__")
        )
    return folder


def failing(folder):
    """Runs the tests of a student's folder; returns the names of failed tests, and pytest's output."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rf", "--tb=no", "-W", "error", "-p", "no:cacheprovider", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, cwd=folder.parent,
    )
    assert " passed" in done.stdout, done.stdout
    return set(re.findall(r"^FAILED \S+::(\w+)", done.stdout, re.M)), done.stdout


def said_to_fail(project):
    """Returns the tests of a project's starter that are documented to fail."""
    text = "\n".join(file.read_text() for file in sorted((COURSE / project / "starter").glob("test_*.py")))
    said = re.findall(r'^def (test_\w+)\([^\n]*\n    """([^"]+)', text, re.M)
    return {name for name, words in said if words.startswith("So far fails")}


def grade(program, folder, project, level, seeds=1, first=1):
    """Grades a plugin on some seeds of a project; returns its flights."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        [program, "grade", folder.name, f"--project={project}", f"--level={level}", f"--seeds={seeds}",
         f"--first-seed={first}", "--log=none", "--json"],
        env=os.environ | {"PATH": path, "XDG_CONFIG_HOME": str(folder.parent / "config"), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=300, cwd=folder.parent,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["runs"]


def points_of(project):
    """Returns the sum of the points in an assignment's table."""
    return sum(map(int, re.findall(r"^\|[^|]+\| (\d+) \|", (COURSE / project / "README.md").read_text(), re.M)))
