"""Low-level readers and the atomic writer: text, TOML, JSON, CSV, regular files."""

from __future__ import annotations

import datetime
import errno
import os
import pickle
import stat
import tomllib
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from tvsbayes.errors import DeviceFault, InputError, NotConverged, NothingToEstimate, TvsError
from tvsbayes.files.csv_table import CSV_LINE_CHARS_MAX, csv_bytes, parse_table
from tvsbayes.files.disk import decode, read_bytes, shipped_data, write_atomically
from tvsbayes.files.documents import JSON_BYTES_MAX, TOML_BYTES_MAX, parse_json, parse_toml, toml_line
from tvsbayes.files.images import IMAGE_PIXELS_MAX, decode_image, image_size, png_bytes, read_image


def test_message_tells_place_found_allowed_and_remedy():
    table = parse_table(b"a,b\n1,2\n3,nan\n", "spots.csv", ("a", "b"))
    with pytest.raises(InputError) as caught:
        table.numbers("b", 0.0, 10.0)
    error = caught.value
    assert error.message == (
        'spots.csv line 3, b: found "nan"; allowed: a finite decimal number from 0 to 10; '
        "write a finite number; the pixels of a spot that was not seen are empty, its status says why"
    )
    assert (error.code, error.file, error.line, error.column) == ("number", "spots.csv", 3, "b")
    assert isinstance(error, TvsError) and error.exit_code == 2
    assert error.found and error.allowed and error.remedy and str(error) == error.message


@pytest.mark.parametrize("cell", ["0", "-0", "+1.5", ".5", "5.", "1e3", "1E-3", "-9.25e+2", "000012"])
def test_plain_numbers_are_accepted(cell):
    # The second table has an empty cell, which leaves the fast path: both paths must agree.
    fast = parse_table(f"x\n{cell}\n".encode(), "t.csv", ("x",)).numbers("x", -1e4, 1e4)
    slow = parse_table(f"x,y\n{cell},\n,\n".encode(), "t.csv", ("x", "y")).numbers("x", -1e4, 1e4, empty=True)
    assert fast == [float(cell)] and slow == [float(cell), None]


@pytest.mark.parametrize(
    "cell",
    [
        *("9_4.7", "infinity", "-inf", "nan", "NaN", "1e999", "0x10", "1e", "e5", ".", "--1", "1-2", "1 2"),
        *(
            " 1",
            "1 ",
            "=1+1",
            "@A1",
            "\u0661\u0662",
            "\uff11",
            '"9,4"',
            "1.2.3",
            "true",
            "\u22121",
            "1" * 5000,
        ),
    ],
)
@pytest.mark.parametrize("empty_elsewhere", [False, True])
def test_other_numbers_are_refused(cell, empty_elsewhere):
    table = parse_table(f"x,y\n1,\n{cell},\n".encode() + b",\n" * empty_elsewhere, "t.csv", ("x", "y"))
    for read in (table.numbers, table.integers):
        with pytest.raises(InputError) as caught:
            read("x", -1000, 1000, empty=empty_elsewhere)
        assert (caught.value.line, caught.value.column) == (3, "x")
        assert len(caught.value.message) < 400


def test_decimal_comma_is_taught():
    with pytest.raises(InputError, match="decimal point, not a comma"):
        parse_table(b'x\n"9,4"\n', "t.csv", ("x",)).numbers("x", 0.0, 10.0)
    with pytest.raises(InputError, match="a decimal comma splits a number in two"):
        parse_table(b"x,y\n9,4,1\n", "t.csv", ("x", "y"))
    with pytest.raises(InputError, match="commas between cells"):
        parse_table(b"x;y\n9,4;1\n", "t.csv", ("x", "y"))


@pytest.mark.parametrize("cell", ["1.0", "1e3", "9" * 19, "1_0", "", "+", "1001"])
def test_integers_are_strict(cell):
    with pytest.raises(InputError) as caught:
        parse_table(f"x,y\n{cell},\n".encode(), "t.csv", ("x", "y")).integers("x", 0, 1000)
    assert caught.value.line == 2


def test_bom_crlf_and_column_order_are_accepted():
    plain = parse_table(b"a,b\n1,2\n3,4\n", "t.csv", ("a", "b"))
    for data in (b"\xef\xbb\xbfb,a\r\n2,1\r\n4,3\r\n\r\n", b'"b","a"\n"2","1"\n4,3'):
        table = parse_table(data, "t.csv", ("a", "b"))
        assert table.columns["a"] == plain.columns["a"] == ("1", "3")
        assert table.lines == plain.lines == [2, 3]


