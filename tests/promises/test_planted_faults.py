"""The list of planted faults fits the source: an entry whose text has changed would plant nothing."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def faults():
    """The script as a module; experiments are no package."""
    spec = importlib.util.spec_from_file_location("planted_faults", ROOT / "experiments" / "planted_faults.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_every_fault_still_fits_its_file(faults):
    assert faults.stale(parse=False) == []
    assert len(faults.FAULTS) >= 100


def test_a_fault_is_planted_in_a_copy_and_taken_out_again(faults, tmp_path):
    fault = next(f for f in faults.FAULTS if f.name == "contrast of the ratios with the wrong sign")
    copy = tmp_path / fault.path
    copy.parent.mkdir(parents=True)
    whole = (ROOT / fault.path).read_text(encoding="utf-8")
    copy.write_text(whole, encoding="utf-8")
    with pytest.raises(KeyError), faults.planted(tmp_path, fault):
        assert copy.read_text(encoding="utf-8") == whole.replace("0.5, -0.5", "-0.5, 0.5")
        raise KeyError
    assert copy.read_text(encoding="utf-8") == whole
    for text, count in (("no such text", 0), ("def ", whole.count("def "))):
        with (
            pytest.raises(ValueError, match=f"stands {count} times"),
            faults.planted(tmp_path, replace(fault, old=text)),
        ):
            pass
