"""Shared by the tests of the model: float64, one small campaign, and compiled functions that many tests use.

Compile time rules the run time of these tests: whatever needs the whole optical chain goes through the fixture
`evaluate` or through `likelihood.evaluate`, which are compiled once per session for campaigns of any size.
pyproject.toml has every array checked against its annotation (jaxtyping's import hook, at trace time).
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

# Before NumPy is imported: OpenBLAS' waiting threads would take the time of XLA's (see `tvsbayes.cli.main`).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Before JAX is imported: other processes and later runs load what one has compiled. Keys are hashes of the code.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Commands, in this process or in another, use that folder too, not the user's own.
os.environ["TVSBAYES_CACHE"] = os.environ["JAX_COMPILATION_CACHE_DIR"]

from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from xdist.scheduler import LoadFileScheduling

from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.instrument.rig import Rig, read_rig
from tvsbayes.twin.simulated_campaign import SimulatedCampaign, simulate

ROOT = Path(__file__).resolve().parents[1]
pytest_plugins = [
    # The first is imported by others.
    *("support.commands", "support.dozen_spots", "support.reported_twin"),
    *("support.coarse_planning", "support.invented_studies", "support.viewed_twin"),
]
"""Fixtures of one small campaign, of commands, of the report, of planning and of studies, with their helpers."""
COMPILES = "cli"
BESIDE = ("acquisition", "cameras", "single_axis", "statistics")
"""Packages that need little of the model: what the other process is at while one compiles it."""
TOGETHER = {
    **{"estimators": "estimators", "posterior": "posterior", "planning": "planning", "report": "report"},
    **{"assessment": "judgements", "comparison": "judgements", "view": COMPILES},
}
"""Packages whose files share fits and compiled functions: one process takes them all. Roughly the longest first."""


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    """Each second process collects from the end: it finds compiled what the first compiled, and the other way round."""
    report = yield
    if isinstance(collector, pytest.Directory) and int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % 2:
        report.result.reverse()
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the packages for two processes, whichever end each began to collect at.

    One compiles the model for the commands while the other is at what needs little of it, and then reads it from the
    cache; the long packages follow, and then single files, so that neither is left alone with a package at the end.
    """
    turns = [COMPILES, *BESIDE, *dict.fromkeys(TOGETHER.values())]

    def turn(item: pytest.Item) -> int:
        package = item.path.parent.name
        name = TOGETHER.get(package, package)
        return turns.index(name) if name in turns else len(turns)

    items.sort(key=lambda item: (turn(item), item.path))


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadFileScheduling:
    """Files stay whole, as xdist's own `loadfile` has it, and the packages above with theirs."""

    class ByFixtures(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            package = Path(file).parent.name
            return package if package == COMPILES else TOGETHER.get(package, file)

    return ByFixtures(config, log)


@pytest.fixture(scope="session", autouse=True)
def shared_traces():
    """Processes share traced and compiled functions: one waits for a function that the other compiles."""
    from support.compiled_once import sharing

    from tvsbayes.model.compilation_cache import use_compilation_cache

    with sharing(Path(os.environ["JAX_COMPILATION_CACHE_DIR"])):
        use_compilation_cache()
        yield


@pytest.fixture(scope="session", autouse=True)
def shared_lengths():
    """Lengths that many tests share: no campaign here has more spots, and functions of tests look at padding too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tvsbayes.estimators.campaign_arrays.SMALLEST_BUCKET", 512)
        yield


@pytest.fixture(scope="session", autouse=True)
def unflushed():
    """No waiting for the disk: files of tests need not outlive a power cut, and milliseconds a flush add up.

    Tests of durability follow the calls themselves (`acquisition/test_journal.py`); killed processes flush for real.
    """
    with pytest.MonkeyPatch.context() as patch:
        # A descriptor that is none is refused still.
        patch.setattr(os, "fsync", os.fstat)
        yield


@pytest.fixture
def x64():
    """float64 for one test; the library itself never changes a global setting."""
    import jax

    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def mounted_rig() -> Rig:
    """The shipped rig whose extrinsics are known to 0.03 rad and 5 mm."""
    return read_rig(ROOT / "data" / "rigs" / "mounted" / "rig.toml")


@pytest.fixture(scope="session")
def small_rig(mounted_rig: Rig) -> Rig:
    """The same rig with cameras of a quarter of the pixels per side: pictures that cost a sixteenth."""
    scale = np.ones(24)
    scale[[0, 1, 2, 3, 9, 10, 11, 12]] = 0.25
    stereo = mounted_rig.stereo.with_vector(mounted_rig.stereo.vector * scale)
    width, height = mounted_rig.stereo.image_width // 4, mounted_rig.stereo.image_height // 4
    covariance = mounted_rig.stereo.parameter_covariance * np.outer(scale, scale)
    stereo = replace(stereo, image_width=width, image_height=height, parameter_covariance=covariance)
    return replace(mounted_rig, stereo=stereo)


@pytest.fixture
def ctrl_c_works():
    """Background jobs of a shell ignore SIGINT, those of nohup SIGHUP; tests that raise them need the default."""
    wanted = {"SIGINT": signal.default_int_handler, "SIGHUP": signal.SIG_DFL}
    numbers = {getattr(signal, name): handler for name, handler in wanted.items() if hasattr(signal, name)}
    before = {number: signal.signal(number, handler) for number, handler in numbers.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@dataclass(frozen=True)
class Evaluated:
    """Everything between coordinates and log likelihood, as NumPy arrays: see the library's own records.

    `terms` are the residuals (spots, 4), slopes (spots, 4, 2), log scales and predicted looks (spots, 5).
    `log_likelihood` is that of `likelihood.evaluate`, less the prior's part.
    """

    model: Any
    angles: Any
    terms: Any
    log_likelihood: float


@pytest.fixture(scope="session")
def evaluate():
    """(z, space, arrays) -> Evaluated, compiled once."""
    import jax
    import jax.numpy as jnp

    from tvsbayes.estimators import likelihood
    from tvsbayes.model.laser_path import mirror_angles

    # Run a hundred times, compiled once: a third of the time of compilation is optimisation.
    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def compiled(z, space, arrays):
        model = space.model(z)
        angles = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves)
        result = likelihood.look_terms(model, arrays)
        terms = {
            "residual": jnp.stack(result.terms.residual, axis=1),
            "slope": jnp.stack([jnp.stack(result.terms.by_pan, 1), jnp.stack(result.terms.by_tilt, 1)], axis=2),
            "log_scale": result.terms.log_scale,
            "predicted": jnp.stack(result.looks.predicted, axis=1),
        }
        return model, angles, terms

    def run(z, space, arrays) -> Evaluated:
        with jax.enable_x64(True):
            model, angles, terms = jax.tree.map(np.asarray, compiled(jnp.asarray(z), space, arrays))
            log_density = likelihood.evaluate(z[None], likelihood.no_draw(1, arrays), space, arrays).log_density[0]
            return Evaluated(model, angles, SimpleNamespace(**terms), float(log_density + 0.5 * z @ z))

    return run


@pytest.fixture(scope="session")
def bent():
    """A calibration of a bent rig, with draws."""
    from support.bent_rig import calibration

    return calibration()


@pytest.fixture(scope="session")
def wobbling():
    """The same with transmission errors on both axes and aperture readings as azimuths."""
    from support.bent_rig import BENT, PERIODS_DEG, WOBBLE, calibration

    return calibration(BENT | WOBBLE, azimuth=True, period_deg=PERIODS_DEG)


@pytest.fixture(params=["bent", "wobbling"])
def either(request):
    """The bent rig, and the wobbling one."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def paper_fit():
    """The fit of the shipped twin of the paper: equal gears, |N| = 200."""
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.instrument.campaign import read_campaign

    return fit(read_campaign(ROOT / "data" / "twins" / "paper_twin"))


@pytest.fixture(scope="session")
def mixed_run(mounted_rig: Rig) -> SimulatedCampaign:
    """A campaign of two step counts, reversed and cleared starts: the play is seen."""
    return simulate(mounted_rig, four_point_protocol(repeats=4, steps=(100, 200)), seed=3)


@pytest.fixture(scope="session")
def mixed_waits() -> list:
    """What its fit reports."""
    return []


@pytest.fixture(scope="session")
def mixed_fit(mixed_run: SimulatedCampaign, mixed_waits: list):
    """Its fit."""
    from tvsbayes.estimators.joint_fit import fit

    return fit(mixed_run.campaign, progress=mixed_waits.append)
