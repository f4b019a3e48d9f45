"""The list of planted faults fits the source: an entry whose text has changed would plant nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from experiments.robustness.faults.listing import FAULTS, stale
from experiments.robustness.faults.trial import FITS, planted, stages

ROOT = Path(__file__).resolve().parents[2]
ONE = next(fault for fault in FAULTS if fault.name == "contrast of the ratios with the wrong sign")


def test_every_fault_still_fits_its_file():
    assert stale(parse=False) == []
    assert len(FAULTS) >= 100


def test_a_fault_is_planted_in_a_copy_and_taken_out_again(tmp_path):
    copy = tmp_path / ONE.path
    copy.parent.mkdir(parents=True)
    whole = (ROOT / ONE.path).read_text(encoding="utf-8")
    copy.write_text(whole, encoding="utf-8")
    with pytest.raises(KeyError), planted(tmp_path, ONE):
        assert copy.read_text(encoding="utf-8") == whole.replace(ONE.old, ONE.new)
        raise KeyError
    assert copy.read_text(encoding="utf-8") == whole
    for text, count in (("no such text", 0), ("def ", whole.count("def "))):
        with pytest.raises(ValueError, match=f"stands {count} times"), planted(tmp_path, replace(ONE, old=text)):
            pass


def test_the_test_that_saw_a_fault_is_found_wherever_it_stands():
    """Then the likely tests, the package's, all: a fault survives none of them for a stale entry."""
    name = "test_the_test_that_saw_a_fault_is_found_wherever_it_stands"
    here = f"tests/promises/{Path(__file__).name}::{name}"
    found = list(stages(ROOT, ONE, f"test_elsewhere.py::{name}[0-1]"))
    assert found == [(here,), ONE.selection, ("tests/model",), ("tests", "--deselect", FITS)]
    assert list(stages(ROOT, ONE, "")) == found[1:]


def test_what_fails_for_every_planted_fault_counts_for_none():
    """That the list fits its files is no sight of a bug."""
    assert FITS == f"tests/promises/{Path(__file__).name}::{test_every_fault_still_fits_its_file.__name__}"
