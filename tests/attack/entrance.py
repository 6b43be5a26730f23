"""Submissions whose files lead out of their folder: links, settings of cargo, forged build output. See `run`."""

import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import zipfile

from checks import check, end, run

SECRET = "the instructor's secret"
MANIFEST = '[package]\nname = "own"\nversion = "0.1.0"\nedition = "2024"\n[workspace]\n'


class Victim:
    """A folder of the instructor that other users may read: only the sandbox is tested here."""

    def __init__(self):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix=".vizflyt-attack-", dir=pathlib.Path.home()))
        self.secret = self.folder / "secret"
        self.make()

    def make(self):
        shutil.rmtree(self.folder)
        (self.folder / "bin").mkdir(parents=True)
        self.secret.write_text(SECRET)
        (self.folder / "bin/python3").symlink_to("/usr/bin/python3")
        self.folder.chmod(0o777)
        self.secret.chmod(0o666)
        self.before = self.state()

    def state(self):
        return [(str(path), path.stat().st_uid, path.stat().st_mode, path.is_file() and path.read_bytes()[:100])
                for path in (self.folder, *sorted(self.folder.rglob("*")))]

    def check(self, name, done, refused=None):
        text = done.stdout + done.stderr
        check(f"{name}: reads nothing of the instructor", SECRET not in text, text[-1500:])
        check(f"{name}: changes nothing of the instructor", self.state() == self.before,
              [part for part in self.state() if part not in self.before][:3])
        self.make()
        if refused:
            check(f"{name}: is refused with advice", refused in text, text[-1500:])


def grade(plugin, folder, *options):
    return run("grade", plugin, "--project", "p4", "--seeds", 1, "--keys", folder / "keys", "--json", *options)


def fly(plugin, folder):
    return run("fly", plugin, "--sim", "--no-config", "--scene", "room", "--headless", "--seconds", 2,
               "--ready-within", 10, "--log-dir", folder / "flights", cwd=folder)


def write(folder, files):
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)


def cargo_target(folder, victim):
    """`target` is a link to a folder of the instructor: the build could write there."""
    build = f"""fn main() {{
    let found = std::fs::read_to_string("{victim.secret}");
    let _ = std::fs::write("{victim.folder}/left", "x");
    let _ = std::fs::write("{victim.secret}", "changed");
    panic!("{{found:?}}");
}}
"""
    plugin = folder / "cargo-target"
    write(plugin, {"Cargo.toml": MANIFEST, "src/main.rs": "fn main() {}\n", "build.rs": build})
    (plugin / "target").symlink_to(victim.folder)
    victim.check("grade, target is a link", grade(plugin, folder))
    victim.check("fly, target is a link", fly(plugin, folder), "target is a link")


def spy(victim):
    """Python code that prints the secret, in the check of the plugin already."""
    return f"import sys\nsys.exit(open({str(victim.secret)!r}).read())\n"


def environments(folder, victim):
    """Links in a virtual environment."""
    aims = {
        "lib": {"bin/python3": "/usr/bin/python3", "lib": victim.folder},
        "bin": {"bin": "/usr/bin", "lib64": victim.folder},
        "python3": {"bin/python3": victim.folder / "bin/python3"},
        "secret": {"bin/python3": victim.secret},
    }
    for name, links in aims.items():
        plugin = folder / f"environment-{name}"
        write(plugin, {"plugin.py": "import vizflyt\n", "vizflyt/__init__.py": spy(victim)})
        (plugin / ".venv").mkdir()
        for link, aim in links.items():
            link = plugin / ".venv" / link
            link.parent.mkdir(exist_ok=True)
            link.symlink_to(aim)
        for how in (grade, fly):
            victim.check(f"{how.__name__}, .venv with a link {name}", how(plugin, folder))
    plugin = folder / "environment"
    write(plugin, {"plugin.py": "import vizflyt\n", "vizflyt/__init__.py": spy(victim)})
    (plugin / ".venv").symlink_to(victim.folder)
    for how in (grade, fly):
        victim.check(f"{how.__name__}, .venv is a link", how(plugin, folder), ".venv")


def links(folder, victim):
    """Other links, also to single files."""
    for name in ("secret", "plugin.py", "vizflyt.toml", "Cargo.toml"):
        plugin = folder / f"link-{name}"
        write(plugin, {"other.py": spy(victim)} | ({} if name == "plugin.py" else {"plugin.py": spy(victim)}))
        (plugin / name).symlink_to(victim.secret)
        victim.check(f"grade, {name} is a link", grade(plugin, folder), "is a link")


def honest_environment(folder):
    """A student's own environment still works."""
    plugin = folder / "honest"
    write(plugin, {"plugin.py": "import vizflyt\n",
                   "vizflyt/__init__.py": "import sys, numbers_of_mine\nsys.exit(f'HONEST {sys.prefix}')\n"})
    make = [sys.executable, "-m", "venv", "--without-pip", str(plugin / ".venv")]
    if subprocess.run(make, check=False).returncode:
        print("skipped: an honest environment, for want of venv")
        return
    packages = next((plugin / ".venv/lib").glob("python3*/site-packages"))
    (packages / "numbers_of_mine.py").write_text("")
    for how in (grade, fly):
        text = how(plugin, folder).stderr
        check(f"{how.__name__}: a student's own environment works", f"HONEST {plugin}/.venv" in text, text[-1500:])


