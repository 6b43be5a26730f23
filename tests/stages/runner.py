"""Runs the stages of `table.py`; `tests/run` calls it.

Stages run in two lanes: stages that wait for real time run one at a time, and computing stages use the remaining time
(`tests/idle`), and then the complete machine. Output goes to `target/tests/NAME.log`, and to the terminal if a stage
fails.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

import changes
import counts
import table
from table import CLOCK, COMPUTE, FIRST, HEAVY, QUICK, Need, Stage

ROOT = pathlib.Path(__file__).resolve().parents[2]
LOGS = ROOT / "target/tests"


@dataclasses.dataclass
class Result:
    """How a stage ended."""

    stage: Stage
    outcome: str
    """`passed`, `failed` or `skipped`."""
    why: str = ""
    seconds: float = 0.0
    processor_s: float = 0.0
    """User and system time of the stage and all that it started [s]."""
    tests: counts.Counts = dataclasses.field(default_factory=counts.Counts)


class Run:
    """One run: prints progress, keeps the results."""

    def __init__(self, quick_crates: str | None, verbose: bool) -> None:
        self.started = time.monotonic()
        self.crates = quick_crates
        self.verbose = verbose
        self.results: list[Result] = []
        self.groups: set[int] = set()
        self.lock = threading.Lock()
        self.total = 0
        self.is_stopped = False
        self.is_clock_busy = False
        """A stage that waits for real time is running: computing stages get a lower priority."""

    def say(self, text: str) -> None:
        elapsed = int(time.monotonic() - self.started)
        with self.lock:
            print(f"{elapsed // 60:3d}:{elapsed % 60:02d}  {text}", flush=True)

    def skip(self, stage: Stage, why: str) -> None:
        self.results.append(Result(stage, "skipped", why))
        self.say(f"skipped  {stage.title}: {why}")

    def run(self, stage: Stage) -> bool:
        """Runs a stage; returns whether it passed."""
        command = stage.command
        if self.crates is not None and stage.when_quick:
            command = stage.when_quick.format(crates=self.crates)
        log = LOGS / f"{stage.name}.log"
        self.say(f"start    {stage.title} (usually {stage.expected_s} s; {log.relative_to(ROOT)})")
        begin = time.monotonic()
        idle = ["tests/idle"] if stage.lane == COMPUTE and self.is_clock_busy else []
        with log.open("wb") as output:
            child = subprocess.Popen(
                [*idle, "bash", "-c", f"set -euo pipefail\n{command}"],
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            self.groups.add(child.pid)
            # Not `wait`, which does not return the processor time of only this child.
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
            self.groups.discard(child.pid)
        # Remaining processes would disturb the next stage.
        kill_group(child.pid)
        text = log.read_text(errors="replace")
        passed = child.returncode == 0
        result = Result(
            stage,
            "passed" if passed else "failed",
            "" if passed else f"exit status {child.returncode}",
            time.monotonic() - begin,
            usage.ru_utime + usage.ru_stime,
            counts.of(text, passed),
        )
        self.results.append(result)
        done = sum(r.outcome != "skipped" for r in self.results)
        self.say(
            f"{result.outcome:8s} {stage.title}: {result.seconds:.0f} s, {result.processor_s:.0f} of a processor; "
            f"{result.tests}  [{done}/{self.total}]"
        )
        if not passed or self.verbose:
            with self.lock:
                print(indent(text if self.verbose else tail(text, 60)), flush=True)
        return passed

    def lane(self, stages: Sequence[Stage]) -> None:
        for stage in stages:
            if self.is_stopped:
                return
            self.run(stage)
        if stages and stages[0].lane == CLOCK:
            self.is_clock_busy = False

    def stop(self) -> None:
        self.is_stopped = True
        for group in list(self.groups):
            kill_group(group)

    def summary(self) -> int:
        """Prints failures and totals; returns the exit status."""
        print(f"\n{'seconds':>9} {'processor':>9}  stage")
        for result in self.results:
            if result.outcome != "skipped":
                print(f"{result.seconds:9.0f} {result.processor_s:9.0f}  {result.stage.title}")
        seconds = time.monotonic() - self.started
        print(f"{seconds:9.0f} {sum(r.processor_s for r in self.results):9.0f}  in all")
        for result in self.results:
            if result.outcome == "skipped":
                print(f"skipped: {result.stage.title}: {result.why}")
        failed = [result for result in self.results if result.outcome == "failed"]
        for result in failed:
            print(f"\nfailed: {result.stage.title} ({result.why}; target/tests/{result.stage.name}.log)")
            print(indent(tail((LOGS / f"{result.stage.name}.log").read_text(errors="replace"), 25)))
        total = counts.Counts()
        for result in self.results:
            total += result.tests
        total.skipped += sum(result.outcome == "skipped" for result in self.results)
        print(f"\n{total}")
        return 1 if failed or self.is_stopped else 0


def main() -> int:
    args = arguments()
    os.chdir(ROOT)
    if args.list:
        print_table()
        return 0
    prepare_environment()
    LOGS.mkdir(parents=True, exist_ok=True)
    record = changes.Record(ROOT)
    crates = changes.crates(ROOT, args.base) if args.quick else None
    run = Run(None if crates is None else " ".join(f"-p {name}" for name in crates), args.verbose)
    chosen = choose(args, record, crates, run)
    missing = missing_needs(chosen)
    if missing:
        chosen = install_or_skip(missing, chosen, run, may_install=not args.quick)
    signal.signal(signal.SIGTERM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    run.total = len(chosen)
    minutes = sum(stage.expected_s for stage in chosen) / 60
    print(f"{len(chosen)} stages, about {minutes:.0f} minutes of stages, partly two at a time", flush=True)
    hashes = {stage.name: record.hash_of(stage) for stage in chosen if stage.tier == HEAVY}
    try:
        if all(run.run(stage) for stage in chosen if stage.lane == FIRST):
            run.is_clock_busy = any(stage.lane == CLOCK for stage in chosen)
            lanes = [
                threading.Thread(target=run.lane, args=([stage for stage in chosen if stage.lane == lane],))
                for lane in (CLOCK, COMPUTE)
            ]
            for thread in lanes:
                thread.start()
            for thread in lanes:
                thread.join()
    except KeyboardInterrupt:
        run.stop()
        run.say("stopped")
    passed = {result.stage.name for result in run.results if result.outcome == "passed"}
    if args.all or args.stages:
        record.write({name: value for name, value in hashes.items() if name in passed})
    return run.summary()


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="tests/run",
        description="Runs the tests. Without options: everything that is quick enough for each change, and each slow "
        "stage whose inputs have changed since it last passed. The stages are in tests/stages/table.py.",
    )
    tier = parser.add_mutually_exclusive_group()
    tier.add_argument(
        "--quick",
        action="store_true",
        help="only the crates changed since --base: lints and unit tests; installs nothing",
    )
    tier.add_argument(
        "--all", action="store_true", help="every stage; those that pass are recorded in tests/all-passed.toml"
    )
    parser.add_argument(
        "--base",
        default="origin/main",
        metavar="REV",
        help="with --quick: what the changes are relative to [origin/main, or else HEAD]",
    )
    parser.add_argument("--list", action="store_true", help="print the stages and exit")
    parser.add_argument("-v", "--verbose", action="store_true", help="print the output of stages that pass, too")
    parser.add_argument("stages", nargs="*", metavar="STAGE", help="only these stages, after the build")
    args = parser.parse_args()
    names = {stage.name for stage in table.STAGES}
    for name in args.stages:
        if name not in names:
            parser.error(f"no stage '{name}'; `tests/run --list` prints their names")
    if args.stages and (args.quick or args.all):
        parser.error("either stages, or --quick, or --all")
    return args


def choose(args: argparse.Namespace, record: changes.Record, crates: list[str] | None, run: Run) -> list[Stage]:
    """Returns the stages of this run, in the order of the table."""
    if args.stages:
        return [
            stage
            for stage in table.STAGES
            if stage.name in args.stages or (stage.lane == FIRST and stage.name != "format")
        ]
    if args.quick:
        return [
            stage for stage in table.STAGES if stage.tier == QUICK and (crates or "{crates}" not in stage.when_quick)
        ]
    chosen = []
    for stage in table.STAGES:
        if stage.tier == HEAVY and not args.all and (passed := record.passed(stage)):
            run.skip(stage, f"unchanged since it passed on {passed}")
        else:
            chosen.append(stage)
    return chosen


def missing_needs(stages: Sequence[Stage]) -> dict[str, list[Need]]:
    """Returns the missing needs of each stage."""
    tested: dict[str, bool] = {}
    for need in {need.test: need for stage in stages for need in stage.needs}.values():
        tested[need.test] = subprocess.run(["bash", "-c", f"({need.test}) >/dev/null 2>&1"]).returncode == 0
    missing = {stage.name: [need for need in stage.needs if not tested[need.test]] for stage in stages}
    return {name: needs for name, needs in missing.items() if needs}


def install_or_skip(missing: dict[str, list[Need]], chosen: list[Stage], run: Run, may_install: bool) -> list[Stage]:
    """Installs what is missing with apt, after asking if there is a terminal; or skips the stages that need it."""
    packages = sorted({word for needs in missing.values() for need in needs for word in need.package.split()})
    root = [] if os.geteuid() == 0 else ["sudo", "-n"]
    can_install = (
        may_install
        and shutil.which("apt-get")
        and (not root or subprocess.run([*root, "true"], capture_output=True).returncode == 0)
    )
    print(f"Debian packages that tests use and this machine lacks: {' '.join(packages)}", flush=True)
    if can_install and sys.stdin.isatty():
        can_install = input("install them with apt-get? [Y/n] ").strip().lower() in ("", "y", "yes")
    if can_install:
        print("installing them with apt-get", flush=True)
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        for command in (["update", "-q"], ["install", "-y", "-q", "--no-install-recommends", *packages]):
            subprocess.run([*root, "apt-get", *command], check=True, env=environment, stdout=subprocess.DEVNULL)
        return chosen
    kept = []
    for stage in chosen:
        if stage.name in missing:
            names = " ".join(need.package for need in missing[stage.name])
            if stage.lane == FIRST:
                sys.exit(f"{stage.title} needs: {names}; install it, then run again")
            run.skip(stage, f"needs {names}")
        else:
            kept.append(stage)
    return kept


def prepare_environment() -> None:
    """Uses `target/home` as the home folder if the user's is not writable."""
    os.environ.setdefault("CARGO_TERM_COLOR", "never")
    home = os.environ.get("HOME", "")
    if not home or not os.access(home, os.W_OK):
        os.environ.setdefault("RUSTUP_HOME", f"{home}/.rustup")
        os.environ["HOME"] = str(ROOT / "target/home")
        os.environ.setdefault("CARGO_HOME", f"{os.environ['HOME']}/.cargo")
        os.makedirs(os.environ["HOME"], exist_ok=True)


def print_table() -> None:
    record = changes.Record(ROOT)
    print(f"{'stage':16} {'tier':9} {'lane':8} {'usual':>6}  title")
    for stage in table.STAGES:
        print(f"{stage.name:16} {stage.tier:9} {stage.lane:8} {stage.expected_s:4d} s  {stage.title}")
        if stage.tier == HEAVY:
            passed = record.passed(stage)
            state = f"unchanged since {passed}" if passed else "changed, or never passed"
            print(f"{'':16} {state}: {' '.join(stage.inputs)}")


def kill_group(group: int) -> None:
    try:
        os.killpg(group, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        pass


def tail(text: str, lines: int) -> str:
    return "\n".join(text.splitlines()[-lines:])


def indent(text: str) -> str:
    return re.sub("^", "    ", text, flags=re.MULTILINE)


if __name__ == "__main__":
    sys.exit(main())
