"""Public names of `tvsbayes`: loaded on demand, without collisions."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys

import pytest
from support.axes import drawn, runs
from support.commands import PAPER_TWIN

import tvsbayes
from tvsbayes.errors import InputError
from tvsbayes.single_axis.axis_campaign import AxisCampaign, write_axis

FIRST = {"calibration_of", "fit", "load_calibration", "load_posterior", "locate", "read_campaign", "sample"}


def test_every_public_name_is_there_and_shown():
    assert FIRST | {"plots", "calibrate", "FitRecord", "JointFit", "Posterior", "Campaign"} <= set(tvsbayes.__all__)
    assert set(dir(tvsbayes)) == {*tvsbayes.__all__, "__version__"}
    for name in tvsbayes.__all__:
        assert getattr(tvsbayes, name).__doc__, name


def test_a_campaign_of_any_kind_is_read(tmp_path):
    """An axis by its format line; any other folder by the strict reader, which names what is missing."""
    write_axis(drawn(4, runs(2)).campaign, tmp_path / "stage")
    assert isinstance(tvsbayes.read_campaign(tmp_path / "stage"), AxisCampaign)
    assert isinstance(tvsbayes.read_campaign(PAPER_TWIN), tvsbayes.Campaign)
    with pytest.raises(InputError, match=r"campaign\.toml"):
        tvsbayes.read_campaign(tmp_path)
    with pytest.raises(InputError, match="a scanner by fresh looks"):
        tvsbayes.verify(PAPER_TWIN, tmp_path / "stage")


def test_no_public_name_is_that_of_a_package():
    """An attribute that is also a module would depend on the last import."""
    assert not set(tvsbayes.__all__) & {module.name for module in pkgutil.iter_modules(tvsbayes.__path__)}


def test_type_checkers_see_the_names():
    for name, home in tvsbayes._HOME.items():
        assert getattr(importlib.import_module(f"tvsbayes.{home}"), name) is getattr(tvsbayes, name)


def test_importing_loads_nothing_heavy_and_figures_are_there_when_asked_for():
    code = (
        "import sys, tvsbayes; 'read_campaign' in dir(tvsbayes) or sys.exit(1); "
        "print([n for n in ('numpy', 'jax', 'matplotlib') if n in sys.modules], callable(tvsbayes.plots.intervals))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[] True"
