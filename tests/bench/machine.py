"""This computer: reference kernels, its processor, and commands with their resource usage."""

import os
import subprocess
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from figures import Reference

# With vfork, a command's peak memory would be at least this process's own peak; with fork, only its current size.
vars(subprocess)["_USE_VFORK"] = False
# Repeats of each kernel in a turn; the minimum counts.
REPEATS = 9


class CommandFailed(Exception):
    """A command of a table ended with a status other than 0; the message has the end of its output."""


class Used(NamedTuple):
    """A command's standard output, the processor time of all its threads, and its peak resident memory."""

    output: str
    processor_s: float
    peak_mb: float


def reference() -> Reference:
    """Times the kernels: integers and branches within a core's caches, and a copy of 64 MB, larger than any cache."""
    words = b"".join(b"%d:%d;" % (i * i % 977, i * 31 % 1009) for i in range(24_000))
    source, target = bytes(64 << 20), bytearray(64 << 20)

    def copy() -> None:
        target[:] = source

    return Reference(least_ms(lambda: zlib.compress(words, 6)), least_ms(copy))


def least_ms(kernel: Callable[[], object]) -> float:
    """Returns the kernel's processor time, the minimum of its repeats; time of other processes does not count. [ms]"""
    times = []
    for _ in range(REPEATS):
        start = time.thread_time()
        kernel()
        times.append(time.thread_time() - start)
    return round(min(times) * 1e3, 3)


def processor() -> str:
    """Returns the processor's name and its number of cores."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{os.cpu_count()} x {names[0] if names else os.uname().machine}"


def load() -> float:
    return round(os.getloadavg()[0], 1)


def run(command: list[str], folder: Path | None = None, env: dict[str, str] | None = None, most: int = 0) -> Used:
    """Runs a command to its end with these additional environment variables; `most` is the highest status that is not a
    failure."""
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
    """Resource usage of a running process so far, from /proc."""

    def __init__(self, pid: int) -> None:
        self.folder = Path(f"/proc/{pid}")

    def processor_s(self) -> float:
        words = (self.folder / "stat").read_text().rsplit(")")[-1].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    def resident_mb(self) -> float:
        lines = (self.folder / "status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024
