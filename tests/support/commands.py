"""Commands run in this process, and campaigns, plans and folders for them.

One fit compiles the model (the grids and small campaigns share one bucket), all others reuse it.
"""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tvsbayes.cli.main import run
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import Campaign, write_campaign
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.protocols import grid_protocol
from tvsbayes.twin.simulated_campaign import simulate

DATA = shipped_data()


MOUNTED = DATA / "rigs" / "mounted"


PAPER_TWIN = DATA / "twins" / "paper_twin"


ESTIMATE_KEYS = {"value", "sd", "interval95", "prior_sd", "contraction", "rhat", "ess_bulk", "ess_tail"}


def no_constant(name: str) -> None:
    raise AssertionError(f"{name} is no JSON")


@contextmanager
def caching_in(folder: str | Path, at_once: bool = False) -> Iterator[None]:
    """Commands of this process keep compiled functions in a folder; afterwards JAX and the package are as before.

    Others find none, or `at_once` what lies there.
    """
    import jax
    from jax._src import compilation_cache

    from tvsbayes.model.compiled import Traces

    names = (
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    )
    before = {name: jax.config.values[name] for name in names}
    kept = compilation_cache._cache, compilation_cache._cache_initialized
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TVSBAYES_CACHE", str(folder))
        patch.setattr(Traces, "used", Traces(Path(folder) / "traced") if at_once else None)
        yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    compilation_cache._cache, compilation_cache._cache_initialized = kept


@pytest.fixture(scope="module")
def own_compilation_cache():
    """`fit` and `demo` point JAX at the folder of the tests."""
    with caching_in(os.environ["JAX_COMPILATION_CACHE_DIR"], at_once=True):
        yield


@pytest.fixture(scope="session")
def fits() -> dict[bytes, Any]:
    """Fits by what they were made of."""
    return {}


@pytest.fixture(scope="module")
def each_fitted_once(fits):
    """Commands that fit what another has fitted get that fit: what is looked at is what they make of it."""
    from tvsbayes.estimators import joint_fit

    fit = joint_fit.fit

    def kept(campaign, *, progress=None, **choices):
        key = pickle.dumps((replace(campaign, path=None), sorted(choices.items())))
        if key not in fits:
            fits[key] = fit(campaign, progress=progress, **choices)
        return replace(fits[key], campaign=campaign)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint_fit, "fit", kept)
        yield


@pytest.fixture
def ask(capsys):
    """Run a command with --json: exit code, and the one document on stdout."""

    def run_json(*arguments: object) -> tuple[int, dict[str, Any]]:
        code = run([*map(str, arguments), "--json"])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return code, json.loads(captured.out, parse_constant=no_constant)

    return run_json


@pytest.fixture
def say(capsys):
    """Run a command for people: exit code, stdout, stderr."""

    def run_text(*arguments: object) -> tuple[int, str, str]:
        code = run([*map(str, arguments)])
        return code, *capsys.readouterr()

    return run_text


@pytest.fixture(scope="session")
def grid_campaign(mounted_rig) -> Campaign:
    """24 spots: three by two poses on two sheets, each from either side of both axes."""
    plan = grid_protocol(targets=("d1", "d2"), pan_steps=(0, 100, 200), tilt_steps=(-60, 60))
    return simulate(mounted_rig, plan, seed=3).campaign


@pytest.fixture
def grid_folder(grid_campaign, tmp_path) -> Path:
    """A copy of the small campaign that a test may spoil."""
    write_campaign(grid_campaign, tmp_path / "campaign")
    return tmp_path / "campaign"


def steps(*orders: tuple) -> tuple[PlanStep, ...]:
    """Orders as a plan: ("place", target), ("look",), ("home" or "move", pan, tilt)."""
    return tuple(
        PlanStep(number, action, target=rest[0]) if action == "place" else PlanStep(number, action, *rest)
        for number, (action, *rest) in enumerate(orders)
    )


def two_sheets(*counters: tuple[int, int]) -> tuple[PlanStep, ...]:
    """Each stop looked at twice on both sheets; both axes homed at 0."""
    looks = (("place", "d1"), ("look",), ("look",), ("place", "d2"), ("look",), ("look",))
    return steps(("home", 0, 0), *looks, *(order for pair in counters for order in (("move", *pair), *looks)))


def assert_error(document: dict[str, Any], code: str) -> dict[str, Any]:
    error = document["error"]
    assert {"code", "file", "line", "message", "remedy"} <= set(error)
    assert error["code"] == code
    assert error["message"]
    assert error["remedy"]
    return error


def with_spots(campaign: Campaign, change) -> Campaign:
    """Every spot changed."""
    return replace(campaign, spots=tuple(map(change, campaign.spots)))
