"""The command line of tests/bench/turns: two builds fly the loop in alternation.

The speed of a shared computer varies with time. When two builds alternate, each pair flies at about the same time, and
the median of the pairs' ratios shows the difference between the builds.
"""

import argparse
import contextlib
import json
import socket
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import machine

# Compared quantities: name, and key in the demo's report.
COMPARED = {"age p50 [ms]": "age_ms_p50", "age p99 [ms]": "age_ms_p99", "images a second": "image_hz",
            "drawing p50 [ms]": "render_ms_p50", "processor [s]": "processor_s"}


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="tests/bench/turns",
        description="Flies `vizflyt demo --headless --seed 7` with two programs in turns, and prints what of the loop "
                    "differs: medians, and the ratios after / before of each turn: their median, least and greatest. A "
                    "difference is one if all ratios are on the same side of 1. One program given twice tells what the "
                    "computer does by itself.")
    parser.add_argument("before", type=Path, help="a built program, as target/release/vizflyt")
    parser.add_argument("after", type=Path, help="another one")
    parser.add_argument("--turns", type=int, default=5, help="flights of each, some 30 s long [5]")
    parser.add_argument("--pages", type=int, default=0,
                        help="so many open pages watch the second one's flights, of the lowest priority here [0]")
    parser.epilog = "After --: further arguments of both demos, as --through-bridge."
    given = sys.argv[1:]
    end = given.index("--") if "--" in given else len(given)
    args = parser.parse_args(given[:end])
    args.demo = given[end + 1:]
    for program in (args.before, args.after):
        if not program.is_file():
            parser.error(f"no program {program}; build it (cargo build --release)")
    if args.turns < 1:
        parser.error("--turns: 1 or more")
    return args


def fly(program: Path, folder: Path, more: list[str], pages: int) -> dict[str, float]:
    """Flies once; returns the compared quantities."""
    report = folder / "report.json"
    with watched(pages) as address:
        used = machine.run([str(program.resolve()), "demo", "--headless", "--seed", "7", "--seconds", "90", "--report",
                            str(report), *address, *more], folder, most=1)
    found = {**json.loads(report.read_text()), "processor_s": used.processor_s}
    return {name: found[key] for name, key in COMPARED.items()}


@contextlib.contextmanager
def watched(pages: int) -> Iterator[list[str]]:
    """Opens `pages` pages; yields the additional arguments for the demo."""
    if pages == 0:
        yield []
        return
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    viewers_py = str(Path(__file__).with_name("viewers.py"))
    command = ["nice", "-n", "19", sys.executable, viewers_py, address, "vizflyt", str(pages)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as viewers:
        try:
            yield ["--port", address.rpartition(":")[2]]
            pictures, _ = viewers.communicate(timeout=10)
            print(f"{pages} pages got {int(pictures)} pictures", flush=True)
        finally:
            viewers.kill()


def ratios(pairs: dict[str, list[tuple[float, float]]]) -> list[str]:
    """Returns a line for each name: medians before and after; median, minimum and maximum of the pairs' ratios."""
    lines = []
    for name, values in pairs.items():
        before, after = (statistics.median(pair[i] for pair in values) for i in (0, 1))
        each = [b / a for a, b in values]
        lines.append(f"{name:<24}{before:>12.1f}{after:>11.1f}{statistics.median(each):>10.2f}"
                     f"{min(each):>7.2f} to {max(each):.2f}")
    return lines


def main() -> None:
    args = arguments()
    pairs: dict[str, list[tuple[float, float]]] = {name: [] for name in COMPARED}
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(args.turns):
            # The first flight of a pair finds the computer in another state: alternate which build is first.
            order = [0, 1] if turn % 2 == 0 else [1, 0]
            flown = {which: fly((args.before, args.after)[which], Path(folder), args.demo, args.pages * which)
                     for which in order}
            for name in COMPARED:
                pairs[name].append((flown[0][name], flown[1][name]))
            both = (f"{name} {flown[0][name]:.1f}, {flown[1][name]:.1f}" for name in COMPARED)
            print(f"turn {turn + 1}: " + "; ".join(both), flush=True)
    print(f"\n{'median of turns':<24}{'before':>12}{'after':>11}{'ratio':>10}   least to greatest")
    print("\n".join(ratios(pairs)))


if __name__ == "__main__":
    try:
        main()
    except machine.CommandFailed as error:
        sys.exit(f"tests/bench/turns: {error}")
