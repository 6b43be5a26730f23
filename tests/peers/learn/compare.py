"""Compares steps per second of `vizflyt.gym` and other simulators for learning on a processor, in alternation; prints
Markdown.

    compare.py FOLDER [--rounds N] [--seconds S] [--only TABLE]

FOLDER has a Python environment for each simulator, made by `tests/peers/learn/run`. In a round each simulator of a
table steps for S seconds, one after the other; a rate is the median over the rounds.
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

WORKER = Path(__file__).absolute().with_name("worker.py")
# Compared configurations: name, vehicles, cores, simulators. The first one is this project's.
TABLES = {
    "state, one vehicle, one core": (1, 1, [
        "vizflyt race", "vizflyt forest", "gym-pybullet-drones velocity", "gym-pybullet-drones rpm", "pyflyt velocity",
        "crazyflow first_principles", "crazyflow so_rpy",
    ]),
    "state, 8 vehicles, two cores": (8, 2, [
        "vizflyt race", "vizflyt forest", "gym-pybullet-drones velocity", "gym-pybullet-drones velocity async",
        "gym-pybullet-drones rpm async", "pyflyt velocity", "pyflyt velocity async", "crazyflow first_principles",
        "crazyflow so_rpy",
    ]),
    "state, 1024 vehicles, two cores": (1024, 2, [
        "vizflyt race", "vizflyt forest", "crazyflow first_principles", "crazyflow so_rpy",
    ]),
    "images of 64x48, one vehicle, one core": (1, 1, [
        "vizflyt race depth", "vizflyt forest depth", "vizflyt race rgb", "vizflyt forest rgb",
        "gym-pybullet-drones image", "pyflyt image", "crazyflow depth",
    ]),
    "images of 64x48, 8 vehicles, two cores": (8, 2, [
        "vizflyt race depth", "vizflyt forest depth", "vizflyt race rgb", "vizflyt forest rgb",
        "gym-pybullet-drones image", "gym-pybullet-drones image async", "pyflyt image", "pyflyt image async",
        "crazyflow depth",
    ]),
}  # fmt: skip


class Worker:
    def __init__(self, folder, maker, vehicles, cores, scratch):
        python = folder.absolute() / maker.split()[0] / "bin" / "python"
        command = [python, WORKER, maker, str(vehicles), str(cores)]
        self.maker = maker
        # Its own process group: it ends with all its child processes.
        self.process = subprocess.Popen(
            command, cwd=scratch, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
            stderr=None if os.environ.get("VERBOSE") else subprocess.DEVNULL,
        )  # fmt: skip
        self.turns = []

    def answer(self):
        line = self.process.stdout.readline()
        if not line:
            sys.exit(f"{self.maker} has ended with status {self.process.wait()}; VERBOSE=1 shows what it says")
        return json.loads(line)

    def turn(self, seconds):
        self.process.stdin.write(f"{seconds}\n")
        self.process.stdin.flush()
        self.turns.append(self.answer())

    def rate(self):
        return statistics.median(steps / elapsed_s for steps, elapsed_s, _ in self.turns)

    def processor_ms(self):
        return statistics.median(1e3 * spent_s / steps for steps, _, spent_s in self.turns)

    def end(self):
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.process.wait()


def compare(folder, title, rounds, seconds, scratch):
    vehicles, cores, makers = TABLES[title]
    workers = []
    try:
        for maker in makers:
            workers.append(Worker(folder, maker, vehicles, cores, scratch))
            workers[-1].answer()
        for worker in workers:
            # Warm-up that does not count: caches, compilers.
            worker.turn(0.5)
            worker.turns.clear()
        for _ in range(rounds):
            for worker in workers:
                worker.turn(seconds)
    finally:
        for worker in workers:
            worker.end()
    first = workers[0]
    print(f"\n{title}:\n")
    print("| simulator | steps a second | least, most | of ours | processor a step [ms] | of ours |")
    print("|---|---|---|---|---|---|")
    for worker in workers:
        rates = [steps / elapsed_s for steps, elapsed_s, _ in worker.turns]
        ratio, cost = worker.rate() / first.rate(), worker.processor_ms() / first.processor_ms()
        print(
            f"| {worker.maker} | {worker.rate():.0f} | {min(rates):.0f}, {max(rates):.0f} | {ratio:.3f} "
            f"| {worker.processor_ms():.4f} | {cost:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--only", choices=TABLES, help="one table of these")
    args = parser.parse_args()
    # Some simulators leave files in the working folder.
    with tempfile.TemporaryDirectory() as scratch:
        for title in [args.only] if args.only else TABLES:
            compare(args.folder, title, args.rounds, args.seconds, scratch)
