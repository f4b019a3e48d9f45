"""Error maps and budgets: against dense least squares, the published equations and the twin's optics."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bent_rig import BENT, NO_NOISE_DEG, NOMINAL, calibration, twin_points, twin_ray
from support.published_equations import published_point
from support.small_campaign import small_campaign

from tvsbayes.assessment.causes import causes_of
from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.coordinates.beam_meeting import INPUT_COLUMNS, meeting
from tvsbayes.coordinates.error_map import SimpleCalibration, error_map, simple_calibration, simple_rays
from tvsbayes.coordinates.location import locate_linear, settings_of
from tvsbayes.errors import InputError
from tvsbayes.estimators.four_point import ClassicResult, DirectionResult
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.linear_spots import StopGroup, StopInformation
from tvsbayes.instrument.parameters import HARMONIC_NAMES, INDEX, NAMES, RIG_NAMES, RIG_PRIORS, Prior
from tvsbayes.metrology.look_budget import APERTURE_HERE, PLAY_HERE, STOP_HERE, budget
from tvsbayes.model.parameter_space import parameter_space
from tvsbayes.twin.physics import aperture_angle_deg

ROUNDING_MM = 1e-9
"""Of a hundred operations on lengths up to 1000 mm, magnified tenfold by a grazing line of sight."""
ALGEBRA = 1e-9
"""Relative, of solving 65 equations whose information spans six decades."""
DIFFERENCES = 1e-6
"""Relative, of central differences with a step of 1e-4 sd."""
ROWS, STATES = 160, 12


def linear_problem(stereo: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian (rows, parameters) in prior sds and load of the stop errors (rows, states) of a small campaign.

    Pixel errors are unit normal; `stereo` scales what one prior sd of the cameras does.
    """
    rng = np.random.default_rng(17)
    jacobian = rng.normal(size=(ROWS, len(NAMES))) * np.exp(rng.normal(size=len(NAMES)))
    # What the cameras do looks like what the rig does: no data tell one from the other.
    mix = rng.normal(size=(len(RIG_NAMES), len(NAMES) - len(RIG_NAMES)))
    jacobian[:, len(RIG_NAMES) :] = 0.02 * stereo * jacobian[:, : len(RIG_NAMES)] @ mix
    # Fixed in the rig, which has no transmission error.
    jacobian[:, [INDEX[name] for name in HARMONIC_NAMES]] = 0.0
    load = np.zeros((ROWS, STATES))
    for state in range(STATES):
        load[13 * state : 13 * state + 20, state] = 2.0 * rng.normal(size=len(load[13 * state : 13 * state + 20]))
    return jacobian, load


def fit_of(jacobian: np.ndarray, load: np.ndarray, rig, readings: bool = False) -> JointFit:
    """A `JointFit` that holds what `causes_of` reads, of a linear campaign in three groups."""
    inverse = np.linalg.inv(np.eye(ROWS) + load @ load.T)
    gain = inverse @ jacobian
    parts = (slice(0, 40), slice(40, 100), slice(100, ROWS))
    groups = tuple(StopGroup(p, np.zeros(p.stop - p.start), gain[p], inverse[p, p]) for p in parts)
    fit = object.__new__(JointFit)
    with jax.enable_x64(True):
        space = jax.tree.map(jnp.asarray, parameter_space(rig.table, rig.stereo))
    seen = np.array([True, True, False])
    # A spot of the padding does not count.
    aperture = np.array([False, readings, True])
    physical = np.full((50, len(NAMES)), 0.5) + 1e-3 * np.random.default_rng(3).normal(size=(50, len(NAMES)))
    values = {
        "information": StopInformation(groups, jacobian.T @ gain),
        "arrays": SimpleNamespace(spots=SimpleNamespace(has_aperture=aperture, valid=seen)),
        "space": space,
        "z": 0.1 * np.random.default_rng(4).normal(size=len(NAMES)),
        "draws": SimpleNamespace(physical=physical),
        "campaign": small_campaign(),
    }
    for name, value in values.items():
        object.__setattr__(fit, name, value)
    return fit


