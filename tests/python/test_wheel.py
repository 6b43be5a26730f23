"""Without Rust: the wheel is sufficient in an empty environment."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

# A package index accepts files up to 100 MB by default; the limit here is lower because of slow connections.
MOST_BYTES = 40 << 20


@pytest.fixture
def wheel(request):
    path = request.config.getoption("--wheel")
    if path is None:
        pytest.skip("no --wheel given")
    return Path(path)


def test_pip_install_is_all_that_a_student_needs(wheel, tmp_path):
    assert wheel.stat().st_size <= MOST_BYTES
    bare = tmp_path / "bare"
    subprocess.run([sys.executable, "-m", "venv", bare], check=True)
    pip = [bare / "bin/python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, wheel], check=True)

    def run(*arguments):
        """Runs the program installed by pip, with nothing else on PATH."""
        environment = {"PATH": str(bare / "bin"), "HOME": str(tmp_path)}
        return subprocess.run(
            ["vizflyt", *arguments],
            cwd=tmp_path,
            env=environment,
            executable=bare / "bin/vizflyt",
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=150,
        )

    made = run("new", "p4", "--project", "p4")
    # Its Python has the package: no further installation is needed.
    assert made.returncode == 0 and made.stdout.split() == "p4 created; next vizflyt fly p4".split(), made.stdout
    for file in (tmp_path / "p4").rglob("*"):
        # The folder can be copied to another computer.
        assert file.is_dir() or str(Path(__file__).parents[2]) not in file.read_text(), file
    flown = run("fly", "p4", "--headless", "--seconds", "6", "--report", "report.json")
    report = json.loads((tmp_path / "report.json").read_text())
    assert (flown.returncode, report["outcome"]) == (0, "landed"), flown.stdout
    assert report["images_delivered"] > 10, report


def test_a_wheel_holds_the_package_and_a_program_that_runs(wheel):
    with zipfile.ZipFile(wheel) as files:
        names = files.namelist()
        (program,) = (name for name in names if name.endswith(".data/scripts/vizflyt"))
        assert any(name.endswith("_vizflyt.abi3.so") for name in names), names
        assert "vizflyt/py.typed" in names
        assert files.getinfo(program).external_attr >> 16 & 0o111 == 0o111
