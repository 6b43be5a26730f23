"""tests/bench: the pure functions of the benchmark command, and that every measured table of docs/BENCHMARKS.md is
generated."""

import importlib
import math
import random
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BENCH = ROOT / "tests" / "bench"
NAMES = ["machine", "document", "figures", "plot", "lab", "viewers", "growth", "tables", "turns"]


def load():
    """Returns the command's modules, which import one another by their plain names, and removes those names again."""
    sys.path.insert(0, str(BENCH))
    try:
        return [importlib.import_module(name) for name in NAMES]
    finally:
        sys.path.remove(str(BENCH))
        for name in NAMES:
            sys.modules.pop(name, None)


machine, document, figures, plot, lab, viewers, growth, tables, turns = load()
DOCUMENT = """# Benchmarks

<!-- bench:loop -->
old
<!-- /bench -->

Text | with | bars.

<!-- bench:race -->
<!-- /bench -->
"""


# --- the document ---

def test_tables_are_replaced_between_their_markers_alone():
    text = document.replaced(DOCUMENT, {"loop": "| a |\n|---|\n| 1 |", "race": "new"})
    assert text == """# Benchmarks

<!-- bench:loop -->

| a |
|---|
| 1 |

<!-- /bench -->

Text | with | bars.

<!-- bench:race -->

new

<!-- /bench -->
"""
    assert document.block(text, "loop") == "| a |\n|---|\n| 1 |"
    assert document.replaced(text, {"race": "new"}) == text


@pytest.mark.parametrize("damaged, said", [
    (DOCUMENT.replace("<!-- bench:loop -->\n", ""), "line 4: '<!-- /bench -->' without a start"),
    (DOCUMENT.replace("<!-- /bench -->\n\nText", "Text"), "line 7: bench:race begins before bench:loop has ended"),
    (DOCUMENT.removesuffix("<!-- /bench -->\n"), "bench:race has no end"),
    (DOCUMENT.replace("bench:race", "bench:loop"), "line 9: bench:loop is there a second time"),
    (DOCUMENT.replace("<!-- bench:loop -->", "<!--bench:loop-->"), "line 3: '<!--bench:loop-->' is no marker"),
    (DOCUMENT.replace("<!-- bench:loop -->", "<!-- bench: loop -->"), "is no marker"),
    (DOCUMENT.replace("<!-- bench:loop -->", "see <!-- bench:loop -->"), "is no marker"),
    (DOCUMENT.replace("<!-- /bench -->", "<!-- /bench"), "is no marker"),
    (DOCUMENT.replace("bench:race", "bench:races"), "no table bench:race; put '<!-- bench:race -->'"),
])
def test_damaged_markers_are_told_of(damaged, said):
    with pytest.raises(document.DocumentError) as error:
        document.replaced(damaged, {"loop": "new", "race": "new"})
    assert said in str(error.value)


def test_text_between_tables_survives_any_damage():
    """Damages lines at random: the result is an error, or only the text between markers changes."""
    chance = random.Random(1)
    lines = DOCUMENT.split("\n")
    for _ in range(2000):
        mixed = [chance.choice([line, line, line, line[chance.randrange(2):], chance.choice(lines)]) for line in lines]
        text = "\n".join(mixed)
        try:
            new = document.replaced(text, {"loop": "figures"})
        except document.DocumentError:
            continue
        begin, end = document.blocks(text)["loop"]
        after = document.blocks(new)["loop"]
        assert new.split("\n")[:after[0]] == mixed[:begin]
        assert new.split("\n")[after[1]:] == mixed[end:]


def test_printed_tables_are_read_and_made():
    said = "warm up\n| a | b |\n|---|:--|\n| x, y | 1.50 |\n\nmore\n  | c |\n  |---|\n  | 2 |\n|"
    assert document.printed_tables(said) == [[["a", "b"], ["x, y", "1.50"]], [["c"], ["2"]]]
    assert document.markdown(["a", "b"], [["x", "1"]]) == "| a | b |\n|---|---|\n| x | 1 |"
    assert tables.printed(said) == {}
    (figure,) = tables.printed(said.partition("more")[0], timed=("b",)).items()
    assert figure == ("x, y | b", figures.Figure(1.5, 2, "time"))


def test_the_least_sample_of_criterion_counts():
    said = '{"sampling_mode":"Linear","iters":[10.0,20.0,30.0],"times":[1200.0,1900.0,3600.0]}'
    assert tables.least_sample_ns(said) == 95.0


def test_pictures_of_a_page_are_counted():
    message = lambda kind, length: (bytes([0x80 | kind]) + (
        bytes([length]) if length < 126 else b"\x7e" + length.to_bytes(2, "big") if length < 1 << 16 else
        b"\x7f" + length.to_bytes(8, "big")) + bytes(length))
    sent = b"".join(message(kind, length) for kind, length in [(2, 5), (1, 130), (2, 70_000), (9, 0), (2, 126)])
    chance = random.Random(4)
    for _ in range(200):
        left, pictures, at = b"", 0, 0
        while at < len(sent):
            end = at + chance.choice([1, 2, 3, 50, 5000, 70_000])
            found, left = viewers.frames(left + sent[at:end])
            pictures, at = pictures + found, end
        assert (pictures, left) == (3, b"")
    for _ in range(2000):
        noise = chance.randbytes(chance.randrange(40))
        pictures, left = viewers.frames(noise)
        assert noise.endswith(left)
        assert pictures <= len(noise) // 2


