"""The bench from end to end: the twin and its pictures, hardware from the rig file to the campaign."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.bench_runs import events, small_plan
from support.pseudo_terminal import needs_pseudo_terminals, served
from support.streamed_camera import streamed
from support.varying_gears import perfect_rig

from tvsbayes.acquisition.journal_check import verify
from tvsbayes.acquisition.observation import DetectedSpot, live_detector
from tvsbayes.acquisition.operator import Terminal
from tvsbayes.acquisition.session import acquire
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.cameras.capture import StereoImage
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.twin.true_rig import read_truth


def blob(shape, u, v, peak):
    """A plain Gaussian spot of 2 px: enough for the camera path, whose pictures are tested elsewhere."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    spot = peak * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 2.0**2)) if np.isfinite(u) else np.zeros(shape)
    return np.repeat(np.clip(20 + spot, 0, 255)[..., None], 3, axis=2)


def centroids(lit: StereoImage, dark: StereoImage) -> DetectedSpot:
    pixels = []
    for side in ("left", "right"):
        light = np.clip(getattr(lit, side).astype(float) - getattr(dark, side), 12, None).mean(axis=2) - 12
        if light.max() < 50:
            return DetectedSpot("no-spot")
        y, x = np.mgrid[: light.shape[0], : light.shape[1]]
        pixels += [float((light * x).sum() / light.sum()), float((light * y).sum() / light.sum())]
    return DetectedSpot("ok", tuple(pixels), (0.1,) * 4)


def centroids_of_the_twin(mounted_rig, truth: dict, move: int) -> np.ndarray:
    """Where the true cameras see the spot of sheet d1 after a move, without noise: (4,) px."""
    k, p = np.radians(truth["mirror_angles_deg"][move]), truth["parameters"]
    still = Instrument(mounted_rig, 7)
    for gear, angle_deg in zip(still._gears, np.degrees(k) - [0.0, p["tilt_zero_deg"]], strict=True):
        gear._output_deg = angle_deg
    still.place("d1", 0)
    still.mechanics.laser_on = True
    return still.centroid_px()


TWO_LOOKS = (
    *(PlanStep(0, "home", 0, 0), PlanStep(1, "place", target="d1"), PlanStep(2, "look")),
    *(PlanStep(3, "move", 60, 10), PlanStep(4, "look")),
)


def test_truth_file_is_that_of_the_run(mounted_rig, tmp_path):
    mounted_rig = perfect_rig(mounted_rig)
    acquire(mounted_rig, small_plan(2), tmp_path / "c", simulate=True, seed=4)
    campaign = read_campaign(tmp_path / "c")
    truth = read_truth(tmp_path / "c" / "truth.json", campaign.stereo)
    assert len(truth.mirror_angles_deg) == len(campaign.moves) and truth.reference_pose_deg is not None
    assert truth.parameters == Instrument(mounted_rig, 4).truth.parameters
    k = truth.parameters["degrees_per_step.left"]
    turned = np.subtract(truth.mirror_angles_deg, truth.stop_errors_deg)
    assert turned[3][0] - turned[2][0] == pytest.approx(100 * k - truth.parameters["backlash_deg.pan"], abs=1e-9)


def test_pictures_of_the_twin(small_rig, tmp_path):
    """What `acquire --simulate` does: pictures rendered, spots fitted with their sds where the twin has them."""
    # Errors that gears repeat would stand in the truth's angles and be added by `still` once more.
    small_rig, folder = perfect_rig(small_rig), tmp_path / "c"
    detector = live_detector(small_rig.stereo)
    outcome = acquire(small_rig, TWO_LOOKS, folder, simulate=True, seed=7, detector=detector)
    assert (outcome.ok, outcome.refused) == (2, 0) and verify(folder).frames == 8
    truth = json.loads((folder / "truth.json").read_text())
    for spot in read_campaign(folder).spots:
        pixels = np.array([spot.u_left_px, spot.v_left_px, spot.u_right_px, spot.v_right_px])
        sds = np.array([spot.su_left_px, spot.sv_left_px, spot.su_right_px, spot.sv_right_px])
        assert 0.01 < sds.min() and sds.max() < 0.2
        # Eight coordinates in all, five sds each.
        assert np.all(np.abs(centroids_of_the_twin(small_rig, truth, spot.move) - pixels) < 5 * sds)
    acquire(small_rig, TWO_LOOKS, tmp_path / "d", simulate=True, seed=7, detector=detector)
    names = [f"{number:06d}_{side}.png" for number in (0, 1) for side in ("left", "right")]
    pictures = [f"{part}/{name}" for part in ("dark", "frames") for name in names]
    assert sorted(path.relative_to(folder).as_posix() for path in folder.glob("*/*.png")) == pictures
    for name in ("spots.csv", *pictures):
        assert (folder / name).read_bytes() == (tmp_path / "d" / name).read_bytes(), "same seed, same bytes"


def cameras_before(instrument: Instrument):
    """What renders noise, and a spot where the twin's laser shines."""
    size = (instrument.rig.stereo.image_height, instrument.rig.stereo.image_width)
    noise = np.random.default_rng(0).integers(0, 9, (*size, 3)).astype(np.uint8)
    frame = [0]

    def render() -> StereoImage:
        frame[0] += 1
        pixels, pair = instrument.centroid_px(), []
        for k in (0, 2):
            # Never the same picture twice in a look, however many frames a busy computer needs: that would be a fault.
            picture = 20 + np.roll(noise, frame[0] + 1000 * k)
            if np.isfinite(pixels[k]):
                u, v = map(round, pixels[k : k + 2])
                picture[v - 5 : v + 6, u - 5 : u + 6] += blob((11, 11), 5, 5, 180).astype(np.uint8)
            pair.append(picture)
        return StereoImage(*pair)

    return render


@needs_pseudo_terminals
def test_hardware_path_from_rig_file_to_campaign(small_rig, tmp_path):
    """Pyserial on a pseudo-terminal, OpenCV on a stream, questions on a terminal: all as on the bench."""
    instrument = Instrument(small_rig, 7)
    lit_in_motion = []
    moved = instrument.mechanics.moved
    instrument.mechanics.moved = lambda *a: (lit_in_motion.append(instrument.mechanics.laser_on), moved(*a))
    questions = []

    def ask(question):
        questions.append(question)
        instrument.place("d1" if "d1" in question else "d2", len(questions))
        return ""

    plan = [*TWO_LOOKS, PlanStep(5, "place", target="d2"), PlanStep(6, "look")]
    with (
        streamed(cameras_before(instrument)) as address,
        served(instrument.device, 1_000_000) as port,
    ):
        table = {"driver": "serial", "port": port, "settle_s": 0.0}
        real = replace(small_rig, positioner=table, cameras={"source": address, "spot_sd_px": 0.08})
        lines = []
        outcome = acquire(
            real,
            plan,
            tmp_path / "c",
            laser_class="3B",
            detector=centroids,
            terminal=Terminal(lines.append, ask=ask),
        )
    assert (outcome.reason, outcome.ok, len(questions)) == ("done", 3, 2), lines
    assert any("808 nm is invisible" in line for line in lines)
    assert not instrument.mechanics.laser_on and lit_in_motion and not any(lit_in_motion)
    assert verify(tmp_path / "c").frames == 12 and len(read_campaign(tmp_path / "c").spots) == 3
    assert "synthetic" not in read_campaign(tmp_path / "c").header
    (start,) = events(tmp_path / "c", "start")
    assert start["device"]["fw"] == "1.1.0" and "cameras" in start