def refitted(jacobian: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How the estimate moves with every datum (parameters, rows) and prior (parameters, parameters), by lstsq."""
    variances, vectors = np.linalg.eigh(np.eye(ROWS) + load @ load.T)
    whitener = vectors @ np.diag(variances**-0.5) @ vectors.T
    system = np.concatenate([whitener @ jacobian, np.eye(len(NAMES))])
    right = np.zeros((len(system), ROWS + len(NAMES)))
    right[:ROWS, :ROWS], right[ROWS:, ROWS:] = whitener, np.eye(len(NAMES))
    moved = np.linalg.lstsq(system, right, rcond=None)[0]
    return moved[:, :ROWS], moved[:, ROWS:]


def slope_of(fit: JointFit) -> np.ndarray:
    """d(inputs)/dz by central differences."""
    columns = INPUT_COLUMNS[: len(INPUT_NAMES)]
    with jax.enable_x64(True):
        physical = jax.jit(lambda z: fit.space.physical(z))
        moved = [
            [np.asarray(physical(jnp.asarray(fit.z + s * 1e-4 * row)))[columns] for s in (1, -1)]
            for row in np.eye(len(NAMES))
        ]
    return np.array([(plus - minus) / 2e-4 for plus, minus in moved]).T


@pytest.mark.parametrize("readings", [False, True])
def test_causes_are_what_refitting_shows(mounted_rig, readings):
    jacobian, load = linear_problem()
    fit = fit_of(jacobian, load, mounted_rig, readings)
    causes = causes_of(fit)
    by_datum, by_prior = refitted(jacobian, load)
    slope = slope_of(fit)
    pixels, stops = slope @ by_datum, slope @ by_datum @ load
    expected = {
        "pixel and aperture noise" if readings else "pixel noise": pixels @ pixels.T,
        "stop errors of the campaign": stops @ stops.T,
    }
    stereo = slope @ by_prior[:, len(RIG_NAMES) :]
    expected["stereo calibration"] = stereo @ stereo.T
    for stem in ("mirror_offset_mm", "laser_tilt_deg", "extrinsics", "focal_scale"):
        columns = [INDEX[name] for name in RIG_NAMES if name.split(".")[0] == stem]
        moved = slope @ by_prior[:, columns]
        expected["focal scale" if stem == "focal_scale" else f"prior of {stem}"] = moved @ moved.T
    for name, part in expected.items():
        found = causes.covariance[causes.names.index(name)]
        scale = np.sqrt(np.outer(np.diag(part), np.diag(part))) + 1e-300
        assert np.abs((found - part) / scale).max() < 10 * DIFFERENCES, name
    assert len(set(causes.names)) == len(causes.names)


def test_causes_add_up_to_the_posterior(mounted_rig):
    jacobian, load = linear_problem()
    fit = fit_of(jacobian, load, mounted_rig)
    causes = causes_of(fit)
    inverse = np.linalg.inv(np.eye(ROWS) + load @ load.T)
    posterior = np.linalg.inv(jacobian.T @ inverse @ jacobian + np.eye(len(NAMES)))
    slope = slope_of(fit)
    total = slope @ posterior @ slope.T
    scale = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    scale[scale == 0] = 1.0
    assert np.abs((causes.covariance.sum(axis=0) - total) / scale).max() < 10 * DIFFERENCES
    for name, part in zip(causes.names, causes.covariance, strict=True):
        unit = part / scale
        assert np.abs(unit - unit.T).max() < ALGEBRA, name
        assert np.linalg.eigvalsh(0.5 * (unit + unit.T)).min() > -ALGEBRA, name
        assert np.any(part != 0)
    # Fixed in the rig: no cause.
    assert not any("harmonic" in name for name in causes.names)


def test_worse_cameras_have_a_larger_share(mounted_rig):
    shares = []
    for stereo in (0.5, 1.0, 2.0):
        causes = causes_of(fit_of(*linear_problem(stereo), mounted_rig))
        ratio = causes.covariance[:, 0, 0]
        shares.append(ratio[causes.names.index("stereo calibration")] / ratio.sum())
    assert shares[0] < shares[1] < shares[2]


def test_calibration_of_a_fit_brings_its_causes(mounted_rig):
    fit = fit_of(*linear_problem(), mounted_rig)
    one = calibration_of(fit)
    causes = causes_of(fit)
    assert (one.estimator, one.causes) == ("laplace", causes.names)
    np.testing.assert_array_equal(one.cause_covariance, causes.covariance)
    np.testing.assert_array_equal(one.inputs, fit.draws.physical[:, INPUT_COLUMNS[: len(INPUT_NAMES)]])


@pytest.fixture(scope="module")
def caused() -> Calibration:
    """Two causes that are not multiples of each other and add up to the covariance."""
    one = calibration()
    weights = np.random.default_rng(2).uniform(0.1, 0.9, len(INPUT_NAMES))
    variances, vectors = np.linalg.eigh(one.covariance)
    root = vectors * np.sqrt(np.clip(variances, 0.0, None))
    parts = np.stack([root * weights @ root.T, root * (1 - weights) @ root.T])
    return replace(one, causes=("pixel noise", "stereo calibration"), cause_covariance=parts)


POINT = (130.0, 90.0, 60.0, ("right", "unknown"))


def test_budget_adds_up_to_the_covariance(caused):
    found = budget(caused, *POINT)
    law = locate_linear(caused, settings_of(*POINT))
    np.testing.assert_allclose(found.covariance_mm2, law.covariance[0], rtol=ALGEBRA)
    np.testing.assert_allclose(found.variance_mm2.sum(axis=0), np.diag(law.covariance[0]), rtol=ALGEBRA)
    assert found.causes == ("pixel noise", "stereo calibration", STOP_HERE, PLAY_HERE, APERTURE_HERE)
    assert found.share.sum() == pytest.approx(1.0, abs=1e-12) and np.all(found.share > 0)
    np.testing.assert_allclose(found.share, found.variance_mm2.sum(axis=1) / np.trace(law.covariance[0]), rtol=ALGEBRA)
    # By parameter: contributions and correlations give the covariance back, GUM eq. 16.
    rebuilt = found.contribution_mm.T @ found.correlation @ found.contribution_mm
    np.testing.assert_allclose(rebuilt, law.covariance[0], rtol=ALGEBRA)
    assert found.parameters[: len(INPUT_NAMES)] == INPUT_NAMES
    assert found.contribution_mm.shape == (len(found.parameters), 3)
    document = found.as_json()
    assert [c["cause"] for c in document["causes"]] == list(found.causes)
    np.testing.assert_allclose([c["u_mm"] for c in document["causes"]], np.sqrt(found.variance_mm2), rtol=1e-12)


def test_each_cause_of_a_budget_is_its_own_propagation(caused):
    """Without the others, through the law: parts of the calibration and of this look."""
    found = budget(caused, *POINT)
    settled = dict.fromkeys(NOISE_NAMES, 1e-9)

    def alone(covariance: np.ndarray, noise_deg: dict[str, float], play: bool = False) -> np.ndarray:
        one = replace(caused, covariance=covariance, noise_variance={name: sd**2 for name, sd in noise_deg.items()})
        if not play:
            # A known side of half the play keeps the beam and loses its variance.
            one = replace(one, mean=np.where(np.array(INPUT_NAMES) == "backlash_deg.tilt", 0.0, one.mean))
        return np.diag(locate_linear(one, settings_of(*POINT)).covariance[0])

    nothing = np.zeros_like(caused.covariance)
    rms = {name: variance**0.5 for name, variance in caused.noise_variance.items()}
    stops = {name: sd for name, sd in rms.items() if name.startswith("stop")}
    np.testing.assert_allclose(found.variance_mm2[2], alone(nothing, settled | stops), rtol=1e-6)
    np.testing.assert_allclose(found.variance_mm2[3], alone(nothing, settled, play=True), rtol=1e-6)
    readings = settled | {"aperture_sd_deg": rms["aperture_sd_deg"]}
    np.testing.assert_allclose(found.variance_mm2[4], alone(nothing, readings), rtol=1e-6)


def test_a_budget_needs_causes_and_a_point(caused):
    with pytest.raises(ValueError, match="causes"):
        budget(calibration(), *POINT)
    with pytest.raises(InputError, match="diverge"):
        budget(caused, 130.0, 90.0, 179.0)
    # Past the cone of all points under this angle: a complex step must not find an imaginary range there.
    for call in (caused.locate, caused.derivatives, lambda *look: budget(caused, *look)):
        with pytest.raises(InputError) as caught:
            call(-500.0, 0.0, 0.1)
        assert caught.value.code == "grazing"


def direction_result(mean: float) -> DirectionResult:
    return DirectionResult(1, mean, None, None, None, None, None, 0.0, None)


def test_simple_calibration_is_nominal_or_classic():
    nominal = simple_calibration()
    assert nominal == SimpleCalibration({"left": 0.06, "right": 0.06, "up": 0.07, "down": 0.07}, 170.0, 70.0, 90.0, 0.0)
    assert simple_calibration(RIG_PRIORS | {"aperture_zero_deg": Prior(5.0, 0.0)}).aperture_zero_deg == 5.0
    results = {"left": direction_result(0.0594), "right": None, "up": direction_result(0.069), "down": None}
    classic = simple_calibration(RIG_PRIORS | {"mirror_offset_mm": Prior(20.0, 1.0)}, ClassicResult(results, (), ()))
    assert classic.deg_per_step == {"left": 0.0594, "right": 0.06, "up": 0.069, "down": 0.07}
    assert (classic.baseline_mm, classic.origin_y_mm) == (180.0, 80.0)


@pytest.mark.parametrize(("pan", "tilt"), [(0, 0), (200, 0), (-150, 120), (100, -200)])
def test_simple_rays_with_readings_are_the_published_equations(pan, tilt):
    """Baseline a - L, middle moved by -L/2; C and beta in the plane of beam and baseline, from the direction."""
    simple = SimpleCalibration({"left": 0.06, "right": 0.05, "up": 0.07, "down": 0.08}, 170.0, 70.0, 88.0, 0.0)
    rays = simple_rays(simple, np.array([[pan, tilt]]))
    azimuth = 88.0 - 90.0 + pan * (0.06 if pan > 0 else 0.05)
    elevation = tilt * (0.07 if tilt > 0 else 0.08)
    ez, az = np.radians([elevation, azimuth])
    d = np.array([np.cos(ez) * np.cos(az), np.cos(ez) * np.sin(az), np.sin(ez)])
    np.testing.assert_allclose(np.asarray(rays.direction)[:, 0], d, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(rays.origin_mm)[:, 0], [0.0, 70.0, 0.0])
    C, beta = np.degrees(np.arccos(-d[1])), np.degrees(np.arctan2(d[2], d[0]))
    for reading in (50.0, 75.0):
        with jax.enable_x64(True):
            # The aperture stays at -a/2 = -100 mm.
            found = meeting(
                jnp.asarray(np.array([[0.0], [70.0], [0.0]])),
                jnp.asarray(d[:, None]),
                jnp.asarray(2 * (simple.baseline_mm - simple.origin_y_mm)),
                jnp.asarray(np.radians([reading])),
                jnp.asarray(False),
            )
        expected = published_point(reading, C, beta, 170.0) - np.array([0.0, 15.0, 0.0])
        assert found.meets[0]
        np.testing.assert_allclose(np.asarray(found.xyz_mm)[:, 0], expected, atol=10 * ROUNDING_MM)


PAN, TILT, RANGE_MM = np.array([-120.0, 90.0]), np.array([-100.0, 0.0, 150.0]), np.array([200.0, 350.0, 500.0, 800.0])


def mapped(one: Calibration, simple: SimpleCalibration, pan=PAN, tilt=TILT, ranges=RANGE_MM, **more):
    """All maps of one shape: compiled once."""
    assert (len(pan), len(tilt), len(ranges)) == (2, 3, 4)
    axes = [np.asarray(axis).tolist() for axis in (pan, tilt, ranges)]
    return error_map(one, *axes, simple={"nominal": simple}, draws=500, **more)


@pytest.mark.parametrize("azimuth", [False, True])
def test_a_perfect_rig_has_no_error_straight_ahead(azimuth):
    """At pan 0 the beam leaves where published equations think it does; turned, it runs L beside the pan axis."""
    one = calibration(NOMINAL, {}, NO_NOISE_DEG, azimuth=azimuth)
    found = mapped(one, simple_calibration(), pan=np.array([0.0, 100.0]))
    assert found.valid.all()
    assert found.rms_mm["joint"].max() < ROUNDING_MM * 10
    assert found.rms_mm["nominal"][0].max() < ROUNDING_MM * 10
    assert found.rms_mm["nominal"][1].min() > 0.1


@pytest.mark.parametrize("azimuth", [False, True])
@pytest.mark.parametrize("approach", [(1.0, 1.0), (-1.0, 1.0)])
def test_bias_of_the_nominal_estimator_is_the_twins(azimuth, approach):
    """A rig without scatter: the whole chain in NumPy, at every pose and range, in the order of the axes."""
    one = calibration(BENT, {}, NO_NOISE_DEG, azimuth=azimuth)
    found = mapped(one, simple_calibration(), approach=approach)
    convention = "azimuth" if azimuth else "in-plane"
    side = ("left" if approach[0] > 0 else "right", "up")
    for i, j, k in np.ndindex(2, 3, 4):
        origin, direction = twin_ray(BENT, (PAN[i], TILT[j]), side)
        point = origin + RANGE_MM[k] * direction
        reading = aperture_angle_deg(point, BENT["baseline_mm"], convention) + BENT["aperture_zero_deg"]
        az, el = np.radians([0.06 * PAN[i], 0.07 * TILT[j]])
        d = np.array([[np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)]])
        if not found.valid[i, j, k]:
            angle = aperture_angle_deg(1e7 * d[0], 200.0, convention)
            assert angle < reading + 1e-3, "lines of sight and nominal beam diverge"
            continue
        thought = twin_points(np.array([[0.0, 70.0, 0.0]]), d, 200.0, float(reading), azimuth)[0]
        # The nominal point may be 10 m away: bisection's 1e-13 deg times r^2 / a.
        bound = 10 * ROUNDING_MM * (1 + (np.linalg.norm(thought) / 1000.0) ** 2)
        np.testing.assert_allclose(found.bias_mm["nominal"][i, j, k], thought - point, atol=bound)
        assert found.rms_mm["nominal"][i, j, k] == pytest.approx(np.linalg.norm(thought - point), abs=bound)
        # Every draw is the same rig.
        np.testing.assert_allclose(
            found.distance_mm["nominal"][:, i, j, k], np.linalg.norm(thought - point), atol=bound
        )
        assert found.rms_mm["joint"][i, j, k] < 10 * ROUNDING_MM
    assert found.valid.sum() >= 18
    np.testing.assert_array_equal(found.pan_steps, PAN)
    np.testing.assert_array_equal(found.tilt_steps, TILT)
    np.testing.assert_array_equal(found.range_mm, RANGE_MM)


def test_joint_beats_nominal_on_a_biased_rig():
    one = replace(calibration(), range_steps=np.array([[-400.0, 80.0], [-100.0, 149.0]]))
    found = mapped(one, simple_calibration(), ranges=np.array([150.0, 200.0, 300.0, 400.0]))
    assert found.valid.all()
    assert np.all(found.rms_mm["joint"] < found.rms_mm["nominal"])
    np.testing.assert_array_equal(found.inside[..., 0], [[True, True, False], [False, False, False]])
    np.testing.assert_array_equal(found.inside, np.repeat(found.inside[..., :1], 4, axis=2))
    for name in ("joint", "nominal"):
        assert np.all(np.linalg.norm(found.bias_mm[name], axis=-1) <= found.rms_mm[name] * (1 + 1e-9))
    # The joint error is what `locate` says of a look: the trace of its covariance.
    ray = one.ray(PAN[0], TILT[1])
    point = ray.origin_mm + 300.0 * ray.direction
    reading = aperture_angle_deg(point, one.estimates["baseline_mm"], "in-plane")
    law = one.locate(PAN[0], TILT[1], float(reading) + one.estimates["aperture_zero_deg"])
    # The errors' second moment from 500 draws, five standard errors of one dominating direction, 5 % of curvature.
    ratio = found.rms_mm["joint"][0, 1, 2] / np.sqrt(np.trace(law.covariance_mm2))
    assert abs(ratio - 1) < 5 * np.sqrt(0.5 / 500) + 0.05


def test_where_nothing_can_be_located_the_map_is_empty():
    """At 100 m a thousandth of a degree decides whether beam and sight meet; stops scatter by 0.05 deg."""
    found = mapped(calibration(), simple_calibration(), ranges=np.array([200.0, 300.0, 400.0, 1e5]))
    assert not found.valid[..., 3].any() and found.valid[..., :3].all()
    assert np.isnan(found.rms_mm["joint"][..., 3]).all()
    assert np.isnan(found.bias_mm["joint"][..., 3, :]).all()
    assert np.isfinite(found.rms_mm["nominal"][..., :3]).all()