# --- figures ---

def taken(found, computing_ms=10.0):
    return figures.Taken(found, figures.Reference(computing_ms, 20.0), 3, "2026-11-26", "2 x a processor", 0.5)


def test_the_turn_that_was_disturbed_least_counts():
    turn = lambda ms, hz, n: {"a | ": figures.time(ms), "b | ": figures.rate(hz), "c | ": figures.count(n)}
    best = figures.best([turn(3.0, 50.0, 7), turn(2.0, 60.0, 9), turn(4.0, 55.0, 8)])
    assert [figure.value for figure in best.values()] == [2.0, 60.0, 8]
    with pytest.raises(figures.FiguresError, match="other figures than the first"):
        figures.best([turn(1, 1, 1), {"a | ": figures.time(1.0)}])


@pytest.mark.parametrize("before, after, computing_ms, ratio", [
    (figures.time(10.0), figures.time(12.0), 10.0, 1.2), # slower
    (figures.time(10.0), figures.time(12.0), 12.0, None), # the machine is slower by the same factor
    (figures.time(10.0), figures.time(10.0), 12.0, 10 / 12), # faster than expected from the machine
    (figures.rate(60.0), figures.rate(50.0), 12.0, None),
    (figures.rate(60.0), figures.rate(50.0), 10.0, 50 / 60),
    (figures.count(20), figures.count(19), 99.0, None),
    (figures.count(20), figures.count(10), 99.0, 0.5),
    (figures.count(0), figures.count(0), 10.0, None),
    (figures.count(0), figures.count(1), 10.0, math.inf),
    (figures.time(0.001), figures.time(0.002), 10.0, None), # both are shown as 0.00
])
def test_what_moved_is_told_by_the_reference(before, after, computing_ms, ratio):
    found = figures.moved(taken({"a | b": before}), taken({"a | b": after}, computing_ms), "computing")
    assert [one.ratio for one in found] == ([] if ratio is None else [pytest.approx(ratio)])


def test_figures_come_back_from_their_file():
    chance = random.Random(2)
    found = {f"row {i}, \"ä\" | [ms]": figures.Figure(chance.uniform(-1e6, 1e6), chance.randrange(4), kind)
             for i, kind in enumerate(figures.KINDS * 5)}
    text = figures.to_json({"render": taken(found), "loop": taken({})})
    assert figures.from_json(text) == {"loop": taken({}), "render": taken(found)}
    assert list(figures.from_json(text)["render"].figures) == list(found)


def test_a_damaged_file_of_figures_is_told_of():
    text = figures.to_json({"render": taken({"a | b": figures.time(1.5), "c | d": figures.count(3)})})
    chance = random.Random(3)
    for _ in range(3000):
        at, end = sorted(chance.randrange(len(text)) for _ in range(2))
        damaged = text[:at] + "".join(chance.choices('{}[],:"0e-n', k=chance.randrange(3))) + text[end:]
        try:
            read = figures.from_json(damaged)
        except figures.FiguresError as error:
            assert "as it was committed" in str(error)
            continue
        assert all(isinstance(table, figures.Taken) for table in read.values())
    for kind in ('"nonsense"', "7"):
        with pytest.raises(figures.FiguresError):
            figures.from_json(text.replace('"time"', kind))


# --- growth and its drawing ---

def test_an_exponent_is_that_of_the_last_step():
    assert growth.exponent([(1.0, 5.0), (10.0, 5.0), (100.0, 50.0)]) == pytest.approx(1.0)
    assert growth.exponent([(1.0, 5.0), (100.0, 5.0)]) == 0.0


def test_a_drawing_holds_all_points():
    curve = plot.Curve("adaptive", [(10.0**n, 0.02 * 3.0**n) for n in range(4, 8)])
    flat = plot.Curve("flat", [(10.0**n, 1.0) for n in range(4, 8)])
    root = ElementTree.fromstring(plot.svg([plot.Panel("image [ms]", "splats", [curve, flat])] * 4))
    width, height = (float(word) for word in root.attrib["viewBox"].split()[2:])
    circles = root.findall("{*}circle")
    assert len(circles) == 32
    for circle in circles:
        assert 0 < float(circle.attrib["cx"]) < width
        assert 0 < float(circle.attrib["cy"]) < height


# --- the committed document ---

def test_no_measured_table_was_typed():
    text = (ROOT / "docs" / "BENCHMARKS.md").read_text()
    committed = figures.from_json((BENCH / "figures.json").read_text())
    assert set(document.blocks(text)) == {*tables.MEASURED, "by-hand"}
    assert set(committed) == set(tables.MEASURED)
    assert document.block(text, "by-hand") == tables.by_hand()
    for name, table in committed.items():
        assert document.block(text, name) == tables.shown(name, table), f"tests/bench/run --only {name} --update"
        drawing = tables.MEASURED[name].drawing
        if drawing:
            assert (ROOT / "docs" / drawing[0]).read_text() == drawing[1](table.figures)


# --- turns ---

def test_ratios_of_turns_are_of_pairs():
    lines = turns.ratios({"age p50 [ms]": [(10.0, 12.0), (20.0, 22.0), (10.0, 13.0)]})
    assert lines == ["age p50 [ms]                    10.0       13.0      1.20   1.10 to 1.30"]
