"""Results show themselves in a few lines, in a notebook as a table, and as pandas tables; never as arrays."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
from dataclasses import dataclass

import numpy as np
import pytest
from msgspec import Struct
from support.axes import drawn
from support.package_imports import MODULES
from support.small_campaign import small_campaign
from support.small_results import small_record, small_summary

from tvsbayes.display import ROWS, Shown, View
from tvsbayes.estimators.four_point import classic
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import read_campaign

CHARACTERS = 6000
"""Of a result in a session, at most: a screen or two; a fit had 2.4 million."""


def test_a_long_table_is_cut_and_says_where_the_rest_is():
    view = View("a title", ("name", "value"), [(f"row {k}", k / 3) for k in range(ROWS + 5)])
    lines = view.text().splitlines()
    assert lines[0] == "a title" and lines[1].split() == ["name", "value"] and len(lines) == ROWS + 3
    assert lines[-1] == "... 5 more rows; to_dataframe() has all"
    assert view.html().count("<tr>") == ROWS + 1 and "5 more rows" in view.html()


def test_text_of_files_reaches_neither_html_nor_terminal_as_code():
    view = View("<b>title</b>", ("<i>",), [("<script>alert(1)</script>",), ("a\x1b[31mb",)])
    assert "<script>" not in view.html() and "<b>" not in view.html() and "<i>" not in view.html()
    assert "\x1b" not in view.text() + view.html()


@dataclass(frozen=True, repr=False)
class Two(Shown):
    def shown(self) -> View:
        return View("two", ("name", "mm"), [("x", 1.25), ("y", None)])


def test_a_table_for_pandas_has_the_numbers_themselves():
    pytest.importorskip("pandas")
    frame = Two().to_dataframe()
    assert list(frame.columns) == ["name", "mm"] and frame["mm"][0] == 1.25 and np.isnan(frame["mm"][1])


def shown_classes() -> list[type]:
    """Every class of the package that shows itself."""
    classes = {}
    for name in MODULES:
        for each in vars(importlib.import_module(f"tvsbayes.{name}")).values():
            if inspect.isclass(each) and issubclass(each, Shown) and each is not Shown:
                classes[each.__qualname__] = each
    return list(classes.values())


def test_every_result_that_the_package_offers_shows_itself():
    """A dataclass without `repr=False` would print every array all the same."""
    classes = shown_classes()
    named = {each.__name__ for each in classes}
    public = {"Campaign", "CampaignResults", "Calibration", "Comparison", "FitRecord", "FitSummary", "JointFit"}
    assert public | {"Locations", "Posterior", "ClassicResult", "AxisFit", "AxisSummary", "PlanResult"} <= named
    for each in classes:
        assert dataclasses.is_dataclass(each) or issubclass(each, Struct), each
        assert each.__repr__ is Shown.__repr__, each
        assert "shown" in vars(each), each


def results() -> list[Shown]:
    twin = read_campaign(shipped_data() / "twins" / "paper_twin")
    return [twin, small_campaign(), classic(twin), small_summary(), small_record(), drawn(7).campaign]


@pytest.mark.parametrize("result", results(), ids=lambda each: type(each).__name__)
def test_results_are_short_and_tables_are_whole(result):
    pytest.importorskip("pandas")
    text, html = repr(result), result._repr_html_()
    assert type(result).__name__ in text.splitlines()[0] and len(text) < CHARACTERS
    assert html.count("<table>") == 1 and len(html) < 3 * CHARACTERS
    assert len(result.to_dataframe()) == len(result.shown().rows)
