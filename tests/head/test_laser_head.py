"""A head that turns a laser before a stereo pair: its page, and what it lacks."""

from __future__ import annotations

import pytest
from support.commands import assert_error

from experiments.intervals.heads import head_of, plan_of
from tvsbayes.instrument.campaign import write_campaign
from tvsbayes.twin.simulated_campaign import simulate

pytestmark = pytest.mark.thorough


def test_its_campaign_is_checked_and_its_page_has_ratios_and_terms_but_no_located_points(tmp_path, ask):
    """Without an aperture no point is located, so there are no errors in mm."""
    folder = tmp_path / "head"
    write_campaign(simulate(head_of("spots"), plan_of("spots", 3), 3).campaign, folder)
    assert ask("check", folder)[0] == ask("fit", folder, "--no-sample")[0] == ask("report", folder)[0] == 0
    page = (folder / "results" / "report.html").read_text(encoding="utf-8")
    assert "Degrees of the line of sight per motor step" in page and "elevation axis ahead, mm" in page
    assert "What the spots do not determine" in page and "sighting" not in page and "Errors in 3D" not in page
    code, aimed = ask("steps-for", folder, "--x-mm", 500, "--y-mm", 0, "--z-mm", 20)
    assert code == 0 and aimed["u95_mm"] is not None and aimed["aperture_deg"] is None
    for command, *options in (("report", "--limit-mm", "1"), ("calibrate",)):
        code, document = ask(command, folder, *options)
        assert code == 2 and " is for a scanner" in assert_error(document, "usage")["message"]
