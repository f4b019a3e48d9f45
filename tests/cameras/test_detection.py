"""Spots of a campaign: true centres within stated uncertainties, files in place, hostile frames."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.drawn_spots import HEIGHT, WIDTH, oval, picture, small_pair
from support.waits import check_forward, doings
from support.written_rows import move_row, spot_row

from tvsbayes.cameras.contour import epipolar_refused
from tvsbayes.cameras.detection import DETECTING, LEARNING, LEVELLING, detect
from tvsbayes.cli.main import run
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import Campaign, read_campaign, spots_bytes, write_campaign
from tvsbayes.instrument.stereo_pair import scaled_px, write_stereo
from tvsbayes.twin.physics import cameras_of
from tvsbayes.twin.spot_pictures import Footprint, Scene, Sensor, render_spot

LOOKS = 40


class Folder:
    """A campaign folder with rendered frames and its true centres (n, 4)."""

    def __init__(self, path, looks=LOOKS, sd=2.5, peak_dn=180.0, contrast=0.0, seed=1):
        self.path, rng = path, np.random.default_rng(seed)
        self.stereo = small_pair()
        cameras = cameras_of(self.stereo)
        points = np.column_stack(
            (rng.uniform(-20, 90, looks), rng.uniform(-60, 60, looks), rng.uniform(200, 275, looks))
        )
        self.true_px = np.hstack([camera.project(points) for camera in (cameras.left, cameras.right)])
        cells = [(10 * k, 0, "d1", k // 4, k % 4 + 1, *[None] * 8, 50.0 + k, "undetected") for k in range(looks)]
        spots = [spot_row(*row) for row in cells]
        moves = (move_row(0, 0, 0.0, 0, 0, "left", "up"),)
        write_campaign(Campaign(moves, tuple(spots[::-1]), self.stereo, header={"name": "rendered"}), path)
        (path / "frames").mkdir()
        scene = Scene(speckle_contrast=contrast)
        for look in range(looks):
            for camera, side in enumerate(("left", "right")):
                mark = Footprint(self.true_px[look, 2 * camera : 2 * camera + 2], oval(rng, sd), peak_dn)
                self.put(look, side, render_spot(mark, WIDTH, HEIGHT, scene, Sensor(), (seed, look, camera)))

    def put(self, look: int, side: str, picture: np.ndarray) -> None:
        (self.path / "frames" / f"{10 * look:06d}_{side}.png").write_bytes(png_bytes(picture))

    def errors(self, detection) -> tuple[np.ndarray, np.ndarray]:
        """Errors and stated sds (n, 4) of the ok spots."""
        ok = [s for s in detection.campaign.spots if s.status == "ok"]
        pixels = np.array([[s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px] for s in ok])
        stated = np.array([[s.su_left_px, s.sv_left_px, s.su_right_px, s.sv_right_px] for s in ok])
        return pixels - self.true_px[[s.spot // 10 for s in ok]], stated


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Folder:
    return Folder(tmp_path_factory.mktemp("plain") / "c")


@pytest.fixture(scope="module")
def speckled(tmp_path_factory) -> Folder:
    return Folder(tmp_path_factory.mktemp("speckled") / "c", contrast=0.4, peak_dn=330.0, seed=2)


@pytest.fixture(scope="module")
def plain_detection(plain):
    states = []
    detection = detect(read_campaign(plain.path), progress=states.append)
    check_forward(states)
    assert doings(states) == [LEARNING, DETECTING]
    assert states[-2].doing == f"{DETECTING}: {detection.processed} of {detection.processed} looks"
    return detection


@pytest.fixture(scope="module")
def found_speckled(speckled):
    return detect(read_campaign(speckled.path))


def check_sds(folder: Folder, detection, tolerance: float) -> None:
    """The root mean square of error over stated sd is 1 within the tolerance and its sampling error."""
    errors, stated = folder.errors(detection)
    assert len(errors) >= LOOKS - 2
    ratio = np.sqrt(np.mean((errors / stated) ** 2))
    # Relative sd of a root mean square of n normal values is 1 / sqrt(2 n); four of them.
    open_by_chance = 4 / np.sqrt(2 * errors.size)
    assert (1 - tolerance) * (1 - open_by_chance) < ratio < (1 + tolerance) * (1 + open_by_chance)


def test_stated_sd_is_the_actual_error_without_speckle(plain, plain_detection):
    check_sds(plain, plain_detection, 0.10)
    assert np.sqrt(np.mean(plain.errors(plain_detection)[0] ** 2)) < 0.02


def test_spots_of_a_camera_with_larger_pictures_are_scaled(tmp_path):
    """Right pictures of twice the size: centres and their sds are those of the left one's size."""
    folder = Folder(tmp_path / "c", looks=6)
    size, double = (WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT)
    for look in range(6):
        centre = scaled_px(folder.true_px[look, 2:], size, double)
        mark = Footprint(centre, 4 * oval(np.random.default_rng(look), 2.5), 180.0)
        folder.put(look, "right", render_spot(mark, *double, Scene(), Sensor(), (1, look, 9)))
    with pytest.raises(InputError, match=f"{double[0]} x {double[1]} pixels"):
        detect(read_campaign(folder.path))
    write_stereo(replace(folder.stereo, right_image_size=double), folder.path / "stereo.json")
    campaign = read_campaign(folder.path)
    assert campaign.stereo.right_image_size == double
    errors, stated = folder.errors(detect(campaign))
    # Five sds of 24 coordinates.
    assert errors.shape == (6, 4) and (np.abs(errors) < 5 * stated).all()
    with pytest.raises(InputError, match="one picture size for contour"):
        detect(campaign, "contour")


