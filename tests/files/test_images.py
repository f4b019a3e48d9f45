"""PNG and JPEG: size limits before decoding, refusal of damaged files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.images import (
    IMAGE_PIXELS_MAX,
    WHOLE_PX,
    WINDOW_PX,
    decode_image,
    image_size,
    in_grey_levels,
    png_bytes,
    read_image,
    small_picture,
    white_level,
)


def picture(channels: int = 3) -> np.ndarray:
    """A seeded frame of 40 x 30 pixels without symmetry."""
    pixels = np.random.default_rng(5).integers(0, 256, (30, 40, channels), dtype=np.uint8)
    return pixels if channels > 1 else pixels[..., 0]


def refused(data: bytes) -> InputError:
    with pytest.raises(InputError) as caught:
        decode_image(data, "000001_left.png")
    assert caught.value.file == "000001_left.png" and caught.value.remedy
    return caught.value


def test_a_png_round_trips_to_the_bit(tmp_path):
    pixels = picture()
    (tmp_path / "a.png").write_bytes(png_bytes(pixels))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png", tmp_path), pixels)
    grey = picture(1)
    (tmp_path / "b.png").write_bytes(png_bytes(grey))
    np.testing.assert_array_equal(read_image(tmp_path / "b.png"), np.repeat(grey[..., None], 3, axis=2))


def test_a_jpeg_is_read_without_its_orientation_tag():
    """A camera held upright tags its pictures; pixel coordinates belong to the sensor."""
    smooth = cv2.resize(picture(), (400, 300), interpolation=cv2.INTER_CUBIC)
    data = cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2) + exif + data[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (400, 300, 3)
    np.testing.assert_array_equal(decode_image(turned, "a.jpg"), decode_image(data, "a.jpg"))
    assert image_size(turned, "a.jpg") == (400, 300)


def test_every_flipped_or_cut_byte_of_a_png_is_refused():
    data = png_bytes(picture())
    for place in range(len(data)):
        flipped = bytearray(data)
        flipped[place] ^= 0x10
        assert refused(bytes(flipped)).code in ("image", "image-size"), place
    for length in range(len(data)):
        refused(data[:length])


def test_a_picture_bomb_is_refused_by_its_header():
    data = bytearray(png_bytes(picture()))
    data[16:24] = (30_000).to_bytes(4) + (30_000).to_bytes(4)
    error = refused(bytes(data))
    assert error.code == "image-size" and "30000 x 30000" in error.message
    side = int(IMAGE_PIXELS_MAX**0.5)
    data[16:24] = (side).to_bytes(4) + (side).to_bytes(4)
    assert image_size(bytes(data), "a.png") == (side, side)
    data[16:24] = bytes(8)
    assert refused(bytes(data)).code == "image-size"


@pytest.mark.parametrize("data", [b"", b"GIF89a" + bytes(60), b"BM" + bytes(60), b"II*\0" + bytes(60), b"\xff\xd8\xff"])
def test_other_formats_are_refused_under_any_name(data):
    assert refused(data).code == "image"


def test_jpegs_of_unusual_kinds_are_refused():
    data = cv2.imencode(".jpg", picture())[1].tobytes()
    frame = data.index(b"\xff\xc0")
    for kind in (0xC3, 0xC9, 0xCF):
        refused(data[: frame + 1] + bytes([kind]) + data[frame + 2 :])
    deep = bytearray(data)
    deep[frame + 4] = 12
    assert "12 bits" in refused(bytes(deep)).message
    for length in range(0, frame + 9):
        refused(data[:length])


def test_deep_pngs_keep_every_bit_at_half_the_size():
    deep = picture().astype(np.uint16) * 16 + 5
    np.testing.assert_array_equal(decode_image(png_bytes(deep), "a.png"), deep)
    np.testing.assert_array_equal(decode_image(png_bytes(deep[..., 0]), "a.png"), np.repeat(deep[..., :1], 3, axis=2))
    data = bytearray(png_bytes(deep))
    side = int((IMAGE_PIXELS_MAX // 2) ** 0.5)
    data[16:24] = side.to_bytes(4) * 2
    assert image_size(bytes(data), "a.png") == (side, side)
    data[16:24] = (side + 1).to_bytes(4) * 2
    assert refused(bytes(data)).code == "image-size"


def test_grey_levels_of_deep_pictures():
    """Full scale is 255 at any bit depth; eight bits are unchanged."""
    shallow = picture()
    assert in_grey_levels(shallow) is shallow
    assert [white_level(value) for value in (0, 255, 256, 1023, 4000, 4095, 4096, 65535)] == [
        *(255, 255, 1023, 1023, 4095, 4095, 16383, 65535)
    ]
    deep = np.array([[0, 819, 4095]], np.uint16)
    np.testing.assert_allclose(in_grey_levels(deep), [[0, 51, 255]], rtol=1e-6)
    np.testing.assert_allclose(in_grey_levels(deep, 65535), [[0, 819 / 257, 4095 / 257]], rtol=1e-6)


def test_pictures_are_small_and_the_window_is_on_the_spot():
    image = np.zeros((720, 1280, 3), np.uint8)
    image[300:303, 700:703] = 250
    whole = decode_image(small_picture(image), "whole")
    assert whole.shape == (270, WHOLE_PX, 3)
    window = decode_image(small_picture(image, (701.3, 301.4)), "window")
    assert window.shape == (WINDOW_PX, WINDOW_PX, 3)
    row, column = np.argwhere(window[..., 0] > 125).mean(axis=0)
    assert (row, column) == (WINDOW_PX / 2, WINDOW_PX / 2)
    corner = decode_image(small_picture(image, (0.0, 719.0)), "corner")
    assert corner.shape == window.shape


def test_pictures_of_twelve_bits_are_shown():
    image = np.full((40, 40, 3), 4000, np.uint16)
    assert decode_image(small_picture(image), "picture").mean() > 240
    with pytest.raises(ValueError, match="no pixel"):
        small_picture(image, (40.0, 3.0))
