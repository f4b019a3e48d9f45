"""What a run publishes: the latest wins, bounded, read or not; and how an estimate that moves is judged."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.bench_runs import Run, raise_error

from tvsbayes.acquisition.live_run import LiveRun, SeenLook, temperature
from tvsbayes.acquisition.observation import DetectedSpot, Observation
from tvsbayes.acquisition.running_estimate import Estimate
from tvsbayes.acquisition.simulated_bench import TwinObserver
from tvsbayes.errors import DeviceFault
from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import frame_name

PIXELS = (600.0, 300.25, 500.5, 310.0)


def looked(spot: int, side: int = 64) -> SeenLook:
    png = png_bytes(np.full((side, side), 90, np.uint8))
    pictures = {frame_name(spot, camera): png for camera in ("left", "right")}
    return SeenLook(spot, "ok", "d1", PIXELS, (0.1,) * 4, pictures)


def test_a_run_tells_where_it_stands(mounted_rig, tmp_path):
    live = LiveRun()
    documents = []

    class Told(TwinObserver):
        def observe(self, positioner, spot):
            documents.append(live.document())
            return super().observe(positioner, spot)

    Run(mounted_rig, tmp_path / "c", observer=lambda i: Told(i, 0.08), live=live).engine.run()
    assert [one["progress"]["looks"] for one in documents] == list(range(8))
    assert all(one["state"] == "running" and one["simulated"] and one["name"] == "test" for one in documents)
    third, last = documents[2], live.document()
    assert third["progress"]["doing"] == "looking" and third["coming"][0] == "placing d1"
    assert third["progress"]["seconds_left"] > documents[3]["progress"]["seconds_left"] > 0
    assert third["look"]["spot"] == 1 and third["look"]["pictured"] == [] and len(third["trail"]) == 2
    assert third["device"]["pan_steps"] == 100
    assert (last["state"], last["reason"], last["fault"]) == ("ended", "done", None)
    assert [one["number"] for one in documents] == sorted({one["number"] for one in documents})
    assert json.loads(json.dumps(last, allow_nan=False)) == json.loads(json.dumps(last))


def test_faults_and_repeated_looks_are_reported_in_words(mounted_rig, tmp_path):
    live = LiveRun()

    class Blind(TwinObserver):
        def observe(self, positioner, spot):
            return Observation(DetectedSpot("no-spot"))

    gone = DeviceFault("no-frame", "the left camera delivers nothing", remedy="plug it in")

    class Dies(Blind):
        def observe(self, positioner, spot):
            return super().observe(positioner, spot) if spot < 2 else raise_error(gone)

    with pytest.raises(DeviceFault):
        Run(mounted_rig, tmp_path / "c", observer=lambda i: Dies(i, 0.08), live=live).engine.run()
    doc = live.document()
    assert doc["fault"] == {"code": "no-frame", "message": "the left camera delivers nothing", "remedy": "plug it in"}
    assert doc["remarks"] == tuple(f"look {spot}: no-spot; taken again" for spot in (0, 0, 1, 1))
    assert doc["look"]["status"] == "no-spot" and doc["trail"] == []


def test_only_the_last_look_has_pictures():
    live = LiveRun()
    assert live.picture(1, "left", "whole") is None
    live.looked(looked(1))
    assert live.picture(1, "left", "whole").startswith(b"\xff\xd8")
    for wrong in ((2, "left", "whole"), (1, "middle", "whole"), (1, "left", "raw")):
        assert live.picture(*wrong) is None
    live.looked(SeenLook(2, "no-spot", "d1", None, None, looked(2).pictures))
    assert live.picture(2, "right", "spot") is None and live.picture(2, "right", "whole")


def test_temperature_of_looks_that_agree_and_of_some_that_do_not():
    """Means of nested samples: their difference has the variance that was taken away."""
    generator = np.random.default_rng(4)
    first, more, sd, n = 20, 30, 2e-4, 4000
    draws = 0.06 + sd * generator.standard_normal((n, more))
    heats = []
    for row in draws:
        before = Estimate(first, {"left": row[:first].mean()}, {"left": sd / first**0.5})
        after = Estimate(more, {"left": row.mean()}, {"left": sd / more**0.5})
        heats.append(temperature([before, after]).moved["left"])
    # A standard normal: mean and variance of 4000 within four of their standard errors.
    assert abs(np.mean(heats)) < 4 / n**0.5 and abs(np.var(heats) - 1) < 4 * (2 / n) ** 0.5
    before = Estimate(20, {"left": 0.06, "up": 0.06}, {"left": 1e-4, "up": 1e-4})
    after = Estimate(30, {"left": 0.061, "up": 0.06}, {"left": 8e-5, "up": 1.1e-4})
    knocked = temperature([before, after])
    assert knocked.moved["left"] == pytest.approx(1e-3 / 6e-5) and knocked.moved["up"] is None
    assert knocked.rms == knocked.moved["left"]
    # The sampled posterior of the same looks is no news of theirs, and no measure of another kind of estimate.
    sampled = replace(after, tier="importance", u_deg_per_step={"left": 7.9e-5, "up": 1e-4})
    assert temperature([before, after, sampled]) is None and temperature([before]) is temperature([]) is None
    assert temperature([before, sampled, after]) == knocked
