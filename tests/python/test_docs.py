"""Runs the Python code in README and guides."""

import re
from pathlib import Path

import pytest
from conftest import Stage

import vizflyt

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", "docs/guides/plugin.md", "jetson/python/README.md"]
BLOCKS = [
    (page, block)
    for page in PAGES
    for block in re.findall(r"^```python\n(.*?)^```$", (ROOT / page).read_text(), re.M | re.S)
]


def test_the_guide_names_what_intrinsics_have():
    guide = (ROOT / "docs/guides/plugin.md").read_text()
    table = guide[guide.index("## What it sees") : guide.index("## What it answers")]
    # The example of a test shows how to construct these.
    names = [name for name in dir(vizflyt.Intrinsics) if not name.startswith(("_", "from_"))]
    assert "fx_px" in names and [name for name in names if f".{name}" not in table] == []


def test_there_are_examples():
    assert {page for page, _ in BLOCKS} == set(PAGES)


@pytest.mark.parametrize("page, block", BLOCKS, ids=[page for page, _ in BLOCKS])
def test_an_example_runs(page, block, monkeypatch):
    plugins = []
    monkeypatch.setattr(vizflyt, "run", plugins.append)
    exec(compile(block, page, "exec"), {"__name__": "__main__"})
    monkeypatch.undo()
    assert len(plugins) == block.count("vizflyt.run(")
    for plugin in plugins:
        stage = Stage()
        runner = stage.attach(plugin)
        what, seq, setpoint, _ = stage.answer(1)
        assert (what, seq) == ("answer", 1) and isinstance(setpoint, vizflyt.Setpoint)
        stage.rehearsal.stop()
        assert runner.ended() is None
