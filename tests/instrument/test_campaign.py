"""Campaign folders and plans: round trips, hashes, the campaigns of unknown rigs, cost of reading."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.refusals import refusal
from support.small_campaign import small_campaign
from support.written_rows import move_row

from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import (
    Campaign,
    input_hashes,
    read_campaign,
    write_campaign,
)
from tvsbayes.instrument.copies import refuse_same_looks
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.rig import RigTable

UNKNOWN_RIGS = Path(__file__).resolve().parents[3] / "shared" / "campaigns"


def assert_same(a: Campaign, b: Campaign) -> None:
    assert (a.moves, a.spots, a.rig, a.header) == (b.moves, b.spots, b.rig, b.header)
    for field in dataclasses.fields(a.stereo):
        assert np.array_equal(getattr(a.stereo, field.name), getattr(b.stereo, field.name)), field.name


def test_round_trip_is_identical(tmp_path):
    campaign = small_campaign()
    write_campaign(campaign, tmp_path / "deep" / "new")
    again = read_campaign(tmp_path / "deep" / "new")
    assert_same(campaign, again)
    assert again.path == tmp_path / "deep" / "new"
    write_campaign(again, tmp_path / "second")
    for name in ("campaign.toml", "stereo.json", "moves.csv", "spots.csv"):
        assert (tmp_path / "second" / name).read_bytes() == (again.path / name).read_bytes()
    assert sorted(p.name for p in again.path.iterdir()) == [
        "campaign.toml",
        "moves.csv",
        "spots.csv",
        "stereo.json",
    ]


def test_numpy_scalars_are_written_as_numbers(tmp_path):
    campaign = small_campaign()
    spots = [dataclasses.replace(s, aperture_deg=np.float64(50.0) / 3, spot=np.int64(s.spot)) for s in campaign.spots]
    priors = {**campaign.rig.priors, "focal_scale": Prior(np.float64(1.001), np.float64(0.0))}
    header = {"seed": np.int64(3)}
    numpy_like = Campaign(campaign.moves, tuple(spots), campaign.stereo, RigTable(priors), header)
    write_campaign(numpy_like, tmp_path / "c")
    assert_same(numpy_like, read_campaign(tmp_path / "c"))


def test_a_look_without_a_spot_may_be_repeated(tmp_path):
    """The same point of the experiment; correlations and pixels are empty; `classic` uses the look with a spot."""
    campaign = small_campaign()
    lost = dataclasses.replace(campaign.spots[6], experiment=3, point=1)
    write_campaign(dataclasses.replace(campaign, spots=(*campaign.spots[:6], lost)), tmp_path / "c")
    table = tmp_path / "c" / "spots.csv"
    header, *rows = table.read_text().splitlines()
    column = header.split(",").index("ruv_right")
    cells = rows[-1].split(",")
    assert cells[column] == "-0.5" and "undetected" in cells
    cells[column] = ""
    table.write_text("\n".join([header, *rows[:-1], ",".join(cells)]) + "\n")
    again = read_campaign(tmp_path / "c").spots[-1]
    assert (again.experiment, again.point, again.ruv_right) == (3, 1, 0.0)


def test_write_refuses_a_folder_with_files(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="nothing is overwritten"):
        write_campaign(small_campaign(), tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(InputError, match="a new or empty folder"):
        write_campaign(small_campaign(), tmp_path / "notes.txt")


def test_write_refuses_campaigns_that_read_refuses(tmp_path):
    campaign = small_campaign()
    wrong = {
        "nan": {"spots": (dataclasses.replace(campaign.spots[0], u_left_px=float("nan")),)},
        "move": {"moves": (move_row(1, 0, 0.0, 0, 0, "left", "up"),)},
        "header": {"header": {"color": "red"}},
        "stereo": {"stereo": dataclasses.replace(campaign.stereo, R=2 * np.eye(3))},
        "rig": {"rig": RigTable({**campaign.rig.priors, "backlash_deg.pan": Prior(0.2, 0.1, "half-normal")})},
    }
    for name, change in wrong.items():
        with pytest.raises(InputError):
            write_campaign(dataclasses.replace(campaign, **change), tmp_path / name)
        assert not (tmp_path / name).exists()


def test_bom_crlf_order_of_rows_and_columns(tmp_path):
    write_campaign(small_campaign(), tmp_path / "c")
    for path in (tmp_path / "c").iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    again = read_campaign(tmp_path / "c")
    assert_same(small_campaign(), again)
    moves = (tmp_path / "c" / "moves.csv").read_text(encoding="utf-8-sig").splitlines()
    turned = "\n".join(",".join(line.split(",")[::-1]) for line in moves)
    (tmp_path / "c" / "moves.csv").write_text(turned)
    assert read_campaign(tmp_path / "c").moves == again.moves
    lines = (tmp_path / "c" / "spots.csv").read_text(encoding="utf-8-sig").splitlines()
    (tmp_path / "c" / "spots.csv").write_text("\n".join([lines[0], *lines[:0:-1]]))
    assert read_campaign(tmp_path / "c").spots == again.spots[::-1]


def test_a_campaign_has_its_stated_title():
    """Otherwise that of its folder; titles of earlier templates are ignored, and a folder's name is untrusted."""
    campaign = dataclasses.replace(small_campaign(), path=Path("/data/rig 7"))
    for name, title in (
        ("bench B", "bench B"),
        ("my rig", "rig 7"),
        ("my campaign", "rig 7"),
        ("acquired campaign", "rig 7"),
        ("", "rig 7"),
    ):
        assert dataclasses.replace(campaign, header={"name": name}).title == title
    assert dataclasses.replace(campaign, header={}, path=None).title == "without a name"
    assert dataclasses.replace(campaign, header={}, path=Path("/data/a\nb")).title.isprintable()


