"""A campaign as a NeXus file: read by the rules of NeXus with h5py alone, by nexusformat, and back to the bytes."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.bench_runs import Run, small_plan

from tvsbayes.acquisition.nexus_file import write_nexus
from tvsbayes.cli.main import run
from tvsbayes.errors import InputError
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import read_campaign, with_pixels, write_campaign
from tvsbayes.results.records import plain

CLASSES = {f"NX{name}" for name in ("entry", "data", "instrument", "positioner", "detector", "collection", "note")}


@pytest.fixture(scope="module")
def exported(mounted_rig, tmp_path_factory):
    """A simulated run of eight looks, and its file."""
    place = tmp_path_factory.mktemp("exported")
    Run(mounted_rig, place / "c", small_plan(2)).engine.run()
    summary = write_nexus(place / "c", place / "run.nxs")
    assert plain(summary) == {"moves": 5, "looks": 8, "ok": 8, "events": summary.events, "pictures": 0}
    return place / "c", place / "run.nxs"


def every(group):
    for node in group.values():
        yield node
        if isinstance(node, h5py.Group):
            yield from every(node)


def text(dataset):
    return [item.decode() for item in dataset[()]] if dataset.shape else dataset[()].decode()


def test_the_default_plot_is_found_by_the_rules_of_nexus(exported):
    """From the root by the attribute `default`, then `signal`, `axes` and `_errors`: no name of ours is needed."""
    folder, path = exported
    campaign = read_campaign(folder)
    with h5py.File(path) as file:
        entry = file[file.attrs["default"]]
        data = entry[entry.attrs["default"]]
        assert (entry.attrs["NX_class"], data.attrs["NX_class"]) == ("NXentry", "NXdata")
        signal, axes = data[data.attrs["signal"]], [data[name] for name in data.attrs["axes"]]
        assert signal.attrs["units"] == "px" and signal.shape == axes[0].shape == (8,)
        assert signal[()].tolist() == [spot.u_left_px for spot in campaign.spots]
        assert data[data.attrs["signal"] + "_errors"][()].tolist() == [spot.su_left_px for spot in campaign.spots]
        for name in data.attrs["auxiliary_signals"]:
            assert np.isfinite(data[name][()]).all() and data[name].attrs["units"] == "px"
        assert data["pan_steps"][()].tolist() == [campaign.moves[s.move].pan_steps for s in campaign.spots]
        assert text(data["target"]) == [spot.target for spot in campaign.spots]
        assert np.diff(data["time"][()]).min() >= 0 and data["time"].attrs["units"] == "s"
        assert entry["moves/temperature_degC"].attrs["units"] == "degC"
        assert text(entry["start_time"]) == "2026-01-01T00:00:00+00:00" and entry["simulated"][()]
        assert np.allclose(entry["instrument/stereo/translation"][()], np.ravel(campaign.stereo.T), atol=0)
        assert entry["instrument/prior/focal_scale"].attrs["uncertainty"] == 0.002
        groups = [node for node in every(file) if isinstance(node, h5py.Group)]
        classes = [group.attrs["NX_class"] for group in groups]
        assert set(classes) <= CLASSES, "every group says what it is"


def test_looks_without_a_spot_and_campaigns_without_a_journal(tmp_path):
    """What is missing is not a number, never a zero."""
    twin = read_campaign(shipped_data() / "twins" / "paper_twin")
    spots = [with_pixels(spot, "no-spot") if spot.spot % 5 == 0 else spot for spot in twin.spots]
    spots[7] = replace(spots[7], aperture_deg=88.5, experiment=None, point=None)
    write_campaign(replace(twin, spots=tuple(spots)), tmp_path / "c")
    summary = write_nexus(tmp_path / "c", tmp_path / "twin.nxs")
    assert (summary.looks, summary.events) == (len(spots), 0) and summary.ok < summary.looks
    with h5py.File(tmp_path / "twin.nxs") as file:
        looks = file["entry/looks"]
        wanted = [np.nan if spot.aperture_deg is None else spot.aperture_deg for spot in spots]
        assert np.array_equal(looks["aperture"][()], wanted, equal_nan=True) and np.nansum(wanted) == 88.5
        assert np.isnan(looks["u_left"][()]).tolist() == [spot.u_left_px is None for spot in spots]
        assert [None if n == -1 else n for n in looks["experiment"][()]] == [spot.experiment for spot in spots]


def test_command(exported, tmp_path, capsys):
    folder, path = exported
    assert run(["export", str(folder), "--nexus", str(tmp_path / "again.nxs"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["nexus"] == str(tmp_path / "again.nxs") and (document["moves"], document["looks"]) == (5, 8)
    assert (tmp_path / "again.nxs").read_bytes() == path.read_bytes(), "the same campaign gives the same bytes"
    assert run(["export", str(folder), "--nexus", str(path), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "occupied"
    with pytest.raises(InputError):
        write_nexus(tmp_path / "nowhere", tmp_path / "x.nxs")
    assert not (tmp_path / "x.nxs").exists()
