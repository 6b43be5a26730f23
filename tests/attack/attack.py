"""Runs hostile submissions through `vizflyt grade` and `vizflyt fly`, and checks what they obtained. See `run`."""

import json
import os
import pathlib
import re
import shutil
import socket
import subprocess
import tempfile
import time

import checks
from checks import check, end

HERE = pathlib.Path(__file__).resolve().parent
VARIABLE = "VIZFLYT_ATTACK_SECRET"


def run(*arguments, **more):
    return checks.run(*arguments, environment={VARIABLE: "secret"}, **more)


def attempts(text):
    """Returns the submission's own reports of its attempts."""
    return re.findall(r"attempt ([^\n]+?): (PASSED|refused)([^\n<]*)", text)


def check_attempts(where, text, least):
    found = attempts(text)
    for name, how, more in found:
        if how == "PASSED":
            check(f"{where}: {name}", False, more)
    check(f"{where}: {len(found)} attempts, all refused", len(found) >= least and
          not any(how == "PASSED" for _, how, _ in found), text[-3000:] if len(found) < least else "")


class Scene:
    """A computer with files and processes that a submission must not access."""

    def __init__(self, folder):
        self.folder = folder
        self.keys = folder / "keys"
        # A file in another user's home, in a folder that every user may enter.
        self.home = pathlib.Path.home() / f".vizflyt-attack-{os.getpid()}"
        self.home.mkdir()
        self.private = self.home / "private"
        self.private.write_text("private")
        self.private.chmod(0o644)
        self.service = folder / "service"
        self.unix = socket.socket(socket.AF_UNIX)
        self.unix.bind(str(self.service))
        self.unix.listen()
        self.service.chmod(0o777)
        self.tcp = socket.create_server(("127.0.0.1", 0))

    def submission(self, name, graded, reports=()):
        folder = self.folder / name
        folder.mkdir()
        shutil.copy(HERE / "submission.py", folder / "submission")
        targets = {
            "secrets": [str(self.private), str(self.keys / "grading.key"), "/etc/shadow"],
            "variable": VARIABLE, "service": str(self.service), "port": self.tcp.getsockname()[1],
            "homes": [str(self.home.parent)], "reports": [str(path) for path in reports], "graded": graded,
        }
        (folder / "targets.json").write_text(json.dumps(targets))
        # File permissions must allow the access: only the sandbox is tested here.
        for path in (folder, *folder.iterdir()):
            path.chmod(0o777)
        return folder / "submission"

    def close(self):
        shutil.rmtree(self.home)


def graded_flights(scene):
    """Secrets, other processes, and processes that survive a flight."""
    run("grade", "key", "--keys", scene.keys)
    # In the submission's own folder, as a grader in continuous integration does.
    out = scene.folder / "graded/out"
    report, junit = out / "index.html", scene.folder / "grade.xml"
    program = scene.submission("graded", True, [report, junit])
    out.mkdir()
    out.chmod(0o777)
    done = run("grade", program, "--project", "p4", "--seeds", 2, "--jobs", 1, "--report", out, "--junit", junit,
               "--keys", scene.keys, "--json")
    check("grade: ends in order", done.returncode == 0, done.stderr)
    text = "".join(path.read_text(errors="replace") for path in out.rglob("*.html"))
    check_attempts("grade", text, 30)
    before = {path: path.read_bytes() for path in (report, junit)}
    time.sleep(6)
    after = {path: path.read_bytes() for path in (report, junit)}
    check("grade: no daemon changes what was written", before == after, "changed")
    # It ran as a copy, in folders of the same names.
    name = f"{program.parent.name}/{program.name}"
    left = subprocess.run(["pgrep", "-f", name], capture_output=True, text=True, check=False).stdout
    check("grade: nothing of it runs on", not left, left)
    grade = json.loads(done.stdout)
    check("grade: it has no points", grade["summary"]["score"]["value"] < 50, grade["summary"])
    verify = ("grade", "verify", out, "--keys", scene.keys)
    check("grade: the report is as it was signed", run(*verify).returncode == 0, run(*verify).stderr)
    report.write_bytes(before[report] + b"<p>100 of 100</p>")
    found = run(*verify)
    check("grade: a forged report is found out", found.returncode != 0 and report.name in found.stdout + found.stderr,
          found.stdout + found.stderr)
    junit.write_bytes(before[junit].replace(b"failure", b"success"))
    found = run("grade", "verify", out / "grade.json", "--junit", junit, "--keys", scene.keys)
    check("grade: a forged JUnit file is found out", found.returncode != 0, found.stdout + found.stderr)


