"""Shared by all attacks: the program, the checks, and the final summary."""

import json
import os
import pathlib
import queue
import subprocess
import sys
import threading
import time

VIZFLYT = sys.argv[1] if len(sys.argv) > 1 else "vizflyt"
failures = []


def check(name, holds, why=""):
    print(f"{'ok  ' if holds else 'FAIL'}  {name}{'' if holds else f': {why}'}", flush=True)
    if not holds:
        failures.append(name)


def run(*arguments, within_s=300, **more):
    environment = os.environ | more.pop("environment", {})
    return subprocess.run([VIZFLYT, *map(str, arguments)], capture_output=True, text=True, timeout=within_s,
                          env=environment, check=False, **more)


def end():
    if failures:
        sys.exit(f"{len(failures)} attacks passed: {', '.join(failures)}")
    print("every attack was refused")


class Program:
    """A running `vizflyt`, with the JSON lines that it prints."""

    def __init__(self, *arguments, limits=None):
        command = [VIZFLYT, *map(str, arguments)]
        if limits:
            command = ["sh", "-c", f'ulimit {limits} && exec "$0" "$@"', *command]
        self.errors = []
        self.queue = queue.Queue()
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                                        text=True)
        for read in (self.read_lines, self.read_errors):
            threading.Thread(target=read, daemon=True).start()

    def read_lines(self):
        for line in self.process.stdout:
            self.queue.put(line)
        self.queue.put(None)

    def read_errors(self):
        for line in self.process.stderr:
            self.errors.append(line)

    def line(self, holds, within_s=60.0):
        """Returns the next line for which `holds` is true."""
        until = time.monotonic() + within_s
        while (line := self.queue.get(timeout=max(until - time.monotonic(), 0.01))) is not None:
            try:
                found = json.loads(line)
            except json.JSONDecodeError:
                continue
            if holds(found):
                return found
        raise EOFError(f"{VIZFLYT} has ended: {''.join(self.errors)[-2000:]}")

    def end(self):
        self.process.kill()
        self.process.wait()


def scene(folder, more="", name="course"):
    """Generates a course; returns its `arena.toml`."""
    made = run("scene", "generate", "race", "-o", folder / name)
    if made.returncode:
        raise OSError(made.stderr)
    arena = pathlib.Path(folder / name / "arena.toml")
    arena.write_text(arena.read_text() + more)
    return arena