WRAPPER = """#!/usr/bin/python3
import json, os, subprocess, sys
status = subprocess.run(sys.argv[1:]).returncode
out = [to for option, to in zip(sys.argv, sys.argv[2:]) if option == "--out-dir"]
if out:
    target = os.path.dirname(os.path.dirname(out[0]))
    os.makedirs(target + "/bin", exist_ok=True)
    os.symlink(VICTIM, target + "/lib")
    program = target + "/bin/plugin"
    open(program, "w").write("#!/usr/bin/python3\\nimport sys\\nsys.exit(open(SECRET).read())\\n")
    os.chmod(program, 0o755)
    print(json.dumps({"reason": "compiler-artifact", "target": {"kind": ["bin"]}, "executable": program}), flush=True)
sys.exit(status)
"""


def cargo_settings(folder, victim):
    """A ZIP whose settings of cargo replace the compiler, which forges the path of the program."""
    wrapper = WRAPPER.replace("VICTIM", repr(str(victim.folder))).replace("SECRET", repr(str(victim.secret)))
    files = {
        "Cargo.toml": MANIFEST, "src/lib.rs": "", "wrap": wrapper,
        ".cargo/config.toml": '[build]\nrustc-workspace-wrapper = "./wrap"\n',
    }
    for where in ("the archive", "a folder"):
        name = where.split()[-1]
        hand_in = folder / f"hand-in-{name}"
        hand_in.mkdir()
        if name == "archive":
            with zipfile.ZipFile(hand_in / "red.zip", "w") as archive:
                for path, text in files.items():
                    archive.writestr(path, text)
        else:
            write(hand_in / "red", files)
        (folder / "roster.csv").write_text("team\nred\n")
        out = folder / f"grades-{name}"
        done = run("grade-class", folder / "roster.csv", hand_in, out, "--project", "p4", "--seeds", 1,
                   "--keys", folder / "keys")
        done.stdout += "".join(path.read_text(errors="replace") for path in out.rglob("*")
                               if path.is_file() and path.suffix in (".html", ".json", ".csv"))
        victim.check(f"grade-class, settings of cargo in {where}", done, "builds no program")
    victim.check("grade, settings of cargo", grade(hand_in / "red", folder), "builds no program")


FORGED = """fn main() {
    let out = std::env::var("OUT_DIR").unwrap();
    let target = std::path::Path::new(&out).ancestors().nth(3).unwrap();
    std::fs::create_dir_all(target.join("bin")).unwrap();
    std::os::unix::fs::symlink("VICTIM", target.join("lib")).unwrap();
    std::os::unix::fs::symlink("SECRET", target.join("own")).unwrap();
}
"""


def built_program(folder, victim):
    """The build script puts a link where cargo writes the program."""
    plugin = folder / "built"
    build = FORGED.replace("VICTIM", str(victim.folder)).replace("SECRET", str(victim.secret))
    write(plugin, {"Cargo.toml": MANIFEST, "src/main.rs": 'fn main() { panic!("{:?}", std::fs::read_to_string("'
                   + str(victim.secret) + '")) }\n', "build.rs": build})
    victim.check("grade, links in the build's folder", grade(plugin, folder))


MEMORY = """#!/usr/bin/python3
import mmap, os, sys
file = os.open(os.path.join(os.path.dirname(__file__), "data"), os.O_RDONLY)
def is_cached(page):
    try:
        return os.preadv(file, [bytearray(1)], page * mmap.PAGESIZE, os.RWF_NOWAIT) == 1
    except BlockingIOError:
        return False
state = "".join(str(int(is_cached(page))) for page in range(64))
os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)
sys.exit("CACHE " + state)
"""


def memory_between_flights(folder):
    """The kernel's cache of a file tells whether an earlier flight has read it."""
    plugin = folder / "memory"
    write(plugin, {"plugin": MEMORY})
    (plugin / "data").write_bytes(os.urandom(1 << 20))
    os.sync()
    done = run("grade", plugin / "plugin", "--project", "p4", "--seeds", 3, "--jobs", 1, "--keys", folder / "keys",
               "--json")
    reasons = [run["reason"] for run in json.loads(done.stdout)["runs"]] if done.returncode == 0 else [done.stderr]
    seen = {reason.split("CACHE ")[-1][:64] for reason in reasons}
    check("grade: flights leave no traces in the page cache", len(seen) == 1 and all("CACHE" in it for it in reasons),
          seen)


def main():
    folder = pathlib.Path(tempfile.mkdtemp(prefix="vizflyt-attack-", dir="/var/tmp"))
    folder.chmod(0o755)
    victim = Victim()
    try:
        if shutil.which("cargo"):
            cargo_target(folder, victim)
            cargo_settings(folder, victim)
            built_program(folder, victim)
        else:
            print("skipped: builds, for want of cargo")
        environments(folder, victim)
        links(folder, victim)
        honest_environment(folder)
        memory_between_flights(folder)
    finally:
        shutil.rmtree(victim.folder)
        shutil.rmtree(folder)
    end()


main()
