"""Texts of `locate` for points and of `locate --cloud` for uncertainties."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tvsbayes.coordinates.cloud import LawChecked
from tvsbayes.coordinates.cloud_files import CloudFile
from tvsbayes.report.command_text import cloud_text, locations_text


@pytest.mark.parametrize("aperture_read", [False, True])
def test_points_are_marked_where_their_distance_is_stated(aperture_read):
    located = SimpleNamespace(
        refused=[None],
        covariance_mm2=np.eye(3)[None],
        xyz_mm=np.array([[751.0, 173.0, 7.7]]),
        u95_mm=np.ones((1, 3)),
        digits_held=np.ones((1, 3)),
        law_off_mm=np.zeros(1),
        extrapolated=[False],
        unseen=[""],
        draws=1000,
        estimator="posterior",
    )
    text = " ".join(locations_text(located, aperture_read).split())
    assert "751.0(1.0)" in text
    assert ("no aperture readings: distances rest on baseline" in text) is not aperture_read


@pytest.mark.parametrize("held, points, advice", ((25, 156, "do not rely on the sds"), (149, 156, "may be relied on")))
def test_a_cloud_states_whether_its_sds_are_reliable(held, points, advice):
    """A user's 25 of 156; 149 of 156 is above 95 %."""
    cloud = CloudFile("out.ply", ("x", "y"), 1000, 0, 0, None, {})
    text = cloud_text(cloud, LawChecked(points, held, 5.7, 2700.0), SimpleNamespace())
    assert advice in text and f"at {held}" in text
    assert ("--points without --cloud" in text) == (held < 100)