def another_try(scene):
    """A plugin that fails its flight on purpose, as if another process had killed it."""
    program = scene.folder / "another-try"
    program.write_text("#!/usr/bin/python3\nimport os\nos.kill(os.getpid(), 9)\n")
    program.chmod(0o755)
    done = run("grade", program, "--project", "p4", "--seeds", 1, "--keys", scene.keys)
    check("grade: a plugin that kills itself gets no grade", done.returncode != 0 and not done.stdout, done.stderr)


def an_honest_one(scene):
    """The sandbox must not hide the plugin's own files, under any of their names."""
    folder = scene.folder / "honest"
    (folder / "vizflyt").mkdir(parents=True)
    (folder / "vizflyt/__init__.py").write_text("run = None\n")
    (folder / "plugin.py").write_text("import sys\nsys.exit('HONEST here')\n")
    names = {"its path": folder, "its name": "honest", "a relative path": "./honest", "its file": "honest/plugin.py"}
    for kind, name in names.items():
        done = run("grade", name, "--project", "p4", "--seeds", 1, "--keys", scene.keys, cwd=scene.folder)
        text = done.stdout + done.stderr
        check(f"grade: a plugin is started by {kind}", "HONEST here" in text, text[-500:])


def lab_flight(scene):
    """The same attacks in the simulated lab, where a person's plugin is less confined."""
    program = scene.submission("lab", False)
    report = scene.folder / "lab.json"
    done = run("fly", program, "--scene", "forest", "--headless", "--seconds", 5, "--ready-within", 20, "--report",
               report, "--no-config", "--log-dir", scene.folder / "flights")
    check_attempts("fly", done.stdout + done.stderr, 14)
    check("fly: the runtime lives and reports", report.exists() and "without a report" not in done.stderr,
          done.stderr[-2000:])


HOGS = {
    "grandchildren": """
import os, time
for _ in range(4):
    if os.fork() == 0:
        os.setsid()
        held = bytearray(b"x") * 100_000_000
        time.sleep(1000)
time.sleep(1000)
""",
    "shared memory": """
import time
try:
    open("/dev/shm/hog", "wb").write(bytes(300_000_000))
    print("HOG holds 300 MB", flush=True)
except OSError as error:
    print("HOG was refused:", error.strerror, flush=True)
time.sleep(2)
""",
    "processes": """
import os, time
while True:
    try:
        os.fork()
    except OSError:
        time.sleep(1)
""",
}


def more_than_its_share(scene):
    """Memory and processes beyond the limits, in an unattended flight."""
    settings = scene.folder / "jetson.toml"
    settings.write_text("[plugin]\nmemory_mb = 200\nprocesses = 32\nrestart = \"never\"\n")
    said = {
        "grandchildren": "more than its 200 MB of memory",
        "shared memory": "HOG was refused: No space left on device",
        "processes": "more than its 32 processes and threads",
    }
    for name, text in HOGS.items():
        program = scene.folder / f"hog-{name.replace(' ', '-')}"
        program.write_text(f"#!/usr/bin/python3\n{text}")
        program.chmod(0o755)
        done = run("fly", program, "--sim", "--config", settings, "--scene", "room", "--headless", "--seconds", 3,
                   "--ready-within", 10, "--log-dir", scene.folder / "flights")
        text = done.stdout + done.stderr
        check(f"fly: the limit holds for {name}", said[name] in text, text[-1500:])


