"""PNG and JPEG: the size before decoding, the pixels, and the writing of PNG.

Pictures are (height, width, 3), blue, green, red (OpenCV's order), uint8 or, from PNG of 16 bits, uint16 as in the
file; pixel coordinates are those of the sensor. The size in a header is checked against a limit first: a small file
can state gigabytes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.disk import read_bytes

if TYPE_CHECKING:
    import numpy as np


IMAGE_BYTES_MAX = 64 * 1024 * 1024
IMAGE_PIXELS_MAX = 50_000_000
"""A PNG of 0.9 MB can state 30000 x 30000 pixels: 4 s and 1.8 GB in the decoder."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
"""The last chunk with its checksum: decoders accept its absence, but a truncated file lacks more."""
_PNG_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 6: (8, 16)}
"""Accepted bit depths by colour type of a PNG: grey, RGB, palette, RGBA (PNG specification 3, 11.2.1)."""
_JPEG_MAGIC = b"\xff\xd8\xff"
_JPEG_FRAMES = (0xC0, 0xC1, 0xC2)
"""Baseline, extended and progressive Huffman frames (ITU-T T.81, table B.1)."""
_JPEG_BARE = (0x01, 0xD8, *range(0xD0, 0xD8))
"""Markers without a length (ITU-T T.81 B.1.1.3)."""
_PNG_DEEP = 16
IMAGES_ALLOWED = (
    f"PNG of 8 or 16 bits, or JPEG of 8 bits per channel; at most {IMAGE_PIXELS_MAX // 1_000_000} million pixels, "
    "half as many of 16 bits"
)
WHOLE_PX = 480
"""Width of a whole picture on a page."""
WINDOW_PX = 48
"""Side of the cut-out around a spot on a page, pixels of the camera."""
JPEG_QUALITY = 80
WHITE_BITS = (8, 10, 12, 14, 16)
"""Bits of cameras' converters; a file of 16 bits can hold the values of each of them."""


def image_size(data: bytes, file: str) -> tuple[int, int]:
    """Width and height in pixels from the header of a PNG or JPEG, before decoding.

    Raises:
        InputError: neither PNG nor JPEG, an unusual kind, or too many pixels.
    """

    def refuse(code: str, found: str, remedy: str) -> InputError:
        return refusal(code, file=file, found=found, allowed=IMAGES_ALLOWED, remedy=remedy)

    if data.startswith(PNG_SIGNATURE):
        if len(data) < 33 or data[8:16] != b"\x00\x00\x00\rIHDR":
            raise refuse("image", "a PNG without its header", "copy the file again")
        if not data.endswith(_PNG_END):
            raise refuse("image", "a PNG cut short", "copy the file again")
        width, height = int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
        if data[24] not in _PNG_DEPTHS.get(data[25], ()):
            raise refuse("image", f"{data[24]} bits, colour type {data[25]}", "save it with 8 bits per channel")
    elif data.startswith(_JPEG_MAGIC):
        width, height = _jpeg_size(data, refuse)
    else:
        raise refuse("image", f"a file that begins with {data[:8].hex(' ') or 'nothing'}", "save it as PNG")
    pixels_max = IMAGE_PIXELS_MAX // (2 if is_deep(data) else 1)
    if not 0 < width * height <= pixels_max:
        raise refuse("image-size", f"{width} x {height} pixels", "crop or scale it")
    return width, height


def is_deep(data: bytes) -> bool:
    """Whether a PNG with a complete header has 16 bits per channel."""
    return data.startswith(PNG_SIGNATURE) and data[24] == _PNG_DEEP


def _jpeg_size(data: bytes, refuse: Callable[[str, str, str], InputError]) -> tuple[int, int]:
    """Size in the first frame header of a JPEG."""
    position = 2
    while position + 9 <= len(data):
        if data[position] != 0xFF:
            raise refuse("image", "a JPEG with bytes between its segments", "copy the file again")
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif marker in _JPEG_BARE:
            position += 2
        elif marker in _JPEG_FRAMES:
            if data[position + 4] != 8:
                raise refuse("image", f"{data[position + 4]} bits", "save it with 8 bits per channel")
            return int.from_bytes(data[position + 7 : position + 9]), int.from_bytes(data[position + 5 : position + 7])
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            raise refuse("image", f"JPEG of kind SOF{marker - 0xC0}", "save it as PNG")
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4])
    raise refuse("image", "a JPEG without a frame", "copy the file again")


