"""Flies every check against one autopilot; see `run`.

Checks: pilot (pilot's override), net (the fence holds), failsafe (losses in flight), station (a second system 255).
"""

import argparse
import contextlib
import pathlib
import signal
import subprocess
import sys
import tempfile

import failsafe
import net
import pilot
import station
from checks import say, skip, summary
from lab import Lab
from simulated import Simulated
from sitl import Sitl

CHECKS = {"pilot": pilot, "net": net, "failsafe": failsafe, "station": station}
ROOT = pathlib.Path(__file__).parents[2]


def arguments():
    parser = argparse.ArgumentParser(prog="tests/ardupilot/run", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few flights of each check, in about a minute")
    parser.add_argument("--only", default=",".join(CHECKS), metavar="CHECKS", help="some of %(default)s")
    parser.add_argument("--vizflyt", default=ROOT / "target/debug/vizflyt", type=pathlib.Path, metavar="PROGRAM")
    parser.add_argument("--plugin", type=pathlib.Path, help="the example `misbehave`, if not beside PROGRAM")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="another parameter")
    parser.add_argument("--keep", type=pathlib.Path, metavar="FOLDER", help="keeps logs and parameters there")
    parser.add_argument("binary", type=pathlib.Path)
    given = parser.parse_args()
    given.plugin = given.plugin or given.vizflyt.parent / "examples/misbehave"
    for name in given.only.split(","):
        if name not in CHECKS:
            parser.error(f"there is no check '{name}'; there are {', '.join(CHECKS)}")
    if given.keep:
        try:
            given.keep.mkdir(parents=True, exist_ok=True)
        except OSError as why:
            parser.error(f"--keep: {given.keep} cannot be made: {why.strerror}")
    # PX4 is not flown, so this project's programs are not needed.
    for file in (given.binary, *([] if "px4" in given.binary.name else [given.vizflyt, given.plugin])):
        if not file.is_file():
            parser.error(f"there is no {file}; `cargo build --workspace --bins --examples` builds ours")
    return given


def counterpart(binary):
    """Returns the type of the binary, from its help text."""
    help_text = subprocess.run([binary, "--help"], capture_output=True, text=True, timeout=30).stdout
    for kind, option in ((Simulated, "--truth-to"), (Sitl, "--slave")):
        if option in help_text:
            return kind
    sys.exit(f"{binary} is neither ArduCopter for SITL nor our simulator: its help names no --slave and no --truth-to")


def main():
    # SIGTERM also ends the child processes.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))
    given = arguments()
    if "px4" in given.binary.name:
        for name in given.only.split(","):
            skip(name, f"{given.binary.name} is PX4, whose truth, parameters and transmitter this does not know yet")
        return summary()
    kind = counterpart(given.binary)
    with contextlib.ExitStack() as stack:
        folder = given.keep or stack.enter_context(tempfile.TemporaryDirectory())
        vehicle = kind(given.binary.resolve(), pathlib.Path(folder).resolve(), given.vizflyt.resolve(), given.set)
        lab = Lab(vehicle.folder, given.vizflyt.resolve(), given.plugin.resolve(), vehicle)
        for name in given.only.split(","):
            say(f"-- {name}")
            CHECKS[name].run(lab, given.quick)
    return summary()


if __name__ == "__main__":
    sys.exit(main())
