"""The command line of tests/bench/run."""

import argparse
import datetime
import os
import sys
import tempfile
from pathlib import Path

import figures
import machine
import tables
from document import DocumentError, block, replaced
from lab import Lab

COMMITTED = Path(__file__).with_name("figures.json")
DOCUMENT = tables.ROOT / "docs" / "BENCHMARKS.md"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="tests/bench/run",
        description="Runs the commands of the tables in docs/BENCHMARKS.md, and prints which figures moved by more "
                    "than 10 % against the committed ones (tests/bench/figures.json), as ratios to a reference kernel "
                    "that is timed in the same turns. Without --update nothing is written.")
    parser.add_argument("--only", action="append", metavar="NAME", help="this table; may be given several times")
    parser.add_argument("--update", action="store_true", help="writes tables, drawings and committed figures")
    parser.add_argument("--tables", action="store_true",
                        help="only writes tables and drawings anew, of the committed figures: after a change of layout")
    parser.add_argument("--list", action="store_true", help="lists all tables, with what those typed by hand need")
    parser.add_argument("--turns", type=int, metavar="N", help="how many turns, in place of each table's own number")
    target = Path(os.environ.get("CARGO_TARGET_DIR", tables.ROOT / "target"))
    parser.add_argument("--program", default=str(target / "release" / "vizflyt"),
                        help="the built program [target/release/vizflyt]")
    parser.add_argument("--folder", help="where scenes and files go, and stay [a temporary folder]")
    args = parser.parse_args()
    unknown = set(args.only or ()) - set(tables.MEASURED)
    if unknown:
        parser.error(f"no table {', '.join(sorted(unknown))}; there are {', '.join(tables.MEASURED)}")
    if args.turns is not None and args.turns < 1:
        parser.error("--turns: 1 or more")
    if not (args.list or args.tables) and not os.access(args.program, os.X_OK):
        parser.error(f"no program {args.program}; build it (cargo build --release), or name another with --program")
    return args


def take(name: str, lab: Lab, turns: int | None) -> figures.Taken:
    """Measures a table, with the kernels before, between and after its turns."""
    table = tables.MEASURED[name]
    load, references, taken = machine.load(), [machine.reference()], []
    for _ in range(turns or table.turns):
        taken.append(table.measure(lab))
        references.append(machine.reference())
    reference = figures.least(references)
    least_ms, most_ms = reference.of(table.kernel), max(one.of(table.kernel) for one in references)
    if most_ms > figures.MOVED * least_ms:
        print(f"   the machine changed meanwhile: {table.kernel} took {least_ms:.2f} to {most_ms:.2f} ms")
    return figures.Taken(figures.best(taken), reference, len(taken), datetime.date.today().isoformat(),
                         machine.processor(), load)


def tell(name: str, before: figures.Taken | None, after: figures.Taken) -> None:
    """Prints the changed figures."""
    if before is None:
        print("   not committed yet: nothing to compare with")
        return
    if before.processor != after.processor:
        print(f"   another processor than the committed figures' ({before.processor}): ratios say little")
    if after.load > (os.cpu_count() or 1):
        print(f"   load {after.load}: others use the processors; times that are not the processor's say little")
    kernel = tables.MEASURED[name].kernel
    found = figures.moved(before, after, kernel)
    for one in found:
        name = one.name.removesuffix(" | ")
        print(f"   moved: {name}: {one.before} -> {one.after}, {one.ratio:.2f} by the reference")
    gone, new = set(before.figures) - set(after.figures), set(after.figures) - set(before.figures)
    for what, names in (("no more", gone), ("new", new)):
        if names:
            print(f"   {what}: {', '.join(sorted(names))}")
    print(f"   {len(found)} of {len(after.figures)} moved by more than 10 %; "
          f"{kernel}: {before.reference.of(kernel):.2f} -> {after.reference.of(kernel):.2f} ms; "
          f"load: {before.load} -> {after.load}")


def list_tables() -> None:
    for name, table in tables.MEASURED.items():
        print(f"{name:<10} {'; '.join(table.commands)}")
    for row in tables.BY_HAND:
        command = f" ({row.command})" if row.command else ""
        print(f"{'by hand':<10} {row.section}{command}: not run here: needs {row.needs}")


def read_committed() -> dict[str, figures.Taken]:
    return figures.from_json(COMMITTED.read_text()) if COMMITTED.exists() else {}


def write(taken: dict[str, figures.Taken], text: str) -> None:
    """Writes figures, document and drawings; builds the whole document before it writes any file."""
    shown = {name: tables.shown(name, one) for name, one in taken.items()}
    document = replaced(text, {**shown, "by-hand": tables.by_hand()})
    COMMITTED.write_text(figures.to_json(taken))
    DOCUMENT.write_text(document)
    for name, one in taken.items():
        if tables.MEASURED[name].drawing:
            file, draw = tables.MEASURED[name].drawing
            (DOCUMENT.parent / file).write_text(draw(one.figures))


def main() -> int:
    args = arguments()
    if args.list:
        list_tables()
        return 0
    text, committed = DOCUMENT.read_text(), read_committed()
    if args.tables:
        write(committed, text)
        return 0
    names = args.only or list(tables.MEASURED)
    for name in [*names, "by-hand"]:
        block(text, name)
    with tempfile.TemporaryDirectory() as temporary:
        lab = Lab(str(Path(args.program).resolve()), Path(args.folder or temporary).resolve())
        lab.folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            print(f"{name}", flush=True)
            after = take(name, lab, args.turns)
            tell(name, committed.get(name), after)
            # Save each table at once, so that a failure of the next one does not lose it.
            if args.update:
                write({**read_committed(), name: after}, DOCUMENT.read_text())
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (DocumentError, figures.FiguresError, machine.CommandFailed) as error:
        sys.exit(f"tests/bench/run: {error}")