def decode_image(data: bytes, file: str) -> np.ndarray:
    """Decode the picture in `data` as (height, width, 3) uint8 or uint16, channels blue, green, red (OpenCV's order).

    The orientation tag of a JPEG is ignored: pixel coordinates are those of the sensor.

    Raises:
        InputError: as `image_size`, or the decoder cannot read the data.
    """
    width, height = image_size(data, file)
    import cv2
    import numpy as np

    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION | (cv2.IMREAD_ANYDEPTH if is_deep(data) else 0)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.shape != (height, width, 3):
        found = "damaged image data" if image is None else f"{image.shape[1]} x {image.shape[0]} pixels in the data"
        raise refusal("image", file=file, found=found, allowed=IMAGES_ALLOWED, remedy="copy or record it again")
    return image


def read_image(path: Path, folder: Path | None = None) -> np.ndarray:
    """Read a PNG or JPEG as (height, width, 3) uint8 or uint16, blue, green, red; inside `folder` where given.

    The package writes PNG: its checksum detects every damaged byte, whereas damage of a JPEG appears only as wrong
    pixels.

    Raises:
        InputError: as `read_bytes` and `decode_image`.
    """
    return decode_image(read_bytes(path, IMAGE_BYTES_MAX, folder), escaped(Path(path).name))


def png_bytes(image: np.ndarray) -> bytes:
    """PNG of (height, width) or (height, width, 3) uint8 or uint16 pixels, blue, green, red."""
    import cv2
    import numpy as np

    if image.dtype not in (np.uint8, np.uint16):
        raise TypeError(f"pixels must be uint8 or uint16, not {image.dtype}")
    encoded, data = cv2.imencode(".png", image)
    if not encoded:
        raise ValueError(f"no PNG of shape {image.shape}")
    return data.tobytes()


def white_level(largest: int) -> int:
    """Full scale of the smallest usual converter whose range contains `largest`: 4095 for 3000."""
    return next((2**bits - 1 for bits in WHITE_BITS if largest < 2**bits), 2 ** WHITE_BITS[-1] - 1)


def in_grey_levels(image: np.ndarray, white: int | None = None) -> np.ndarray:
    """Pixels in grey levels of 8 bits (DN): uint8 unchanged, uint16 as float32 with `white` at 255, not rounded.

    Args:
        image: uint8 or uint16 of any shape.
        white: the camera's full scale; by default estimated from the picture.
    """
    import numpy as np

    if image.dtype == np.uint8:
        return image
    return image.astype(np.float32) * np.float32(255 / (white or white_level(int(image.max()))))


def small_picture(image: np.ndarray, centre_px: tuple[float, float] | None = None, width_px: int = WHOLE_PX) -> bytes:
    """JPEG of a picture for a page: all of it, at most `width_px` wide, or a window around a centre.

    The window has `WINDOW_PX` pixels a side, the pixel of the centre at WINDOW_PX / 2; black beyond the picture.

    Args:
        image: from `decode_image`.
        centre_px: (u, v) of a spot in it.
        width_px: largest width of a whole picture.

    Raises:
        ValueError: the centre lies outside the picture.
    """
    import cv2
    import numpy as np

    image = np.clip(in_grey_levels(image), 0, 255).astype(np.uint8)
    height, width = image.shape[:2]
    if centre_px is not None:
        half_px = WINDOW_PX // 2
        u, v = (round(value) for value in centre_px)
        if not (0 <= u < width and 0 <= v < height):
            raise ValueError(f"no pixel {u}, {v} in a picture of {width} x {height}")
        padded = np.pad(image, ((half_px, half_px), (half_px, half_px), (0, 0)))
        image = padded[v : v + WINDOW_PX, u : u + WINDOW_PX]
    elif width > width_px:
        image = cv2.resize(image, (width_px, max(1, round(height * width_px / width))), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