def test_stated_sd_is_the_actual_error_with_speckle_and_clipped_cores(speckled, found_speckled):
    check_sds(speckled, found_speckled, 0.25)
    errors, stated = speckled.errors(found_speckled)
    mean = errors.mean(axis=0)
    assert (np.abs(mean) < 4 * stated.mean(axis=0) / np.sqrt(len(errors))).all()
    # The grey centroid would scatter by contrast / sqrt(8 pi) = 0.08 px; a weighted fit does better.
    assert np.sqrt(np.mean(errors**2)) < 0.08


def test_the_median_is_of_all_four_coordinates(plain, plain_detection):
    assert plain_detection.median_sd_px == np.median(plain.errors(plain_detection)[1])


def test_noise_is_estimated_from_the_spots(plain_detection, found_speckled):
    for side in ("left", "right"):
        assert plain_detection.noise[side].speckle_contrast < 0.08
        assert found_speckled.noise[side].speckle_contrast == pytest.approx(0.4, rel=0.25)


@pytest.mark.parametrize("each", (True, False))
def test_dark_pictures_are_subtracted(tmp_path, each):
    """Bright objects in the middle of both pictures that resemble spots; one dark picture, or one a look."""
    folder, rng = Folder(tmp_path / "c", looks=6, peak_dn=150.0, seed=4), np.random.default_rng(4)
    (folder.path / "dark").mkdir()
    things = np.zeros((HEIGHT, WIDTH, 3))
    for row, column in ((60, 90), (200, 300), (HEIGHT - 60, WIDTH - 90)):
        things[row : row + 9, column : column + 9] = 90.0

    def put(name: str, lit: np.ndarray) -> None:
        noisy = np.clip(np.rint(lit + things + rng.normal(3, 1, lit.shape)), 0, 255)
        (folder.path / name).write_bytes(png_bytes(noisy.astype(np.uint8)))

    for look in range(6):
        for side in ("left", "right"):
            name = f"{10 * look:06d}_{side}.png"
            frame = cv2.imread(str(folder.path / "frames" / name)).astype(float)
            put(f"frames/{name}", frame)
            if each or look == 0:
                put(f"dark/{name if each else side + '.png'}", np.zeros_like(frame))
    campaign = read_campaign(folder.path)
    assert detect(campaign).statuses.get("ok", 0) < 6
    detection = detect(campaign, dark=folder.path / "dark")
    assert detection.statuses == {"ok": 6}
    errors, stated = folder.errors(detection)
    # Noise of two pictures; 24 coordinates beyond four of their sds by chance: 1 in 600.
    assert np.abs(errors / stated).max() < 4 and np.abs(errors).max() < 0.2
    (folder.path / "dark" / ("000000_left.png" if each else "left.png")).unlink()
    with pytest.raises(InputError, match="no dark picture of the left camera") as caught:
        detect(campaign, dark=folder.path / "dark")
    assert "laser off" in caught.value.remedy


