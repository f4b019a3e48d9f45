"""Pictures in a page: reduced, the spot as it was taken, within a limit, none from elsewhere."""

from __future__ import annotations

import base64
from dataclasses import replace

import numpy as np
import pytest

from tvsbayes.files.images import WINDOW_PX, decode_image, png_bytes
from tvsbayes.instrument.campaign import frame_name, read_campaign
from tvsbayes.view.pictures import WIDTH_PX, look_pictures
from tvsbayes.view.scene import scene


@pytest.fixture
def looks(viewed):
    return scene(read_campaign(viewed.bare)).looks


def decoded(uri: str) -> np.ndarray:
    kind, _, content = uri.partition(",")
    assert kind == "data:image/jpeg;base64"
    return decode_image(base64.b64decode(content), "picture")


def write(folder, spot, camera, image):
    (folder / "frames").mkdir(exist_ok=True)
    (folder / frame_name(spot, camera)).write_bytes(png_bytes(image))


def with_kept(looks, *spots):
    """The same looks, of which some have both pictures."""
    return replace(looks, pictures=np.isin(looks.spot, spots)[:, None].repeat(2, axis=1))


def test_spot_lies_where_the_page_draws_it(looks, tmp_path):
    u, v = looks.pixels_px[3, :2]
    image = np.zeros((720, 1280), np.uint8)
    image[round(v), round(u)] = 255
    write(tmp_path, 3, "left", image)
    picture = look_pictures(tmp_path, with_kept(looks, 3))[3]["left"]
    assert decoded(picture.whole).shape == (180, WIDTH_PX, 3)
    window = decoded(picture.spot)[..., 0]
    assert window.shape == (WINDOW_PX, WINDOW_PX)
    row, column = np.unravel_index(window.argmax(), window.shape)
    # The outer corner of pixel (0, 0) lies at (-0.5, -0.5).
    assert (picture.corner_px[0] + 0.5 + column, picture.corner_px[1] + 0.5 + row) == (round(u), round(v))


def test_unlikely_looks_come_first_and_the_limit_holds(looks, tmp_path):
    kept = list(range(20, 60))
    for spot in kept:
        write(tmp_path, spot, "left", np.full((72, 128), 40, np.uint8))
    suspect = looks.spot == 51
    wanted = replace(with_kept(looks, *kept), suspect=suspect)
    all_of_them = look_pictures(tmp_path, wanted)
    assert sorted(all_of_them) == kept
    size = sum(picture.size for of_look in all_of_them.values() for picture in of_look.values())
    shares = []
    some = look_pictures(tmp_path, wanted, size // 4, shares.append)
    assert next(iter(some)) == 51 and shares == sorted(shares)
    assert sum(picture.size for of_look in some.values() for picture in of_look.values()) <= size // 4
    # A quarter of equal pictures, evenly chosen: no gap is wider than three even ones.
    assert len(some) in (9, 10) and max(np.diff(sorted([20, *some, 59]))) <= 3 * 4


def test_damaged_pictures_and_links_that_leave_the_folder_are_left_out(looks, tmp_path):
    folder = tmp_path / "campaign"
    folder.mkdir()
    write(tmp_path, 3, "left", np.full((72, 128), 40, np.uint8))
    write(folder, 4, "right", np.full((72, 128), 40, np.uint8))
    (folder / frame_name(3, "left")).symlink_to(tmp_path / frame_name(3, "left"))
    (folder / frame_name(3, "right")).write_bytes(b"no picture")
    pictures = look_pictures(folder, with_kept(looks, 3, 4, 5))
    assert list(pictures) == [4] and list(pictures[4]) == ["right"]
    # The spot lies beyond this small picture.
    assert pictures[4]["right"].spot is None and pictures[4]["right"].corner_px is None
    assert look_pictures(None, with_kept(looks, 3)) == {}