@pytest.mark.parametrize(
    ("data", "line", "code"),
    [
        (b"", 1, "empty"),
        (b"\n1,2\n", 1, "empty"),
        (b"a\n1\n", 1, "missing-column"),
        (b"a,b,c\n", 1, "unknown-column"),
        (b"a,b,a\n", 1, "duplicate-column"),
        (b"a,b\n1,2\n3\n", 3, "row-length"),
        (b"a,b\n1,2,3\n", 2, "row-length"),
        (b"a,b\n1,2\n\n3,4\n", 3, "row-length"),
        (b'a,b\n1,"2\n', 2, "csv"),
        (b'a,b\n1,2\n"x\ny",2\n', 3, "csv"),
        (b'a,b\n"1"x,2\n', 2, "csv"),
        (b"a,b\n1,\x00\n", 2, "control-character"),
        (b"a,b\n1,\x1b[2J\n", 2, "control-character"),
        (b"a,b\n1,2\n1,\xe9\n", 3, "encoding"),
        ("a,b\n1,2\n".encode("utf-16"), None, "encoding"),
        (b"a,b\n1," + b"2" * CSV_LINE_CHARS_MAX + b"\n", 2, "size"),
    ],
)
def test_broken_tables_name_their_line(data, line, code):
    with pytest.raises(InputError) as caught:
        parse_table(data, "t.csv", ("a", "b"))
    assert (caught.value.code, caught.value.line, caught.value.file) == (code, line, "t.csv")


@pytest.mark.parametrize("cell", ["=1+1", "+x", "-x", "@x", "x" * 101, "a\u202eb", "a\x85b", "a\u2028b"])
def test_text_cells_refuse_formulas_and_invisible_characters(cell):
    with pytest.raises(InputError) as caught:
        parse_table(f"x\n{cell}\n".encode(), "t.csv", ("x",)).texts("x")
    assert caught.value.line == 2 and caught.value.message.isprintable()


def test_csv_round_trip_keeps_every_digit():
    values = [0.1 + 0.2, 1e-300, -1.7976931348623157e308, 5e-324]
    data = csv_bytes(("x", "t"), [(v, 'a "quoted", cell') for v in values])
    table = parse_table(data, "t.csv", ("x", "t"))
    assert table.numbers("x", -1.8e308, 1.8e308) == values
    assert table.texts("t") == ['a "quoted", cell'] * 4


TOML_REFUSED = {
    "syntax": (b"a = 1\nb = \n", 2, "toml"),
    "duplicate key": (b"a = 1\na = 2\n", 2, "toml"),
    "no date": (b"a = 2026-13-45\n", 1, "toml"),
    "huge integer": (b"a = " + b"1" * 5000 + b"\n", None, "toml"),
    "brackets": (b"a = " + b"[" * 10_000, 1, "nesting"),
    "dotted parts": (b"x = 1\n" + b".".join([b"a"] * 30_000) + b" = 1\n", 2, "nesting"),
    "spaced dotted parts": (b" . ".join([b"a"] * 9) + b" = 1\n", 1, "nesting"),
    "quoted dotted parts": (b".".join([b'"a"'] * 9) + b" = 1\n", 1, "nesting"),
    "dotted header": (b"[" + b".".join([b"a"] * 9) + b"]\n", 1, "nesting"),
    "size": (b"#" * (TOML_BYTES_MAX + 1), None, "size"),
    "latin-1": (b"# \n# caf\xe9\n", 2, "encoding"),
    "nul": (b"a = '\x00'\n", 1, "control-character"),
    "unclosed text": (b'a = """' + b'\\"""' * 15_000, None, "toml"),
    "bare carriage return": (b"a = 1\rb = 2\n", 1, "toml"),
}


@pytest.mark.parametrize("name", TOML_REFUSED)
def test_hostile_toml(name):
    data, line, code = TOML_REFUSED[name]
    with pytest.raises(InputError) as caught:
        parse_toml(data, "t.toml")
    assert caught.value.code == code
    if line is not None:
        assert caught.value.line == line


def test_toml_dots_in_text_and_comments_are_no_keys():
    keys = parse_toml(b'\xef\xbb\xbfa = "1.2.3.4.5.6.7.8.9.10" # 1.2.3.4.5.6.7.8.9.10\r\nb = [0.1, 0.2, 0.3]\n', "t")
    assert keys.values == {"a": "1.2.3.4.5.6.7.8.9.10", "b": [0.1, 0.2, 0.3]}


