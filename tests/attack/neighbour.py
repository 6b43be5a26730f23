"""Attacks by another user of the same computer, who occupies file names that the program needs and reads files left
open. See `run`."""

import contextlib
import os
import pathlib
import shutil
import subprocess
import tempfile
import time

from checks import VIZFLYT, Program, check, end, scene

# The goal is 2 s from the start to the error message; a loaded machine gets five times as long.
WITHIN_S = 10.0
# A user id without an account; only root can run a program as another user.
OTHER = 54_321
NOBODY = 65_534


def squat(path, kind):
    """Places an obstacle at a path where the program needs its own file or folder."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir(0o700)
    elif kind == "link to /dev/zero":
        path.symlink_to("/dev/zero")
    elif kind == "dangling link":
        path.symlink_to("/nonexistent/vizflyt")
    elif kind == "link to itself":
        path.symlink_to(path.name)
    elif kind == "file open to all":
        path.write_text("")
        path.chmod(0o666)


def timed(command, within_s, **more):
    """Returns whether the command ended within the limit, its output, and its duration [s]. SIGTERM comes first: the
    command must react to it."""
    began = time.monotonic()
    process = subprocess.Popen([VIZFLYT, *map(str, command)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True, **more)
    try:
        text, _ = process.communicate(timeout=within_s)
        return True, text, time.monotonic() - began
    except subprocess.TimeoutExpired:
        process.terminate()
        try:
            text, _ = process.communicate(timeout=5)
        except subprocess.TimeoutExpired:
            process.kill()
            text = process.communicate()[0] + "\n(deaf to SIGTERM)"
        return False, text, time.monotonic() - began


def names_in_the_keys_folder(folder):
    """Files that a program with write access could have left there, such as a plugin without a sandbox."""
    arena = scene(folder)
    serve = ["serve", "--leaderboard=none", "--renderer=cpu", "--quic=127.0.0.1:0", "--http=127.0.0.1:0",
             "--vicon=127.0.0.1:0", "--tls=auto", arena]
    fly = ["fly", "avoid", "--server=127.0.0.1:9", "--mavlink=udpin:127.0.0.1:0", "--ready-within=1", "--no-config",
           "--log-dir", folder / "flights"]
    all_took_s = []
    for name, command in {
        "server.key": serve, "paired.toml": serve, "page.key": serve, "page-keys.toml": [*serve, "--print-page-keys"],
        "runtime.key": fly, "servers.toml": fly, "grading.key": ["grade", "key"],
    }.items():
        for kind in ("pipe", "folder", "link to /dev/zero", "link to itself", "file open to all"):
            keys = folder / "squatted"
            keys.mkdir(0o700)
            squat(keys / name, kind)
            is_over, text, took_s = timed([*command, "--keys", keys], WITHIN_S)
            all_took_s.append(took_s)
            check(f"{name} is a {kind}: a sentence", is_over and name in text and "error: " in text,
                  f"{took_s:.1f} s: {text[-300:]}")
            shutil.rmtree(keys)
    print(f"      a sentence within {max(all_took_s):.1f} s at most")
    # A symbolic link must not redirect a new key.
    keys = folder / "squatted"
    keys.mkdir(0o700)
    (keys / "server.key").symlink_to(folder / "elsewhere")
    timed([*serve, "--keys", keys], WITHIN_S)
    check("a key is not made where a link leads", not (folder / "elsewhere").exists())
    shutil.rmtree(keys)
    keys.mkdir(0o755)
    keys.chmod(0o755)
    _, text, _ = timed([*serve, "--keys", keys], WITHIN_S)
    check("a keys folder that others may enter is refused", "open to other users" in text, text[-300:])


def names_in_shared_folders(folder):
    """`/tmp` and `/dev/shm` are writable for all users."""
    can_be_other = os.geteuid() == 0 and all(folder.stat().st_mode & 1 for folder in pathlib.Path(VIZFLYT).parents)
    mine = OTHER if can_be_other else os.geteuid()
    home = folder / "home"
    home.mkdir()
    if mine == OTHER:
        os.chown(home, mine, mine)
    more = {"user": mine, "group": mine, "extra_groups": []} if mine == OTHER else {}
    more["env"] = os.environ | {"HOME": str(home), "XDG_CACHE_HOME": str(home), "XDG_CONFIG_HOME": str(home / "config")}
    more["cwd"] = home
    # Folder in which a runtime waits for a plugin started by hand.
    place = pathlib.Path(f"/tmp/vizflyt-{mine}")
    attach = ["fly", "--attach", "--headless", "--no-config", "--scene=room", "--log-dir", home / "flights"]
    if place.exists() or place.is_symlink():
        print(f"skipped: {place} is there already")
    else:
        elsewhere = folder / "elsewhere"
        elsewhere.mkdir()
        elsewhere.chmod(0o777)
        others = ["folder of another user"] if mine == OTHER else []
        for kind in ("pipe", "file open to all", "link elsewhere", *others):
            if kind == "link elsewhere":
                place.symlink_to(elsewhere)
            elif kind == "folder of another user":
                place.mkdir()
                place.chmod(0o777)
                os.chown(place, NOBODY, NOBODY)
            else:
                squat(place, kind)
            try:
                is_over, text, took_s = timed(attach, WITHIN_S, **more)
                why = f"{took_s:.1f} s: {text[-500:]}"
                check(f"{place} is a {kind}: a sentence", is_over and f"{place} belongs" in text, why)
                check(f"{place} is a {kind}: nothing is made there", not any(elsewhere.iterdir()), "it was followed")
            finally:
                shutil.rmtree(elsewhere / "waiting", ignore_errors=True)
                if place.is_dir() and not place.is_symlink():
                    shutil.rmtree(place)
                else:
                    place.unlink()
    # Names of the shared memory in earlier versions.
    shared = pathlib.Path("/dev/shm")
    taken = [shared / f"vizflyt{mine}_{'0' * 32}.{name}" for name in ("node.0_10_0.global_mgmt", "data", "event")]
    taken.append(shared / f"vizflyt{mine}_node.0_10_0.global_mgmt")
    before = set(os.listdir(shared))
    for path in taken:
        path.write_bytes(b"")
    try:
        command = ["fly", "avoid", "--headless", "--no-config", "--scene=room", "--seconds=2", "--log-dir",
                   home / "flights"]
        is_over, text, took_s = timed(command, 60.0, **more)
        check("names in /dev/shm are in nobody's way", is_over and "landed" in text, f"{took_s:.1f} s: {text[-300:]}")
    finally:
        for path in taken:
            path.unlink()
    left = {name for name in set(os.listdir(shared)) - before if "vizflyt" in name}
    check("nothing lies in /dev/shm", not left, left)


def what_lies_open(folder):
    """The folder of a flying lab: its obstacles are in `truth.json`."""
    before = set(pathlib.Path(tempfile.gettempdir()).glob("vizflyt-*"))
    lab = Program("demo", "--headless", "--seconds=3", "--log-dir", folder / "flights")
    try:
        is_open = []
        found = set()
        while lab.process.poll() is None and not found:
            time.sleep(0.1)
            found = set(pathlib.Path(tempfile.gettempdir()).glob("vizflyt-*")) - before
        time.sleep(1.0)
        for path in set(pathlib.Path(tempfile.gettempdir()).glob("vizflyt-*")) - before:
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_uid == os.geteuid() and path.stat().st_mode & 0o077:
                    is_open.append(f"{path} {path.stat().st_mode & 0o777:o}")
        check("the lab's folders are its user's alone", bool(found) and not is_open, is_open)
    finally:
        # SIGTERM lets it remove its folders.
        lab.process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            lab.process.wait(10)
        lab.end()


def main():
    folder = pathlib.Path(tempfile.mkdtemp(prefix="vizflyt-attack-", dir="/var/tmp"))
    folder.chmod(0o755)
    try:
        names_in_the_keys_folder(folder)
        names_in_shared_folders(folder)
        what_lies_open(folder)
    finally:
        shutil.rmtree(folder)
    end()


main()
