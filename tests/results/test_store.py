"""The files of a fit belong together: mixed, half written and foreign ones are never taken, in commands or Python."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest
from support.axes import drawn, runs
from support.small_campaign import small_campaign
from support.small_results import small_draws, small_record, whole_summary
from support.stored_fits import edit_fit, npz

from tvsbayes.errors import InputError, Reason
from tvsbayes.files.disk import locked
from tvsbayes.instrument.campaign import input_hashes, read_campaign, write_campaign
from tvsbayes.pipeline import inputs_of, load_calibration, load_posterior
from tvsbayes.pipeline import read_campaign as read_any
from tvsbayes.results.store import LOCK, FitFiles, read_fit_files, sole_writer
from tvsbayes.results.stored_draws import write_results
from tvsbayes.single_axis.axis_campaign import read_axis, write_axis
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import keep_fit, results_for, summarise_axis

FILES = ("fit.json", "draws.npz")
OF_TWO = "results/draws.npz is of another fit than fit.json"


def keep(folder: Path, seed: int) -> Path:
    """A fit of the axis in a folder."""
    fit = fit_axis(read_axis(folder), sampled=False, seed=seed)
    keep_fit(fit, summarise_axis(fit), folder / "results")
    return folder


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """Two fits of one axis, with other seeds, and one of another axis."""
    place = tmp_path_factory.mktemp("axes")
    for name, axis in (("one", 4), ("two", 4), ("other", 5)):
        write_axis(drawn(axis, runs(2), backlash=AxisPrior(0.0, 0.1)).campaign, place / name)
        keep(place / name, seed=2 if name == "two" else 1)
    return place


@pytest.fixture
def mine(fits, tmp_path):
    return shutil.copytree(fits / "one", tmp_path / "mine")


def refused(call) -> InputError:
    with pytest.raises(InputError) as caught:
        call()
    error = caught.value
    assert error.found and error.allowed and "tvsbayes fit" in error.remedy
    return error


def why_fitted_again(folder: Path, monkeypatch) -> str:
    """What a command says before it fits; "" where it takes the stored fit."""
    said: list[str] = []
    monkeypatch.setattr("tvsbayes.single_axis.axis_record.fit_axis", lambda *_, **__: fit_axis(*_, sampled=False))
    results_for(read_axis(folder), notify=said.append)
    return "".join(said).removesuffix(": fitting first (weighted draws) ...")


@pytest.mark.parametrize("foreign", ["two", "other"])
@pytest.mark.parametrize("name", FILES)
def test_files_of_two_fits_are_not_taken_together(fits, mine, foreign, name, monkeypatch):
    """Of another seed or another axis: commands fit again and say why, Python refuses."""
    assert why_fitted_again(mine, monkeypatch) == ""
    shutil.copy(fits / foreign / "results" / name, mine / "results" / name)
    reason = "results/ are of other readings.csv" if (foreign, name) == ("other", "fit.json") else OF_TWO
    assert why_fitted_again(mine, monkeypatch) == reason
    error = refused(lambda: load_posterior(mine, anyway=True))
    assert (error.code, error.found) == ("stale-results", reason)


def test_a_process_that_ends_between_two_files_leaves_no_fit_that_is_taken(mine, monkeypatch):
    """`fit.json` comes last: where it is new, everything is; else it names draws that are no longer there."""
    old = json.loads((mine / "results" / "fit.json").read_text())["fit_id"]
    replace_file, left = os.replace, [0]

    def killed(source, target):
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        replace_file(source, target)

    monkeypatch.setattr(os, "replace", killed)
    taken = []
    for count in range(3):
        copy, left[0] = shutil.copytree(mine, mine.with_name(f"after {count}")), count
        try:
            keep(copy, seed=2)
        except KeyboardInterrupt:
            assert count < len(FILES)
        found = read_fit_files(copy / "results", inputs_of(read_any(copy)))
        assert {path.name for path in (copy / "results").iterdir()} == set(FILES), "nothing is left beside"
        taken.append(found.reason if isinstance(found, Reason) else found.keys.values["fit_id"] == old)
        if json.loads((copy / "results" / "fit.json").read_text())["fit_id"] != old:
            assert isinstance(found, FitFiles), "fit.json was there before its draws"
    assert taken == [True, OF_TWO, False]


def test_one_fit_again_is_the_same_files(mine, tmp_path):
    """The id is made of content, inputs, versions and seed."""
    again = keep(shutil.copytree(mine, tmp_path / "again"), seed=1)
    assert (again / "results" / "draws.npz").read_bytes() == (mine / "results" / "draws.npz").read_bytes()
    with np.load(mine / "results" / "draws.npz") as draws:
        assert str(draws["fit_id"]) == json.loads((mine / "results" / "fit.json").read_text())["fit_id"]
        assert json.loads(str(draws["inputs_sha256"])) == inputs_of(read_any(mine))


def test_python_refuses_the_fit_of_edited_data(mine, tmp_path):
    """Of an axis and of a scanner; anywhere else than beside data nothing is known of them."""
    lone = shutil.copytree(mine / "results", tmp_path / "elsewhere")
    table = mine / "readings.csv"
    head, row = table.read_text().rstrip("\n").rsplit("\n", 1)
    cells = row.split(",")
    cells[2] = str(float(cells[2]) + 0.125)
    table.write_text(f"{head}\n{','.join(cells)}\n")
    for place in (mine, mine / "results"):
        error = refused(lambda place=place: load_posterior(place, anyway=True))
        assert (error.code, error.found) == ("stale-results", "results/ are of other readings.csv")
    assert load_posterior(lone, anyway=True).answer == "laplace"


def scanner(folder: Path) -> Path:
    write_campaign(small_campaign(), folder)
    write_results(folder / "results", small_record(whole_summary()), small_draws())
    return folder


def test_files_without_an_id_pass_by_their_hashes(mine, tmp_path, monkeypatch):
    """As 0.3.0 and earlier wrote them; one without beside one with an id is of another fit."""
    edit_fit(mine / "results", fit_id=None)
    assert why_fitted_again(mine, monkeypatch) == OF_TWO
    with np.load(mine / "results" / "draws.npz") as draws:
        arrays = {name: draws[name] for name in draws if name not in ("fit_id", "inputs_sha256")}
    (mine / "results" / "draws.npz").write_bytes(npz(**arrays))
    assert why_fitted_again(mine, monkeypatch) == ""
    assert load_posterior(mine, anyway=True).answer == "laplace"
    folder = scanner(tmp_path / "s")
    edit_fit(folder / "results", fit_id=None)
    for inputs, reason in ((input_hashes(read_campaign(folder)), None), ({"moves": "0" * 64}, OF_TWO)):
        tables = np.array(json.dumps({"inputs_sha256": inputs}))
        (folder / "results" / "draws.npz").write_bytes(npz(names=["a"], physical=np.zeros((3, 1)), tables=tables))
        found = read_fit_files(folder / "results", input_hashes(read_campaign(folder)))
        assert (found.reason if isinstance(found, Reason) else None) == reason


@pytest.mark.parametrize("fit_id", [None, "0" * 64])
def test_another_model_of_an_old_version_is_read_in_python_alone(tmp_path, fit_id):
    """Another version writes [rig] in other words; nobody can tell whether it was edited, too."""
    folder = scanner(tmp_path / "s")
    document = small_record(whole_summary()).as_json()
    inputs = {**document["inputs"], "rig": "0" * 64}
    edit_fit(folder / "results", inputs=inputs, versions={**document["versions"], "tvsbayes": "0.1.0"})
    path = folder / "results" / "fit.json"
    keys = json.loads(path.read_text())
    path.write_text(json.dumps({**keys, "fit_id": fit_id} if fit_id else {k: keys[k] for k in keys if k != "fit_id"}))
    tie = {"fit_id": fit_id} if fit_id else {}
    (folder / "results" / "draws.npz").write_bytes(npz(names=["a"], physical=np.zeros((3, 1)), **tie))
    reason = "results/ are of tvsbayes 0.1.0, with another model of the rig, or of another [rig]"
    now = input_hashes(read_campaign(folder))
    assert read_fit_files(folder / "results", now).reason == reason
    with pytest.raises(InputError) as caught:
        load_calibration(folder)
    # The draws of this test are no calibration: that is found only in files that are taken.
    expected = ("stale-results", reason) if fit_id else ("no-calibration", None)
    assert (caught.value.code, caught.value.found) == expected


def test_two_fits_of_a_folder_are_refused_and_two_folders_are_not(mine, say, tmp_path):
    """Whoever is refused is told who fits; the results are those of before, and no lock stays."""
    before = {name: (mine / "results" / name).read_bytes() for name in FILES}
    with sole_writer(mine / "results"):
        code, _, err = say("fit", mine, "--no-sample", "--seed", 2)
        assert code == 2 and f"process {os.getpid()} on " in err and "one fit of a folder at once" in err
        assert "--out" in err
        assert {name: (mine / "results" / name).read_bytes() for name in FILES} == before
        assert say("fit", mine, "--no-sample", "--seed", 2, "--out", tmp_path / "beside")[0] == 0
    assert sorted(path.name for path in (mine / "results").iterdir()) == sorted(FILES)
    assert say("fit", mine, "--no-sample", "--seed", 2)[0] == 0
    assert (mine / "results" / "draws.npz").read_bytes() == (tmp_path / "beside" / "draws.npz").read_bytes()


def test_a_folder_that_a_fit_left_empty_is_gone(tmp_path):
    with pytest.raises(RuntimeError), sole_writer(tmp_path / "a" / "results"):
        raise RuntimeError
    assert not (tmp_path / "a" / "results").exists()


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_a_killed_fit_holds_its_folder_no_longer(tmp_path):
    """What it was writing is removed by the next."""
    results = tmp_path / "results"
    code = (
        "import pathlib, sys; from tvsbayes.results.store import sole_writer\n"
        "with sole_writer(pathlib.Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code, results]
    unfinished = results / ".draws.npz.0123456789ab.tmp"
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as held:
        assert held.stdout.readline() == b"held\n"
        unfinished.touch()
        assert f"process {held.pid} on " in refused(lambda: sole_writer(results).__enter__()).found
        held.send_signal(signal.SIGKILL)
    assert (results / LOCK).exists()
    with sole_writer(results):
        assert not unfinished.exists()
    assert not (results / LOCK).exists()


def test_a_lock_whose_holder_goes_meanwhile_is_taken_anew(tmp_path, monkeypatch):
    """The file that was opened is no longer there when it is locked: a lock on it would hold nobody off."""
    results, taken = tmp_path / "results", []

    def late(descriptor: int) -> bool:
        if not taken:
            (results / LOCK).unlink()
        taken.append(locked(descriptor))
        return taken[-1]

    monkeypatch.setattr("tvsbayes.results.store.locked", late)
    with sole_writer(results):
        assert taken == [True, True] and (results / LOCK).exists()


@pytest.mark.skipif(os.name != "posix", reason="links")
def test_a_lock_is_no_way_out_of_the_folder(tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / LOCK).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError) as caught, sole_writer(tmp_path / "results"):
        pass
    assert caught.value.code == "write" and not (tmp_path / "elsewhere").exists()


def test_missing_metadata_lose_no_work(mine, monkeypatch):
    """A package without metadata: null in the record, which is read again."""

    def some(package: str) -> str:
        if package in ("arviz", "tvsbayes"):
            raise PackageNotFoundError(package)
        return version(package)

    monkeypatch.setattr("tvsbayes.files.packages.version", some)
    keep(mine, seed=3)
    document = json.loads((mine / "results" / "fit.json").read_text())
    assert document["versions"]["arviz"] is None and document["versions"]["numpy"] == version("numpy")
    assert why_fitted_again(mine, monkeypatch) == ""
    record = small_record(whole_summary())
    assert record.provenance.versions["arviz"] is None and record.provenance.shown_versions["tvsbayes"] == "unknown"
