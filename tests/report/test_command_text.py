"""What `locate --cloud` says of its uncertainties."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from tvsbayes.coordinates.cloud import LawChecked
from tvsbayes.coordinates.cloud_files import CloudFile
from tvsbayes.report.command_text import cloud_text


@pytest.mark.parametrize("held, points, said", ((25, 156, "do not rely on the sds"), (149, 156, "may be relied on")))
def test_a_cloud_says_whether_its_sds_may_be_relied_on(held, points, said):
    """A user's 25 of 156; 149 of 156 is above 95 %."""
    cloud = CloudFile(Path("out.ply"), ("x", "y"), 1000, 0, 0, None)
    text = cloud_text(cloud, LawChecked(points, held, 5.7, 2700.0), SimpleNamespace())
    assert said in text and f"at {held}" in text
    assert ("--points without --cloud" in text) == (held < 100)