@pytest.mark.parametrize("literal", ["nan", "inf", "-inf", "1e999", "true", '"1"', "[1]", "11", "0xffff"])
def test_toml_numbers_are_finite_and_in_range(literal):
    keys = parse_toml(f"# a\n[table]\nother = 1\na = {literal}\n".encode(), "t.toml").table("table")
    with pytest.raises(InputError) as caught:
        keys.number("a", 0.0, 10.0)
    assert (caught.value.line, caught.value.column) == (4, "table.a")


JSON_REFUSED = {
    "nan": (b'{\n"a": NaN}', 2, "number"),
    "infinity": (b'{"a": -Infinity}', 1, "number"),
    "1e999": (b'{"a": 1,\n "b":\n 1e999}', 3, "number"),
    "long integer": (b'{"a": ' + b"1" * 19 + b"}", 1, "number"),
    "huge integer": (b'{"a": ' + b"1" * 5000 + b"}", 1, "number"),
    "duplicate": (b'{"a": 1,\n"a": 2}', 2, "duplicate-key"),
    "nested duplicate": (b'{"b": {"a": 1,\n"a": 2}}', 2, "duplicate-key"),
    "brackets": (b'{"a":\n' + b"[" * 100_000, 2, "nesting"),
    "braces": (b'{"a":' * 100_000, 1, "nesting"),
    "syntax": (b'{"a": 1\n "b": 2}', 2, "json"),
    "array": (b"[1, 2]", 1, "json"),
    "empty": (b"", 1, "json"),
    "latin-1": (b'{"a":\n "\xe9"}', 2, "encoding"),
    "size": (b" " * (JSON_BYTES_MAX + 1), None, "size"),
    "trailing": (b'{"a": 1} {"a": 2}', 1, "json"),
}


@pytest.mark.parametrize("name", JSON_REFUSED)
def test_hostile_json(name):
    data, line, code = JSON_REFUSED[name]
    with pytest.raises(InputError) as caught:
        parse_json(data, "t.json")
    assert (caught.value.code, caught.value.line) == (code, line)


def test_json_brackets_in_text_do_not_nest():
    text = "[" * 1000 + '\\"' + "{" * 1000
    assert parse_json(b'{"a": "' + text.encode() + b'"}', "t").values == {"a": "[" * 1000 + '"' + "{" * 1000}


def test_toml_writer_round_trips():
    values = {
        "text": 'quotes " \\ and \u00e9 \U0001d517\nline',
        "number": 1e-05,
        "big": 1e16,
        "integer": 7,
        "flag": True,
        "when": datetime.datetime(2026, 1, 15, 10, 0, tzinfo=datetime.UTC),
        "day": datetime.date(2026, 1, 15),
        "dotted.name": {"value": 0.06, "u": 0.0},
    }
    assert tomllib.loads("\n".join(toml_line(k, v) for k, v in values.items())) == values


def test_only_regular_files_inside_the_folder(tmp_path):
    folder = tmp_path / "campaign"
    folder.mkdir()
    (tmp_path / "outside.csv").write_text("x")
    (folder / "inside.csv").write_text("x")
    (folder / "good.csv").symlink_to(folder / "inside.csv")
    (folder / "bad.csv").symlink_to(tmp_path / "outside.csv")
    (folder / "loop.csv").symlink_to(folder / "loop.csv")
    (folder / "gone.csv").symlink_to(folder / "nothing.csv")
    (folder / "device.csv").symlink_to("/dev/zero")
    os.mkfifo(folder / "pipe.csv")
    assert read_bytes(folder / "good.csv", 10, folder) == b"x"
    codes = {}
    for name in ("bad", "loop", "gone", "device", "pipe", "missing", "nul\0"):
        with pytest.raises(InputError) as caught:
            read_bytes(folder / f"{name}.csv", 10, folder)
        codes[name] = caught.value.code
    with pytest.raises(InputError, match="regular file"):
        read_bytes(folder, 10)
    assert codes == {
        "bad": "path",
        "loop": "unreadable",
        "gone": "missing-file",
        "device": "path",
        "pipe": "not-a-file",
        "missing": "missing-file",
        "nul\0": "unreadable",
    }


def test_size_is_capped_before_reading(tmp_path):
    path = tmp_path / "sparse.csv"
    with open(path, "wb") as stream:
        stream.truncate(10**12)  # a terabyte of holes: reading it would not end
    with pytest.raises(InputError, match="1000000000000 bytes"):
        read_bytes(path, 1000)


def test_control_characters_never_reach_the_message(tmp_path):
    with pytest.raises(InputError) as caught:
        read_bytes(tmp_path / "a\x1b[31m\u202e.csv", 10)
    assert caught.value.message.isprintable()
    with pytest.raises(InputError) as caught:
        decode(b"a\n\x07", "t.csv")
    assert caught.value.message.isprintable() and caught.value.line == 2