def test_deep_frames_are_detected_with_all_their_bits(tmp_path, monkeypatch):
    """The same light in 12 bits of 16, finer than 8 bits; most looks are so dim that they would fit 10 bits."""
    folder = Folder(tmp_path / "c", looks=6)
    for name in sorted((folder.path / "frames").iterdir()):
        deep = cv2.imread(str(name)).astype(np.uint16) * 16 + 7
        name.write_bytes(png_bytes(np.minimum(deep, 4095)))
    monkeypatch.setattr("tvsbayes.cameras.detection.PILOT_LOOKS_MAX", 2)
    for name in sorted((folder.path / "frames").glob("0000[05]0_*")):
        name.write_bytes(png_bytes(cv2.imread(str(name), cv2.IMREAD_UNCHANGED) // 5))
    states = []
    looks = detect(read_campaign(folder.path), progress=states.append)
    check_forward(states)
    assert doings(states) == [LEVELLING, LEARNING, DETECTING]
    # A fifth of the light, not scaled up by its own peak: its centre is less certain.
    assert looks.statuses == {"ok": 6} and looks.campaign.spots[0].su_left_px > 1.3 * looks.campaign.spots[1].su_left_px
    shallow = detect(read_campaign(Folder(tmp_path / "shallow", looks=6).path))
    for deep, eight in zip(looks.campaign.spots[1:-1], shallow.campaign.spots[1:-1], strict=True):
        assert abs(deep.u_left_px - eight.u_left_px) < 0.1 * eight.su_left_px
        # 8 bits have 255 levels and these 4095 / 16: the noise is unchanged.
        assert deep.su_left_px == pytest.approx(eight.su_left_px, rel=0.1)


def test_the_paper_s_contour_has_larger_errors_and_sds(speckled, found_speckled):
    contour = detect(read_campaign(speckled.path), "contour")
    errors, stated = speckled.errors(contour)
    assert len(errors) > LOOKS / 2
    rms = np.sqrt(np.mean(errors**2))
    assert rms > 2 * np.sqrt(np.mean(speckled.errors(found_speckled)[0] ** 2))
    assert 0.6 < rms / np.sqrt(np.mean(stated**2)) < 1.6


def test_a_pair_off_its_epipolar_lines_is_refused(plain, tmp_path):
    covariances = np.broadcast_to(np.diag(np.full(4, 0.05**2)), (LOOKS, 4, 4))
    assert not epipolar_refused(plain.true_px, covariances, plain.stereo).any()
    for shift, refused in ((0.3, False), (3.0, True)):
        moved = plain.true_px + np.array([0, shift, 0, 0])
        assert (epipolar_refused(moved, covariances, plain.stereo) == refused).all()
    folder = Folder(tmp_path / "c", looks=3)
    swapped = cv2.imread(str(folder.path / "frames" / "000010_right.png"))
    folder.put(1, "right", np.roll(swapped, 12, axis=0))
    found = detect(read_campaign(folder.path))
    after = {spot.spot: spot.status for spot in found.campaign.spots}
    assert after == {0: "ok", 10: "epipolar", 20: "ok"} and found.warnings == []


def test_pictures_that_are_mixed_up_are_said(tmp_path):
    """The right pictures of all looks but one are another look's."""
    folder = Folder(tmp_path / "c", looks=6)
    frames = folder.path / "frames"
    right = sorted(frames.glob("*_right.png"))
    pictures = [path.read_bytes() for path in right]
    for path, other in zip(right[:-1], [*pictures[1:-1], pictures[0]], strict=True):
        path.write_bytes(other)
    found = detect(read_campaign(folder.path))
    assert found.statuses["epipolar"] > found.statuses["ok"]
    (warning,) = found.warnings
    first = next(spot.spot for spot in found.campaign.spots if spot.status == "epipolar")
    assert (
        f"Compare frames/{first:06d}_left.png with" in warning
        and f"detect {folder.path} --overlay" in warning
        and "mixed up" in warning
        and "--overlay" in warning
    )
    assert found.as_json()["warnings"] == [warning]


def test_detection_in_place_keeps_rows_and_other_columns(tmp_path, capsys):
    folder = Folder(tmp_path / "c", looks=5, contrast=0.4)
    before = read_campaign(folder.path)
    by_hand = replace(before.spots[0], status="sheet moved")
    (folder.path / "spots.csv").write_bytes(spots_bytes((by_hand, *before.spots[1:])))
    (folder.path / "frames" / "000010_left.png").unlink()
    folder.put(2, "right", picture(None))
    (folder.path / "truth.json").write_text("not read")
    assert run(["detect", str(folder.path), "--json", "--overlay"]) == 0
    document = json.loads(capsys.readouterr().out)
    after = read_campaign(folder.path)
    statuses = {spot.spot: spot.status for spot in after.spots}
    assert statuses == {40: "sheet moved", 30: "ok", 20: "no-spot right", 10: "undetected", 0: "ok"}
    assert [spot.spot for spot in after.spots] == [spot.spot for spot in before.spots]
    for one, other in zip(before.spots, after.spots, strict=True):
        for column in ("spot", "move", "target", "experiment", "point", "aperture_deg"):
            assert getattr(one, column) == getattr(other, column)
    assert document["ok"] == 2
    assert document["refused"] == {"no-spot right": 1}
    assert (document["missing"], document["kept"], document["spots"]) == (1, 1, 5)
    assert sorted(path.name for path in (folder.path / "results" / "overlay").iterdir()) == [
        f"0000{n}0.png" for n in (0, 2, 3)
    ]
    drawn = cv2.imread(str(folder.path / "results" / "overlay" / "000030.png")).astype(int)
    assert ((drawn[..., 1] > 200) & (drawn[..., 0] < 80) & (drawn[..., 2] < 80)).sum() > 50, "green outline"
    assert ((drawn[..., 2] > 200) & (drawn[..., 0] < 80) & (drawn[..., 1] < 80)).sum() > 20, "red centre"
    # A second detection gives the same file, and a repaired frame its spot.
    once = (folder.path / "spots.csv").read_bytes()
    assert run(["detect", str(folder.path)]) == 0
    assert (folder.path / "spots.csv").read_bytes() == once
    assert "no-spot right" in capsys.readouterr().out


HOSTILE = {
    "link": lambda frame: frame.symlink_to(frame.rename(frame.parents[2] / "outside.png")),
    "damaged": lambda frame: frame.write_bytes(frame.read_bytes()[:-20] + bytes(20)),
    "size": lambda frame: frame.write_bytes(png_bytes(np.zeros((100, 100, 3), np.uint8))),
    "folder": lambda frame: (frame.unlink(), frame.mkdir()),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_frames_are_refused_and_nothing_is_written(kind, tmp_path):
    folder = Folder(tmp_path / "c", looks=2)
    before = (folder.path / "spots.csv").read_bytes()
    HOSTILE[kind](folder.path / "frames" / "000010_right.png")
    for method in ("fit", "contour"):
        with pytest.raises(InputError) as caught:
            detect(read_campaign(folder.path), method)
        assert caught.value.file == "000010_right.png"
    assert run(["detect", str(folder.path)]) == 2
    assert (folder.path / "spots.csv").read_bytes() == before


def test_a_refusal_of_another_path_is_passed_on(tmp_path):
    folder = Folder(tmp_path / "c", looks=2)
    (tmp_path / "taken").write_bytes(b"")
    with pytest.raises(InputError, match="taken"):
        detect(read_campaign(folder.path), overlay=tmp_path / "taken")


def test_no_frames_and_wrong_methods_are_named(tmp_path):
    folder = Folder(tmp_path / "c", looks=1)
    with pytest.raises(InputError, match="no method 'blob'"):
        detect(read_campaign(folder.path), "blob")
    (folder.path / "frames" / "000000_left.png").unlink()
    with pytest.raises(NothingToEstimate, match="frames/ holds pictures of none of the 1 rows"):
        detect(read_campaign(folder.path))
    assert run(["detect", str(folder.path)]) == 3