def test_hashes_cover_data_and_no_names(tmp_path):
    campaign = small_campaign()
    reference = input_hashes(campaign)
    assert set(reference) == {"moves", "spots", "stereo", "rig"}
    assert all(len(digest) == 64 for digest in reference.values())
    write_campaign(campaign, tmp_path / "c")
    assert input_hashes(read_campaign(tmp_path / "c")) == reference
    same = dataclasses.replace(campaign, header={"name": "other", "notes": "x"}, spots=campaign.spots[::-1])
    assert input_hashes(same) == reference

    priors = {**campaign.rig.priors, "pixel_scale": Prior(1.0, 0.51, "log-normal")}
    covariance = campaign.stereo.parameter_covariance * 1.0000001
    last_digit = np.nextafter(campaign.spots[0].u_left_px, np.inf)
    changes = {
        "moves": {"moves": (*campaign.moves[:-1], dataclasses.replace(campaign.moves[-1], pan_steps=-101))},
        "spots": {"spots": (dataclasses.replace(campaign.spots[0], u_left_px=last_digit), *campaign.spots[1:])},
        "stereo": {"stereo": dataclasses.replace(campaign.stereo, parameter_covariance=covariance)},
        "rig": {"rig": RigTable(priors, campaign.rig.aperture_convention)},
    }
    for name, change in changes.items():
        changed = input_hashes(dataclasses.replace(campaign, **change))
        assert {key for key in reference if changed[key] != reference[key]} == {name}


@pytest.mark.parametrize(("name", "moves", "spots"), [("rig_a", 195, 384), ("rig_b", 145, 144), ("rig_c", 195, 384)])
def test_campaigns_of_unknown_rigs(tmp_path, name, moves, spots):
    if not (UNKNOWN_RIGS / name).is_dir():
        pytest.skip(f"{UNKNOWN_RIGS / name} is not part of the repository")
    campaign = read_campaign(UNKNOWN_RIGS / name)
    assert (len(campaign.moves), len(campaign.spots)) == (moves, spots)
    assert campaign.rig.priors["mirror_offset_mm"] == Prior(30.0, 2.0)
    write_campaign(campaign, tmp_path / name)
    assert_same(campaign, read_campaign(tmp_path / name))


def test_looks_that_were_seen_before_are_refused():
    """The folder itself, a copy with other ids, and a part of it; new looks beside a few old ones are taken."""
    known = small_campaign()
    again = tuple(dataclasses.replace(s, spot=s.spot + 100) for s in known.spots)
    for looks in (known.spots, again, known.spots[:2]):
        assert refusal(lambda looks=looks: refuse_same_looks(known, dataclasses.replace(known, spots=looks)))
    ok = [s for s in known.spots if s.status == "ok"]
    new = tuple(dataclasses.replace(s, u_left_px=s.u_left_px + 0.25) for s in ok[1:])
    refuse_same_looks(known, dataclasses.replace(known, spots=(ok[0], *new)))
