"""Crops of spots in the report: place and picture, suspect spots first, none without frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.small_campaign import small_campaign

from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import CAMERAS, frame_name, read_campaign, write_campaign
from tvsbayes.report.evidence import HALF_PX, LOOKS_SHOWN, spot_crops, spot_gallery


def usable_spots(campaign):
    return [spot for spot in campaign.spots if spot.status == "ok"]


@pytest.fixture
def pictured(tmp_path):
    """A campaign whose pictures are dark but for the pixel nearest to each stated centre."""
    write_campaign(small_campaign(), tmp_path / "mine")
    campaign = read_campaign(tmp_path / "mine")
    (tmp_path / "mine" / "frames").mkdir()
    for spot in usable_spots(campaign):
        for camera in CAMERAS:
            picture = np.zeros((campaign.stereo.image_height, campaign.stereo.image_width, 3), np.uint8)
            u, v = getattr(spot, f"u_{camera}_px"), getattr(spot, f"v_{camera}_px")
            picture[round(v), round(u)] = 255
            (tmp_path / "mine" / frame_name(spot.spot, camera)).write_bytes(png_bytes(picture))
    return campaign


def test_cut_outs_show_the_spot_under_its_cross(pictured):
    suspect = usable_spots(pictured)[-1].spot
    crops = spot_crops(pictured, (suspect,))
    assert [crop.camera for crop in crops] == list(CAMERAS) * min(LOOKS_SHOWN, len(usable_spots(pictured)))
    assert crops[0].spot == suspect
    for crop in crops:
        assert max(crop.grey.shape) <= 2 * HALF_PX + 1
        row, column = np.unravel_index(crop.grey.argmax(), crop.grey.shape)
        bright = np.array([crop.corner_px[0] + column, crop.corner_px[1] + row])
        # The pixel nearest to the centre lies within half a pixel of it.
        assert np.abs(bright - crop.centre_px).max() <= 0.5
    assert len(spot_gallery(crops).axes) == 2 * len({crop.spot for crop in crops})


def test_a_centre_far_outside_the_picture_has_no_cut_out(pictured):
    """The reader accepts centres up to a tenth of the picture outside of it."""
    first = usable_spots(pictured)[0]
    outside = replace(first, v_left_px=-HALF_PX - 10.0, u_right_px=-HALF_PX - 10.0)
    crops = spot_crops(replace(pictured, spots=(outside,)), ())
    assert crops == ()
    edge = spot_crops(replace(pictured, spots=(replace(first, v_left_px=-5.0),)), ())
    assert edge[0].grey.shape == (HALF_PX - 4, 2 * HALF_PX + 1) and edge[0].corner_px[1] == 0


def test_damaged_and_missing_pictures_do_not_stop_the_report(pictured):
    first = pictured.path / frame_name(usable_spots(pictured)[0].spot, "left")
    first.write_bytes(b"no picture")
    crops = spot_crops(pictured, (usable_spots(pictured)[0].spot,))
    assert (crops[0].spot, crops[0].camera) == (usable_spots(pictured)[0].spot, "right")
    assert spot_crops(replace(pictured, path=None), ()) == ()
    assert spot_crops(small_campaign(), ()) == ()
