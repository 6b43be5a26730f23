#!/usr/bin/env python3
"""A plugin that attacks: it reports for each attempt whether it was refused, and never attaches.

`targets.json` in the same folder lists its targets.
"""

import array
import ctypes
import json
import os
import pathlib
import resource
import socket
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent
TARGETS = json.loads((HERE / "targets.json").read_text())
LIBC = ctypes.CDLL(None, use_errno=True)


def attempt(name, act):
    """Reports the result of an attempt: `act` raises OSError or returns a false value if it was refused."""
    try:
        found = act()
    except OSError as error:
        found, why = None, error.strerror
    else:
        why = "nothing there"
    print(f"attempt {name}: {f'PASSED {found!r:.80}' if found else f'refused, {why}'}", flush=True)


def call(name, *arguments):
    ctypes.set_errno(0)
    if getattr(LIBC, name)(*arguments) < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return True


def others():
    return [p for p in os.listdir("/proc") if p.isdigit() and p != str(os.getpid())]


def inside(name):
    """Returns the content of the file, link or folder `name` of every process that is not this one, listed or not."""
    found = []
    for process in {*others(), *map(str, range(1, 64))} - {str(os.getpid())}:
        path = pathlib.Path("/proc", process, name)
        for look in (lambda path: path.read_bytes()[:4096], os.readlink, os.listdir):
            try:
                found.append((str(path), look(path)))
            except OSError:
                pass
    return found


def memory():
    """Returns processes that are not this one and whose memory can be opened: reading at 0 fails for every process."""
    return [process for process in range(1, 64) if process != os.getpid() and opens(f"/proc/{process}/mem")]


def opens(path):
    try:
        os.close(os.open(path, os.O_RDONLY))
    except OSError:
        return False
    return True


def connect(family, address):
    with socket.socket(family) as client:
        client.settimeout(1)
        client.connect(address)
    return True


def limit_parent():
    resource.prlimit(os.getppid(), resource.RLIMIT_CPU, (1, 1))
    return True


def lower_parent():
    os.setpriority(os.PRIO_PROCESS, os.getppid(), 19)
    return True


def kill_parent():
    parent = os.getppid()
    os.kill(parent, 9)
    time.sleep(0.1)
    return os.getppid() != parent


def write(path):
    pathlib.Path(path).write_text("forged")
    return True


def runtime_memory():
    """Returns the file descriptors that the runtime passes through its socket."""
    place = sys.argv[sys.argv.index("--vizflyt-service") + 1] if "--vizflyt-service" in sys.argv else None
    if place is None:
        place = next((a.split("=", 1)[1] for a in sys.argv if a.startswith("--vizflyt-service=")), "")
    if not place.startswith("fd:"):
        return []
    service = socket.socket(fileno=int(place[3:]))
    service.settimeout(2)
    memory = []
    try:
        for _ in range(8):
            size = array.array("i").itemsize
            _, extra, _, _ = service.recvmsg(65536, socket.CMSG_SPACE(16 * size))
            for level, kind, data in extra:
                if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
                    descriptors = array.array("i")
                    descriptors.frombytes(data[: len(data) - len(data) % size])
                    memory.extend(descriptors)
    except OSError:
        pass
    service.detach()
    return memory


def break_memory():
    """Truncates and overwrites the memory that the runtime maps."""
    broken = []
    for descriptor in runtime_memory():
        try:
            os.ftruncate(descriptor, 0)
            broken.append(("truncated", descriptor))
        except OSError:
            pass
    return broken


def leave_daemon():
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            for _ in range(100):
                time.sleep(0.05)
                for path in TARGETS["reports"]:
                    try:
                        write(path)
                    except OSError:
                        pass
        os._exit(0)


for path in TARGETS["secrets"]:
    attempt(f"read {path}", lambda path=path: pathlib.Path(path).read_bytes())
if TARGETS["graded"]:
    attempt("environment", lambda: os.environ.get(TARGETS["variable"]))
for name in ("cmdline", "environ", "maps", "auxv", "fd", "cwd", "root", "exe", "status"):
    attempt(f"{name} of other processes", lambda name=name: inside(name))
attempt("memory of other processes", memory)
attempt("other processes", others)
attempt("service of a user", lambda: connect(socket.AF_UNIX, TARGETS["service"]))
attempt("network", lambda: connect(socket.AF_INET, ("127.0.0.1", TARGETS["port"])))
attempt("limits of the runtime", limit_parent)
attempt("priority of the runtime", lower_parent)
attempt("end of the runtime", kill_parent)
attempt("memory of the runtime", break_memory)
attempt("user namespace", lambda: call("unshare", 0x10000000))
CLONE = 56 if os.uname().machine == "x86_64" else 220
attempt("cloned namespace", lambda: call("syscall", CLONE, 0x10000011, 0, 0, 0, 0))
attempt("mount", lambda: call("mount", b"x", b"/tmp", b"tmpfs", 0, None))
attempt("homes", lambda: [name for home in TARGETS["homes"] for name in os.listdir(home)])
attempt("root", lambda: os.geteuid() == 0)
attempt("what the last flight left", lambda: os.path.exists("/tmp/left") or os.path.exists("/dev/shm/left"))
for path in ("/tmp/left", "/dev/shm/left"):
    write(path)
if TARGETS["graded"]:
    attempt("log of the last flight", lambda: [str(path) for path in HERE.rglob("*.mcap")])
    attempt("own folder", lambda: write(HERE / "targets.json"))
for path in TARGETS["reports"]:
    attempt(f"write {path}", lambda path=path: write(path))
attempt("daemon", leave_daemon)
print("attempts are over", flush=True)