@pytest.mark.parametrize("broken", ["fsync", "replace"])
@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_interrupted_write_leaves_the_old_file_whole(tmp_path, monkeypatch, broken, failure):
    path = tmp_path / "spots.csv"
    path.write_bytes(b"old")

    def fail(*_args):
        raise failure

    monkeypatch.setattr(os, broken, fail)
    with pytest.raises(InputError if isinstance(failure, OSError) else KeyboardInterrupt):
        write_atomically(path, b"new content")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["spots.csv"]


@pytest.mark.skipif(os.name != "posix", reason="only POSIX flushes folders")
@pytest.mark.parametrize(("number", "fails"), [(errno.EINVAL, False), (errno.ENOTSUP, False), (errno.EIO, True)])
def test_a_folder_that_cannot_be_flushed(tmp_path, monkeypatch, number, fails):
    """Some network shares flush files only; a disk that fails is another matter."""
    flush = os.fsync

    def files_only(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", files_only)
    with pytest.raises(InputError) if fails else nullcontext():
        write_atomically(tmp_path / "a.json", b"1")
    assert (tmp_path / "a.json").read_bytes() == b"1"


def test_atomic_write_replaces_and_obeys_the_umask(tmp_path):
    path = tmp_path / "a.json"
    write_atomically(path, b"1")
    write_atomically(path, b"2")
    (tmp_path / "plain").write_bytes(b"")
    assert path.read_bytes() == b"2"
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)
    with pytest.raises(InputError, match="writable folder"):
        write_atomically(tmp_path / "no such folder" / "a.json", b"1")


def test_shipped_data_lies_beside_a_checkout_or_inside_a_wheel():
    data = shipped_data()
    package = Path(__file__).resolve().parents[2] / "tvsbayes"
    assert data.name == "data" and data.parent.name in ("tvsbayes", package.parent.name)


def picture(channels: int = 3) -> np.ndarray:
    """A seeded frame of 40 x 30 pixels without symmetry."""
    pixels = np.random.default_rng(5).integers(0, 256, (30, 40, channels), dtype=np.uint8)
    return pixels if channels > 1 else pixels[..., 0]


def refused(data: bytes) -> InputError:
    with pytest.raises(InputError) as caught:
        decode_image(data, "000001_left.png")
    assert caught.value.file == "000001_left.png" and caught.value.remedy
    return caught.value


def test_a_png_comes_back_to_the_bit(tmp_path):
    pixels = picture()
    (tmp_path / "a.png").write_bytes(png_bytes(pixels))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png", tmp_path), pixels)
    grey = picture(1)
    (tmp_path / "b.png").write_bytes(png_bytes(grey))
    np.testing.assert_array_equal(read_image(tmp_path / "b.png"), np.repeat(grey[..., None], 3, axis=2))


def test_a_jpeg_is_read_without_its_orientation_tag():
    """A camera held upright tags its pictures; pixel coordinates belong to the sensor."""
    import cv2

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
def test_other_formats_are_refused_whatever_they_are_called(data):
    assert refused(data).code == "image"


def test_jpegs_of_unusual_kinds_are_refused():
    import cv2

    data = cv2.imencode(".jpg", picture())[1].tobytes()
    frame = data.index(b"\xff\xc0")
    for kind in (0xC3, 0xC9, 0xCF):
        refused(data[: frame + 1] + bytes([kind]) + data[frame + 2 :])
    deep = bytearray(data)
    deep[frame + 4] = 12
    assert "12 bits" in refused(bytes(deep)).message
    for length in range(0, frame + 9):
        refused(data[:length])


def test_deep_pngs_and_links_out_of_the_folder_are_refused(tmp_path):
    import cv2

    deep = cv2.imencode(".png", picture().astype(np.uint16))[1].tobytes()
    assert "16 bits" in refused(deep).message
    (tmp_path / "in").mkdir()
    (tmp_path / "a.png").write_bytes(png_bytes(picture()))
    (tmp_path / "in" / "a.png").symlink_to(tmp_path / "a.png")
    with pytest.raises(InputError) as caught:
        read_image(tmp_path / "in" / "a.png", tmp_path / "in")
    assert caught.value.code == "path"


@pytest.mark.parametrize("kind", [TvsError, InputError, NothingToEstimate, NotConverged, DeviceFault])
def test_errors_pass_between_processes_whole(kind):
    """A pool that cannot unpickle its worker's error waits for ever."""
    told = kind("code", "what was found", file="a.csv", line=3, column="u_px", found="x", allowed="y", remedy="z")
    again = pickle.loads(pickle.dumps(told))
    assert type(again) is kind and again.args == told.args and vars(again) == vars(told)
