"""`report` of an axis with a tolerance and a signed certificate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.axes import runs
from support.signers import signer

from tvsbayes.single_axis.axis_campaign import AxisCampaign, Reading, Reference, write_axis


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    moves = runs(2, (0.0, 50.0, 100.0), beyond=5.0)
    rng, command = np.random.default_rng(8), np.array([m.command for m in moves])
    value = command * (1 + 4e-5) + rng.normal(0, 0.001, len(moves))
    read = [k for k, c in enumerate(command) if 0 <= c <= 100]
    readings = tuple(Reading(n, k, float(value[k])) for n, k in enumerate(read))
    place = tmp_path_factory.mktemp("axes") / "screw"
    write_axis(AxisCampaign("mm", moves, readings, command_unit="mm", reference=Reference(u_per_unit=5e-6)), place)
    return place


def test_a_tolerance_decides_the_exit_code(ask, folder):
    assert ask("fit", folder, "--no-sample")[0] == 0
    code, wide = ask("report", folder, "--tolerance", "50um", "--of", "A")
    (criterion,) = wide["criteria"]
    assert (code, criterion["verdict"], criterion["rule"], criterion["limit"]) == (0, "conforms", "guarded", 0.05)
    assert criterion["guard_band"] == pytest.approx(2 * criterion["u"]) and criterion["unit"] == "mm"
    # The reference's scale: 5e-6 of 100 mm.
    assert criterion["u"] == pytest.approx(5e-4, rel=0.01)
    code, narrow = ask("report", folder, "--tolerance", "0.0001", "--of", "A forward", "--rule", "simple")
    assert (code, narrow["criteria"][0]["verdict"]) == (1, "does not conform")
    assert narrow["criteria"][0]["guard_band"] is None
    code, plain = ask("report", folder)
    assert (code, plain["criteria"]) == (0, [])


def test_a_signed_certificate_lies_beside_the_page(ask, folder, tmp_path):
    pytest.importorskip("signxml")
    from tvsbayes.metrology.signature import verify_signature

    key, public = signer()
    (tmp_path / "key.pem").write_bytes(key)
    (tmp_path / "cert.pem").write_bytes(public)
    assert ask("fit", folder, "--no-sample")[0] == 0
    signed = ("--sign", tmp_path / "key.pem", "--certificate", tmp_path / "cert.pem")
    code, document = ask("report", folder, "--dcc", *signed, "-o", tmp_path / "page.html")
    assert code == 0 and document["files"]["dcc"] == str(tmp_path / "page.dcc.xml")
    verify_signature((tmp_path / "page.dcc.xml").read_bytes(), public)
    code, document = ask(
        "report", folder, "--dcc", "--sign", tmp_path / "cert.pem", "--certificate", tmp_path / "key.pem"
    )
    assert code == 2