def submissions_that_run_before_they_fly(scene):
    """Code of a submission that a check or a build would run."""
    spy = f"""
import pathlib, socket
found = []
for path in {[str(scene.private), str(scene.keys / 'grading.key')]!r}:
    try:
        found.append(pathlib.Path(path).read_text())
    except OSError:
        pass
try:
    socket.create_connection(("127.0.0.1", {scene.tcp.getsockname()[1]}), 1)
    found.append("network")
except OSError:
    pass
mark = pathlib.Path({str(scene.folder / 'mark')!r})
try:
    mark.write_text(repr(found))
except OSError:
    pass
print("SPY", found, flush=True)
import sys
print("SPY", found, file=sys.stderr, flush=True)
"""
    own = scene.folder / "own-python"
    (own / ".venv/bin").mkdir(parents=True)
    python = own / ".venv/bin/python3"
    python.write_text(f"#!/usr/bin/python3\n{spy}\nsys.exit(1)\n")
    python.chmod(0o755)
    (own / "plugin.py").write_text("import vizflyt\n")
    package = scene.folder / "own-package"
    (package / "vizflyt").mkdir(parents=True)
    (package / "vizflyt/__init__.py").write_text(spy)
    (package / "plugin.py").write_text("import vizflyt\n")
    rust = scene.folder / "own-build"
    (rust / "src").mkdir(parents=True)
    manifest = '[package]\nname = "own-build"\nversion = "0.1.0"\nedition = "2024"\n[workspace]\n'
    (rust / "Cargo.toml").write_text(manifest)
    (rust / "src/main.rs").write_text("fn main() {}\n")
    tries = ", ".join(f'"{path}"' for path in (scene.private, scene.keys / "grading.key"))
    (rust / "build.rs").write_text(f"""fn main() {{
    let mut found: Vec<String> = [{tries}].iter().filter_map(|path| std::fs::read_to_string(path).ok()).collect();
    if std::net::TcpStream::connect(("127.0.0.1", {scene.tcp.getsockname()[1]})).is_ok() {{
        found.push("network".into());
    }}
    let _ = std::fs::write("{scene.folder / 'mark'}", "x");
    panic!("SPY {{found:?}}");
}}
""")
    cases = {"its own Python": own, "its own package": package}
    if shutil.which("cargo"):
        cases["its own build"] = rust
    else:
        print("skipped: its own build, for want of cargo")
    for name, folder in cases.items():
        for path in (scene.folder, *folder.rglob("*")):
            path.chmod(0o755 if path.is_dir() or path.parent.name == "bin" else 0o644)
        scene.folder.chmod(0o777)
        done = run("grade", folder, "--project", "p4", "--seeds", 1, "--keys", scene.keys, "--json")
        text = done.stdout + done.stderr
        got = re.findall(r"SPY (\[[^\n]*\])", text)
        check(f"grade: {name} finds nothing", all(found == "[]" for found in got), got)
        check(f"grade: {name} leaves no mark", not (scene.folder / "mark").exists(), "it wrote outside")
        if name != "its own package":
            check(f"grade: {name} was run, in its cell", bool(got) or "cannot" in text, text[-1500:])


def main():
    folder = pathlib.Path(tempfile.mkdtemp(prefix="vizflyt-attack-", dir="/var/tmp"))
    folder.chmod(0o777)
    scene = Scene(folder)
    try:
        graded_flights(scene)
        another_try(scene)
        an_honest_one(scene)
        lab_flight(scene)
        more_than_its_share(scene)
        submissions_that_run_before_they_fly(scene)
    finally:
        scene.close()
        shutil.rmtree(folder)
    end()


main()
