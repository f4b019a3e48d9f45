"""The list of planted faults fits the tree: every entry has its place and test. No fault is planted here."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.robustness.faults import changes
from experiments.robustness.faults.listing import FAULTS, misfits
from experiments.robustness.planted_faults import planted

ROOT = Path(__file__).resolve().parents[2]
MODULE = '''
"""A module."""
LIMIT, OTHER = 1.0, 2.0


def slope(a, b):
    """A function."""
    if b > LIMIT:
        raise ValueError
    half = -a.size
    return minimum(half, b, by=3)


class Gear:
    teeth: int = 20
'''


@pytest.fixture
def sources(tmp_path):
    (tmp_path / "tvsbayes").mkdir()
    (tmp_path / "tvsbayes" / "gears.py").write_text(MODULE)
    (tmp_path / "tvsbayes" / "board.cpp").write_text("void Core::loop(int now) {\n  watch(now);\n  step(now);\n}\n")
    return changes.Sources(tmp_path)


def test_every_fault_finds_its_place_and_its_test():
    assert misfits() == []
    assert len(FAULTS) >= 60


@pytest.mark.parametrize(
    ("place", "change", "before", "after"),
    [
        ("LIMIT", changes.Constant("3 * value"), "OTHER = (1.0, 2.0)", "OTHER = (1.0, 2.0)\nLIMIT = 3 * LIMIT"),
        ("Gear.teeth", changes.Constant("0"), "teeth: int = 20", "teeth: int = 20\n    teeth = 0"),
        ("slope", changes.Argument("b", "-value"), '"""A function."""', '"""A function."""\n    b = -b'),
        ("slope", changes.Local("half", "0.5 * value"), "-a.size", "-a.size\n    half = 0.5 * half"),
        ("slope", changes.Reads("a.size", "1 / value"), "-a.size", "-(1 / a.size)"),
        ("slope", changes.Call("minimum", "function(arg1, arg0)"), "minimum(half, b, by=3)", "minimum(b, half)"),
        ("slope", changes.Keyword("by", "value + 1"), "by=3", "by=3 + 1"),
        ("slope", changes.Never("LIMIT"), "b > LIMIT", "False"),
        ("gears.slope", changes.Returns("(value, a)"), "minimum(half, b, by=3)", "(minimum(half, b, by=3), a)"),
        ("Core::loop", changes.Uncalled("watch"), "  watch(now);\n", ""),
    ],
)
def test_a_change_applies_where_its_names_are(sources, place, change, before, after):
    path, text = change.planted(sources, place)
    whole = changes.ast.unparse(changes.ast.parse(MODULE)) + "\n" if path.suffix == ".py" else path.read_text()
    assert whole.count(before) == 1 and text == whole.replace(before, after)


@pytest.mark.parametrize(
    ("place", "change", "message"),
    [
        ("angle", changes.Returns("0"), "stands for 0 definitions"),
        ("slope", changes.Reads("b.size", "0"), "holds nothing for Reads"),
        ("Core::loop", changes.Uncalled("halt"), "calls halt"),
    ],
)
def test_a_change_without_a_place_is_refused(sources, place, change, message):
    with pytest.raises(changes.NoPlace, match=message):
        change.planted(sources, place)


@pytest.mark.usefixtures("sources")
def test_a_name_of_two_definitions_is_refused(tmp_path):
    (tmp_path / "tvsbayes" / "axis.py").write_text("def slope(a):\n    return a\n")
    with pytest.raises(changes.NoPlace, match=r"slope stands for 2 definitions: .*axis\.slope"):
        changes.Sources(tmp_path).definition("slope")


def test_a_fault_is_planted_in_a_copy_and_taken_out_again(tmp_path):
    """In a package of one module with the place of an entry of the list."""
    fault = next(fault for fault in FAULTS if fault.place == "laser_path.followed")
    (tmp_path / "tvsbayes" / "model").mkdir(parents=True)
    copy = tmp_path / "tvsbayes" / "model" / "laser_path.py"
    whole = (ROOT / copy.relative_to(tmp_path)).read_text(encoding="utf-8")
    copy.write_text(whole, encoding="utf-8")
    _, text = fault.change.planted(changes.Sources(tmp_path), fault.place)
    with pytest.raises(KeyError), planted(tmp_path, fault):
        assert copy.read_text(encoding="utf-8") == text != whole
        raise KeyError
    assert copy.read_text(encoding="utf-8") == whole
