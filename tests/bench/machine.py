"""This computer: the reference kernels, what it is, and commands with what they took of it."""

import os
import subprocess
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from figures import Reference

# By vfork a command's greatest memory would be this process's own at least; by fork it is no more than it has just now.
vars(subprocess)["_USE_VFORK"] = False
# As many times each kernel runs in a turn; the least counts.
REPEATS = 9


class CommandFailed(Exception):
    """A command of a table did not end with status 0; the message has the end of what it said."""


class Used(NamedTuple):
    """A command's standard output, and what it took: all its threads' time, and its greatest resident memory."""

    output: str
    processor_s: float
    peak_mb: float


def reference() -> Reference:
    """Times the kernels: integers and branches within a core's caches; and copying 64 MB, which no cache holds."""
    words = b"".join(b"%d:%d;" % (i * i % 977, i * 31 % 1009) for i in range(24_000))
    source, target = bytes(64 << 20), bytearray(64 << 20)

    def copy() -> None:
        target[:] = source

    return Reference(least_ms(lambda: zlib.compress(words, 6)), least_ms(copy))


def least_ms(kernel: Callable[[], object]) -> float:
    """Returns the processor's time of the kernel, the least of its repeats: what others take does not count. [ms]"""
    times = []
    for _ in range(REPEATS):
        start = time.thread_time()
        kernel()
        times.append(time.thread_time() - start)
    return round(min(times) * 1e3, 3)


def processor() -> str:
    """Returns the processor's name and how many of it there are."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{os.cpu_count()} x {names[0] if names else os.uname().machine}"


def load() -> float:
    return round(os.getloadavg()[0], 1)


def run(command: list[str], folder: Path | None = None, env: dict[str, str] | None = None, most: int = 0) -> Used:
    """Runs a command to its end, with these variables of environment besides those that are set; `most` is the greatest
    status that is no failure."""
    env = {**os.environ, **(env or {})}
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=errors, cwd=folder, env=env)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        errors.seek(0)
        output, said = out.read().decode(), errors.read().decode(errors="replace")
    if not 0 <= process.returncode <= most:
        raise CommandFailed(f"`{' '.join(command)}` ended with status {process.returncode}:\n{said[-2000:]}")
    return Used(output, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


class Watched:
    """What a running process has taken so far, by /proc."""

    def __init__(self, pid: int) -> None:
        self.folder = Path(f"/proc/{pid}")

    def processor_s(self) -> float:
        words = (self.folder / "stat").read_text().rsplit(")")[-1].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    def resident_mb(self) -> float:
        lines = (self.folder / "status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024
