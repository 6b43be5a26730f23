"""Grading of a class: untrusted submissions, one table, a second run that flies only new submissions."""

import csv
import json
import os
import subprocess
import sys
import zipfile

import pytest

# A plugin that reports which files of others it can read, and ends.
SPY = '''
import pathlib, sys
here = pathlib.Path(__file__).resolve().parent
# Each flight has a copy, in a folder with a random name.
named = lambda path: "copy" if path.name.startswith("vizflyt-") else path.name
found = []
places = [here.parent, here.parents[1], here.parents[1] / "reports", here.parents[1] / "state"]
for place in [*places, *map(pathlib.Path, {places})]:
    try:
        inside = place.iterdir() if place.is_dir() else [place]
        found += [f"{named(inner.parent)}/{named(inner)}" for inner in inside if inner.exists()]
    except OSError:
        pass
raise SystemExit("sees " + ", ".join(sorted(found)))
'''


@pytest.fixture
def desk(program, tmp_path):
    """Runs the program in a folder whose Python has the package; returns its status and output."""

    def run(*arguments):
        done = subprocess.run(
            [program, *arguments],
            cwd=tmp_path,
            env={**os.environ, "PATH": f"{sys.prefix}/bin:{os.environ['PATH']}"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=300,
        )
        return done.returncode, done.stdout

    return run


def test_a_class_gets_its_grades_and_nobody_sees_the_others(desk, tmp_path):
    (tmp_path / "submissions").mkdir()
    places = repr([str(tmp_path / "submissions"), str(tmp_path / "roster.csv")])
    for team in ("red", "blue"):
        (tmp_path / team).mkdir()
        (tmp_path / team / "plugin.py").write_text("import vizflyt\n" + SPY.replace("{places}", places))
        status, said = desk("submit", team, "-o", f"submissions/{team}.zip")
        assert status == 0 and "plugin.py" in said and "SHA-256" in said, said
    with zipfile.ZipFile(tmp_path / "submissions/up.zip", "w") as archive:
        archive.writestr("../../up.py", "")
    (tmp_path / "roster.csv").write_text('Team,members\nred,"Ann, Bo"\nblue,Cy\nup,Di\ngone,Ed\n')

    grade = ["grade-class", "--own-seeds", "roster.csv", "submissions", "grades"]
    grade += ["--project=p4", "--seeds=1", "--log=none"]
    status, said = desk(*grade)
    assert status == 0 and "2 of 4 teams have a grade" in said, said
    rows = {row["Team"]: row for row in csv.DictReader((tmp_path / "grades/grades.csv").read_text().splitlines())}
    assert rows["red"]["members"] == "Ann, Bo" and rows["red"]["score"] == "0.0" and rows["red"]["flights"] == "1", rows
    # Points by the project's own table; an empty cell for students without a grade.
    assert float(rows["red"]["points"]) == 0 and float(rows["red"]["points_of"]) > 0, rows
    assert rows["up"]["points"] == "", rows
    assert "leads out" in rows["up"]["note"] and "nothing submitted" in rows["gone"]["note"], rows
    assert not (tmp_path / "up.py").exists() and not (tmp_path / "grades/up.py").exists()
    seeds = set()
    for team in ("red", "blue"):
        graded = json.loads((tmp_path / f"grades/reports/{team}/grade.json").read_text())
        (flight,) = graded["runs"]
        assert graded["subject"]["team"] == team, graded["subject"]
        seeds.add(flight["seed"])
        seen = flight["reason"].split("sees ", 1)[1]
        if "signature" not in graded:
            # Without a sandbox nothing is hidden and nothing is signed, and the table says so.
            assert rows[team]["signed"] == "no", rows
            continue
        # Its own folder and the parent folder only; no other submission, grade or name.
        assert f"/{team}" in seen, seen
        for other in {"red", "blue", "up", "gone"} - {team}:
            assert f"/{other}" not in seen, seen
        assert "grade.json" not in seen and "roster" not in seen and ".zip" not in seen, seen
    assert len(seeds) == 2, "each team has courses of its own"
    assert (tmp_path / "grades/index.html").read_text().count("<tr>") == 5

    # Second run: unchanged submissions keep their grades, changed ones are flown again, new ones are graded.
    changed = tmp_path / "grades/reports/blue/grade.json"
    if '"signature"' in (was := changed.read_text()):
        changed.write_text(was.replace('"score": 0.0', '"score": 99.0'))
        status, said = desk(*grade)
        assert status == 0 and "graded again" in said and changed.read_text() == was, said
    before = (tmp_path / "grades/reports/red/grade.json").stat().st_mtime_ns
    (tmp_path / "blue/plugin.py").write_text("raise SystemExit('anew')\n")
    desk("submit", "blue", "-o", "submissions/blue.zip")
    status, said = desk(*grade)
    assert status == 0, said
    assert (tmp_path / "grades/reports/red/grade.json").stat().st_mtime_ns == before
    assert "anew" in (tmp_path / "grades/reports/blue/grade.json").read_text()


def test_mistakes_are_explained(desk, tmp_path):
    (tmp_path / "roster.csv").write_text("name\nred\n")
    (tmp_path / "empty").mkdir()
    for arguments, told in [
        (["submit", "empty"], "without vizflyt.toml, Cargo.toml or plugin.py"),
        (["grade-class", "roster.csv", "empty", "out"], "no column is headed 'team'"),
    ]:
        status, said = desk(*arguments)
        assert status == 1 and told in said, said
    (tmp_path / "roster.csv").write_text("team\nred\n")
    for options, told in [(["--report", "x"], "--report is not for a class"), (["--projct", "p4"], "'--project'")]:
        status, said = desk("grade-class", "roster.csv", "empty", "out", *options)
        assert status != 0 and told in said, said
    assert not (tmp_path / "out").exists()
