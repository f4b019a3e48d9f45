"""Campaign folders from strangers: a good one, one crafted folder per threat, and seeded random mutations.

The names say which threat a folder stands for. Used by
`promises/test_hostile.py` and, with more of everything, by `experiments/robustness/hostile.py`. No JAX, no OpenCV.
"""

from __future__ import annotations

import io
import json
import os
import re
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from support.small_campaign import seen_steps, small_campaign

from tvsbayes.acquisition.journal import Journal, encode, read_journal
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.assessment.fitted_calibration import calibration_of_draws
from tvsbayes.calibration.calibration_file import calibration_bytes, read_draws
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.cameras.calibration_formats import read_calibration
from tvsbayes.errors import TvsError
from tvsbayes.files.disk import shipped_data
from tvsbayes.files.documents import parse_toml
from tvsbayes.files.images import image_size
from tvsbayes.instrument.campaign import (
    input_hashes,
    parse_header,
    parse_moves,
    parse_spots,
    read_campaign,
    write_campaign,
)
from tvsbayes.instrument.parameters import RIG_PRIORS
from tvsbayes.instrument.plan import parse_plan
from tvsbayes.instrument.rig import parse_rig_table, read_rig
from tvsbayes.instrument.stereo_pair import parse_stereo
from tvsbayes.results.comparison_record import COMPARISON_FORMAT
from tvsbayes.results.fit_record import read_fit

MEGABYTE = 1_000_000
SIZE = 1280, 720
PAYLOADS = (
    "</script><script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "<svg/onload=alert(1)>",
    "<a href=javascript:alert(1)>x</a>",
    "<!-- <iframe src=//x>",
    "{{ 7*7 }}{% include 'x' %}",
    "]]>&#60;script&#62;",
)


def png(width: int, height: int, depth: int = 8, colour: int = 0, raw: bytes | None = None) -> bytes:
    """A grey PNG of zeros, or one whose pixel data are `raw`, made without a decoder's library."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    if raw is None:
        packer = zlib.compressobj(9)
        rows = bytes(1 + width) * 64
        raw = b"".join(packer.compress(rows) for _ in range(height // 64))
        raw += packer.compress(bytes(1 + width) * (height % 64)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", raw) + chunk(b"IEND", b"")


OPENCV = """%YAML:1.0
---
image_width: 1280
image_height: 720
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 802., 0., 645., 0., 801., 355., 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.32, 0.11, 0.0004, -0.0006, -0.015 ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 798., 0., 633., 0., 799., 362., 0., 0., 1. ]
D2: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.31, 0.1, -0.0003, 0.0005, -0.012 ]
R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ -85.2, 0.3, -0.4 ]
"""


def drawn_calibration(campaign) -> Calibration:
    """Normal draws about the default rig, 1 % of every parameter: small enough for all draws to meet."""
    generator = np.random.default_rng(8)
    names, columns = tuple(dict.fromkeys((*INPUT_NAMES, *NOISE_NAMES))), []
    for name in names:
        value = RIG_PRIORS[name].value
        columns.append(value + 0.01 * abs(value) * generator.standard_normal(600))
    calibration = calibration_of_draws(names, np.stack(columns, axis=1), campaign, "posterior", 0, seen_steps(campaign))
    parts = np.stack([0.25 * calibration.covariance, 0.75 * calibration.covariance])
    return replace(calibration, causes=("pixel noise", "stereo calibration"), cause_covariance=parts)


def write_journal(folder: Path) -> None:
    """A journal of one homing, two moves and two looks with their pictures, as `acquire` writes it."""
    journal = Journal.create(folder, name="journal")
    journal.append("start", utc="2026-01-01T00:00:00+00:00")
    head = {"time_s": 0.0, "pan_steps": 0, "tilt_steps": 0}
    journal.append("homed", step=0, boot=1, approach=["left", "up"], **head)
    for look in range(2):
        journal.append("moved", step=2 * look + 1, time_s=1.5 + look, pan_steps=10 * look, tilt_steps=5)
        frames = [journal.store(f"frames/{look:06d}_{side}.png", png(*SIZE)).as_json() for side in ("left", "right")]
        spot = {"spot": look, "target": "d1", "experiment": None, "point": None, "status": "ok", "frames": frames}
        spot |= {"pixels_px": [640.5, 360.25, 512.0, 355.75], "sds_px": [0.08, 0.09, 0.1, 0.11]}
        journal.append("looked", step=2 * look + 2, **spot)
    journal.append("verified", segment=0, deviation_steps=[0, 1])
    journal.append("stop", reason="done")
    journal.close()


def good_folder(place: Path) -> Path:
    """A campaign with everything that a command reads: results, frames, boards, a rig, a plan, a journal of its own."""
    campaign = small_campaign()
    write_campaign(campaign, place)
    write_campaign(campaign, place / "journal")
    for name in ("results", "frames", "boards"):
        (place / name).mkdir()
    hashes = input_hashes(read_campaign(place))
    document = json.loads((Path(__file__).parents[1] / "data" / "fit-1-laplace.json").read_text()) | {"inputs": hashes}
    # Reports need these; documents of the first version lack them.
    document |= {"residuals": [], "residual_causes": [], "gap": None, "budgets": [], "positioning": []}
    (place / "results" / "fit.json").write_text(json.dumps(document, indent=1))
    ratios = np.tile([0.06, 0.06, 0.07, 0.07], (600, 1))
    arrays = {"effective_deg_per_step": ratios}
    draws = calibration_bytes(drawn_calibration(read_campaign(place)), **arrays)
    (place / "results" / "draws.npz").write_bytes(draws)
    score = {"rms_deg": 0.1, "rms_block_deg": 0.05, "coverage": 0.95, "log_density": 1.0}
    held = {"by": "steps", "predictions": [], "classic": score, "joint": score, "ratio": 1.0, "interval95": None}
    held |= {"verdict": "joint", "reason": "smaller errors", "unseen": {"left": 1e-4}}
    compared = {"format": COMPARISON_FORMAT, "inputs": hashes, "held_out": held}
    (place / "results" / "compare.json").write_text(json.dumps(compared, indent=1))
    for spot in campaign.spots[:2]:
        for side in ("left", "right"):
            (place / "frames" / f"{spot.spot:06d}_{side}.png").write_bytes(png(*SIZE))
    for side in ("left", "right"):
        (place / "boards" / f"{side}01.png").write_bytes(png(320, 240))
    mounted = shipped_data() / "rigs" / "mounted"
    (place / "rig.toml").write_bytes((mounted / "rig.toml").read_bytes())
    (place / "plan.csv").write_bytes((mounted / "mixed.csv").read_bytes())
    (place / "camera.yml").write_text(OPENCV)
    write_journal(place / "journal")
    return place


Edit = Callable[[Path], object]


@dataclass(frozen=True)
class Crafted:
    """A hostile folder.

    Attributes:
        threat: line of the threat list.
        edit: makes a good folder hostile; its parent may be used for what lies outside.
        commands: what is run, `@` standing for the folder.
        codes: exit codes that are right for the commands, all of them.
        large: takes seconds or much disk: for the experiment only.
    """

    threat: str
    edit: Edit
    commands: tuple[str, ...]
    codes: frozenset[int] = frozenset({2})
    large: bool = False


def swapped(file: str, old: str, new: str) -> Edit:
    """Replaces the first `old`, which must be there."""

    def edit(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text, (file, old)
        (folder / file).write_text(text.replace(old, new, 1))

    return edit


def written(file: str, data: bytes | str | Callable[[], bytes]) -> Edit:
    """Replaces a file."""

    def edit(folder: Path) -> None:
        content = data() if callable(data) else data
        (folder / file).write_bytes(content.encode() if isinstance(content, str) else content)

    return edit


def linked(file: str, to: str) -> Edit:
    """Puts a link in a file's place; a relative target is made beside the folder first."""

    def edit(folder: Path) -> None:
        path, target = folder / file, Path(to)
        if not target.is_absolute():
            target = folder.parent / to
            if path.is_dir():
                target.mkdir(exist_ok=True)
            else:
                target.write_bytes(path.read_bytes())
        if path.is_dir():
            for inner in path.iterdir():
                inner.rename(target / inner.name)
            path.rmdir()
        else:
            path.unlink()
        path.symlink_to(target)

    return edit


def piped(file: str) -> Edit:
    """A named pipe in a file's place."""

    def edit(folder: Path) -> None:
        (folder / file).unlink(missing_ok=True)
        os.mkfifo(folder / file)

    return edit


def both(*edits: Edit) -> Edit:
    """One after the other."""

    def edit(folder: Path) -> None:
        for each in edits:
            each(folder)

    return edit


def npy(descr: str, shape: tuple[int, ...], body: bytes = b"") -> bytes:
    """An .npy with an arbitrary header."""
    header = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body


FORMAT_NPY = npy("<U22", (), "tvsbayes-calibration/1".encode("utf-32-le"))


def archive(members: dict[str, bytes], packing: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip file of `.npy` members."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", packing) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return buffer.getvalue()


def lying_bzip2(megabytes: int) -> bytes:
    """A bzip2 member that states 1000 bytes and unpacks to megabytes."""
    import bz2

    packed, name = bz2.compress(bytes(megabytes * MEGABYTE)), b"format.npy"
    local = (
        struct.pack("<4sHHHHHIIIHH", b"PK\3\4", 46, 0, 12, 0, 33, 0, len(packed), 1000, len(name), 0) + name + packed
    )
    sizes = (0, len(packed), 1000, len(name), 0, 0, 0, 0, 0, 0)
    central = struct.pack("<4sHHHHHHIIIHHHHHII", b"PK\1\2", 46, 46, 0, 12, 0, 33, *sizes) + name
    return local + central + struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 1, 1, len(central), len(local), 0)


def draws_with(**changes: object) -> Edit:
    """A `draws.npz` of the right hashes with some arrays of its own."""

    def edit(folder: Path) -> None:
        path = folder / "results" / "draws.npz"
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **{**arrays, **changes})
        path.write_bytes(buffer.getvalue())

    return edit


class Touch:
    """Unpickled, it runs a command."""

    def __reduce__(self):
        return os.system, ("touch pwned",)


def pickled() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, format=np.array([Touch()], dtype=object))
    return buffer.getvalue()


def fit_with(key: str, value: object) -> Edit:
    """A `fit.json` with one value of its own; the key's parts are split at "/"."""

    def edit(folder: Path) -> None:
        path = folder / "results" / "fit.json"
        document = json.loads(path.read_text())
        *way, last = key.split("/")
        inner = document
        for part in way:
            inner = inner[part]
        inner[last] = value
        path.write_text(json.dumps(document))

    return edit


def log_of(lines: int, **data: object) -> Callable[[], bytes]:
    """A whole, chained log of many equal events."""

    def make() -> bytes:
        content, crc = [], 0
        for number in range(lines):
            event = {"format": "tvsbayes-log/1"} if number == 0 else data
            content.append(encode(number, crc, "created" if number == 0 else "intent", event))
            crc = int(content[-1][:8], 16)
        return b"".join(content)

    return make


def same_frame_again(folder: Path) -> None:
    """Thousands of events that name one large, sparse picture."""
    with open(folder / "journal" / "frames" / "000000_left.png", "wb") as file:
        file.truncate(100 * MEGABYTE)
    import hashlib

    digest = hashlib.sha256(bytes(100 * MEGABYTE)).hexdigest()
    entry = {"name": "frames/000000_left.png", "sha256": digest, "bytes": 100 * MEGABYTE}
    (folder / "journal" / "log.jsonl").write_bytes(log_of(2000, frames=[entry] * 50)())


def injected(folder: Path) -> None:
    """Payloads in every text that a report shows."""
    notes = json.dumps("".join(PAYLOADS))
    path = folder / "campaign.toml"
    lines = path.read_text().split("\n")
    kept = [line for line in lines if not line.startswith(("name", "notes"))]
    kept[1:1] = [f"name = {json.dumps(PAYLOADS[1])}", f"operator = {json.dumps(PAYLOADS[0])}", f"notes = {notes}"]
    path.write_text("\n".join(kept))
    for key, value in (
        ("command", PAYLOADS[0]),
        ("problems", list(PAYLOADS)),
        ("prior_conflicts", list(PAYLOADS)),
        ("versions", {"python": PAYLOADS[2], "tvsbayes": PAYLOADS[3], "jax": PAYLOADS[4]}),
    ):
        fit_with(key, value)(folder)
    draws_with(estimator=np.array(PAYLOADS[0]))(folder)


def many_spots(rows: int, wide: bool = False) -> Edit:
    """A whole spots.csv of many rows, every cell its own text; a wide character makes the text four times as large."""

    def edit(folder: Path) -> None:
        path = folder / "spots.csv"
        header = path.read_text().split("\n")[0].split(",")
        fixed = {"status": "ok", "experiment": "", "point": "", "aperture_deg": "50.125", "move": "1"}
        with path.open("w") as file:
            file.write(",".join(header) + "\n")
            for row in range(rows):
                target = "\U0001f600" if wide and row == 0 else f"t{row}"
                cells = {**fixed, "spot": str(row), "target": target + "x" * (90 if wide else 0)}
                values = (cells.get(c, f"{100 + 1e-4 * row:.13f}" if c[1] == "_" else f"0.1{row}") for c in header)
                file.write(",".join(values) + "\n")

    return edit


LOCATE = "locate @ --pan-steps 100 --tilt-steps 20 --aperture-deg 70"
IMPORT = "stereo --import @/camera.yml --image-size 1280x720"
BOARDS = "stereo @/boards --board 9x6 --pitch-mm 20"
READ, ESTIMATE = ("check @",), ("classic @",)
CRAFTED: dict[str, Crafted] = {
    "png of 900 million pixels": Crafted(
        "decompression bomb", written("frames/000010_left.png", lambda: png(30000, 30000)), ("detect @",), large=True
    ),
    "png that states 900 million pixels": Crafted(
        "decompression bomb", written("frames/000010_left.png", lambda: png(30000, 30000, raw=b"")), ("detect @",)
    ),
    "png of 49 million pixels, as stereo.json says": Crafted(
        "decompression bomb",
        both(
            swapped("stereo.json", '"image_width": 1280', '"image_width": 7000'),
            swapped("stereo.json", '"image_height": 720', '"image_height": 7000'),
            *(written(f"frames/{n:06d}_{s}.png", lambda: png(7000, 7000)) for n in (10, 12) for s in ("left", "right")),
        ),
        ("detect @",),
        frozenset({0, 2, 3}),
        large=True,
    ),
    "board of 900 million pixels": Crafted(
        "decompression bomb", written("boards/left01.png", lambda: png(30000, 30000, raw=b"")), (BOARDS,)
    ),
    "board of 49 million pixels": Crafted(
        "decompression bomb",
        both(*(written(f"boards/{s}01.png", lambda: png(7000, 7000)) for s in ("left", "right"))),
        (BOARDS,),
        large=True,
    ),
    "boards of 20 million pixels": Crafted(
        "decompression bomb",
        both(*(written(f"boards/{s}01.png", lambda: png(5000, 4000)) for s in ("left", "right"))),
        (BOARDS,),
        frozenset({3}),
        large=True,
    ),
    "gif named png": Crafted(
        "decoder chosen by content",
        written("frames/000010_left.png", b"GIF89a" + bytes(100)),
        ("detect @",),
    ),
    "tiff among the boards": Crafted(
        "decoder chosen by content", written("boards/left01.png", b"II*\0" + bytes(100)), (BOARDS,)
    ),
    "png of 16 bits": Crafted(
        "decoder chosen by content", written("frames/000010_left.png", lambda: png(*SIZE, depth=16)), ("detect @",)
    ),
    "png cut short": Crafted(
        "decoder chosen by content", written("frames/000010_left.png", lambda: png(*SIZE)[:-30]), ("detect @",)
    ),
    "opencv matrix of 80 GB": Crafted(
        "OpenCV FileStorage", swapped("camera.yml", "rows: 3\n   cols: 3", "rows: 100000\n   cols: 100000"), (IMPORT,)
    ),
    "opencv empty key": Crafted("OpenCV FileStorage", swapped("camera.yml", "M1:", ":"), (IMPORT,)),
    "opencv rows that are no number": Crafted(
        "OpenCV FileStorage", swapped("camera.yml", "rows: 3", "rows: [3]"), (IMPORT,)
    ),
    "yaml python tag": Crafted(
        "YAML", written("camera.yml", '!!python/object/apply:os.system ["touch pwned"]\n'), (IMPORT,)
    ),
    "yaml billion laughs": Crafted(
        "YAML",
        written("camera.yml", "a0: &a0 [x,x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1},*a{k - 1}]\n" for k in range(1, 9))),
        (IMPORT,),
    ),
    "yaml of a million brackets": Crafted("YAML", written("camera.yml", "a: " + "[" * 1_000_000), (IMPORT,)),
    "pickle in draws.npz": Crafted("pickle, npz, npy", written("results/draws.npz", pickled), (LOCATE, "report @")),
    "npy header of 800 GB": Crafted(
        "pickle, npz, npy",
        written("results/draws.npz", lambda: archive({"format": npy("<f8", (10**11,))})),
        (LOCATE,),
    ),
    "npz of entries without width": Crafted(
        "pickle, npz, npy",
        written("results/draws.npz", lambda: archive({"format": FORMAT_NPY, "input_names": npy("<U0", (3 * 10**7,))})),
        (LOCATE,),
    ),
    "npz that unpacks to 1 GB": Crafted(
        "pickle, npz, npy",
        written("results/draws.npz", lambda: archive({"format": npy("<f8", (125 * 10**6,), bytes(10**9))})),
        (LOCATE,),
        large=True,
    ),
    "npz of bzip2 that lies about its size": Crafted(
        "pickle, npz, npy", written("results/draws.npz", lambda: lying_bzip2(30)), (LOCATE,)
    ),
    "npz with an escape in the estimator": Crafted(
        "pickle, npz, npy", draws_with(estimator=np.array("\x1b[2Jlaplace")), (LOCATE,)
    ),
    "posterior.nc and hdf5 that nobody reads": Crafted(
        "HDF5, NetCDF", written("results/posterior.nc", b"\x89HDF\r\n\x1a\n" + bytes(100)), READ, frozenset({0, 3})
    ),
    "spots.csv links outside": Crafted("path traversal", linked("spots.csv", "outside.csv"), ESTIMATE),
    "spots.csv links to a device": Crafted("path traversal", linked("spots.csv", "/dev/zero"), READ),
    "frame links outside": Crafted("path traversal", linked("frames/000010_left.png", "outside.png"), ("detect @",)),
    "frames folder links outside": Crafted("path traversal", linked("frames", "elsewhere"), ("detect @",)),
    "results folder links outside": Crafted(
        "path traversal", linked("results", "elsewhere"), ("detect @ --overlay", "fit @ --no-sample", "report @")
    ),
    "moves.csv is a pipe": Crafted("path traversal", piped("moves.csv"), ESTIMATE),
    "log.jsonl is a pipe": Crafted("path traversal", piped("log.jsonl"), ("check @",)),
    "frame is a pipe": Crafted("path traversal", piped("frames/000010_left.png"), ("detect @",)),
    "draws.npz is a pipe": Crafted("path traversal", piped("results/draws.npz"), (LOCATE,)),
    "frames in capitals": Crafted(
        "path traversal",
        lambda folder: [p.rename(p.with_name(p.name.upper())) for p in (folder / "frames").iterdir()],
        ("detect @",),
        frozenset({3}),
    ),
    "toml key of 20 000 parts": Crafted("TOML", written("campaign.toml", "a." * 20_000 + "a = 1\n"), READ),
    "toml of brackets": Crafted("TOML", written("campaign.toml", "a = " + "[" * 10_000), READ),
    "toml with nan in the rig": Crafted(
        "TOML", swapped("campaign.toml", "value = 200.0", "value = nan"), (*READ, "fit @ --no-sample")
    ),
    "rig file of brackets": Crafted(
        "TOML", written("rig.toml", "a = " + "{b = " * 10_000), ("check @/rig.toml", "plan @/rig.toml --given @")
    ),
    "rig file whose port writes a file": Crafted(
        "TOML",
        lambda folder: (folder / "rig.toml").write_text(
            (folder / "rig.toml").read_text()
            + '\n[positioner]\ndriver = "teensy"\nport = "spy:///dev/ptmx?file=spied.txt"\n'
        ),
        ("check @/rig.toml", "doctor @/rig.toml"),
    ),
    "json with NaN": Crafted("JSON", swapped("stereo.json", "802.0", "NaN"), ESTIMATE),
    "json with 1e999": Crafted("JSON", swapped("stereo.json", "802.0", "1e999"), READ),
    "json key twice": Crafted("JSON", swapped("stereo.json", '"rms_px"', '"T"'), READ),
    "json of 100 000 brackets": Crafted("JSON", written("stereo.json", "[" * 100_000), READ),
    "json integer of 5000 digits": Crafted("JSON", swapped("stereo.json", "1280", "1" * 5000), READ),
    "csv field of 131 073 characters": Crafted("CSV, float()", swapped("spots.csv", "d1", "x" * 131_073), READ),
    "csv with NUL": Crafted("CSV, float()", swapped("spots.csv", "d1", "d\0"), READ),
    "csv with 1_000": Crafted("CSV, float()", swapped("moves.csv", "1.5", "1_5"), ESTIMATE),
    "csv with arabic digits": Crafted("CSV, float()", swapped("moves.csv", "1.5", "\u0661"), READ),
    "csv with a formula": Crafted("CSV, float()", swapped("spots.csv", "d1", "=cmd|' /C calc'!A0"), READ),
    "plan of unknown actions": Crafted("CSV, float()", swapped("plan.csv", "home", "rm -rf"), ("check @/plan.csv",)),
    "markup in every text": Crafted("HTML report", injected, ("check @", "report @ --dcc"), frozenset({0})),
    "line separators in a text of fit.json": Crafted(
        "HTML report", fit_with("problems", ["\u2028\u2029"]), ("report @",), frozenset({2})
    ),
    "markup in compare.json": Crafted(
        "HTML report",
        swapped("results/compare.json", '"verdict": "joint"', f'"verdict": {json.dumps(PAYLOADS[0])}'),
        ("report @",),
        frozenset({0}),
    ),
    "table of 200 001 spots": Crafted("resource", many_spots(200_001), ("check @",), large=True),
    "table of 200 000 spots": Crafted(
        "resource", many_spots(200_000, wide=True), ("check @",), frozenset({0, 2}), True
    ),
    "log of a million lines": Crafted(
        "resource", written("journal/log.jsonl", log_of(1_000_000)), ("check @/journal",), large=True
    ),
    "log of 100 000 lines": Crafted(
        "resource",
        written("journal/log.jsonl", log_of(100_000, a=[[]] * 20)),
        ("check @/journal",),
        frozenset({0}),
        True,
    ),
    "log of millions of entries": Crafted(
        "resource", written("journal/log.jsonl", log_of(3000, a=[[]] * 5000)), ("check @/journal",), large=True
    ),
    "log that names one frame 100 000 times": Crafted("resource", same_frame_again, ("check @/journal",), large=True),
    "rig of 10 000 parameters": Crafted(
        "resource",
        written("campaign.toml", "[rig.prior]\n" + "".join(f"a{k}=1\n" for k in range(8000))),
        READ,
    ),
    "folder of 20 000 frames": Crafted(
        "resource",
        lambda folder: [(folder / "frames" / f"{k:06d}_left.png").touch() for k in range(20_000)],
        ("check @", "detect @"),
        frozenset({0, 2}),
        True,
    ),
    "boards by the thousand": Crafted(
        "resource", lambda folder: [(folder / "boards" / f"left{k}.png").touch() for k in range(2000)], (BOARDS,)
    ),
    "fit.json of other data": Crafted(
        "stale cache of results", fit_with("inputs/spots", "0" * 64), ("report @",), frozenset({3, 4})
    ),
    "draws.npz of other data": Crafted(
        "stale cache of results", swapped("moves.csv", "1.5", "1.25"), (LOCATE,), frozenset({3, 4})
    ),
    "compare.json of other data": Crafted(
        "stale cache of results",
        both(swapped("results/compare.json", '"moves": "', '"moves": "f'), fit_with("command", "x")),
        ("report @",),
        frozenset({0}),
    ),
    "fit.json with a list for a table": Crafted(
        "stale cache of results", fit_with("parameters/backlash_deg.pan", []), ("report @",)
    ),
    "fit.json with another covariance": Crafted(
        "stale cache of results", fit_with("covariance/matrix", [[1.0]]), ("report @",)
    ),
    "chain.npz of zero length": Crafted(
        "emcee file of zero length",
        written("results/chain.npz", b""),
        ("fit @ --resume --max-minutes 0.01",),
        frozenset({2, 3, 4}),
    ),
    "a link and a bomb": Crafted(
        "pairs",
        both(linked("results", "elsewhere"), written("results/draws.npz", lambda: lying_bzip2(30))),
        (LOCATE, "report @"),
    ),
    "nan and deep brackets": Crafted(
        "pairs",
        both(swapped("campaign.toml", "value = 200.0", "value = inf"), written("stereo.json", "[" * 100_000)),
        READ,
    ),
    "markup and other data": Crafted(
        "pairs", both(injected, swapped("moves.csv", "1.5", "1.25")), ("check @", LOCATE), frozenset({0, 3, 4})
    ),
    "escape in the name of the folder's file and a pipe": Crafted(
        "pairs", both(written("\x1b[31m.csv", b""), piped("stereo.json")), READ
    ),
}


TOKENS = (
    *(b"nan", b"-inf", b"1e999", b"9_4.7", b"", b",", b"\n", b'"', b"'", b"[", b"{", b"]", b"}", b".", b"\r"),
    *(b"\0", b"\xff", b"\xe2\x80\xae", b"\xef\xbb\xbf", "\u0661\u0662".encode(), "\U0001f600".encode(), b"\x1b[2J"),
    *(b"=1+1", b"-1", b"0", b"1" * 5000, b"null", b"true", b"#", b"\\", b"\\u0000", b"[[", b'"""', b":", b"="),
    *(b"1e-400", b"1e308", b"-1e308", b"9223372036854775808", b"0x1F", b"1979-05-27", b"<script>", b"&*!|>", b"../"),
)
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:e-?\d+)?")


def mutate(data: bytes, rng: np.random.Generator, others: list[bytes]) -> bytes:
    """One to three random changes: bits, bytes, cuts, repetitions, lines, tokens, numbers, ends, whole files."""
    for _ in range(rng.integers(1, 4)):
        at, length = int(rng.integers(0, len(data) + 1)), int(rng.integers(0, 12))
        kind = rng.integers(0, 10)
        if kind == 0:
            data = data[:at] + bytes([rng.integers(0, 256)]) + data[at + 1 :]
        elif kind == 1 and at < len(data):
            data = data[:at] + bytes([data[at] ^ (1 << int(rng.integers(0, 8)))]) + data[at + 1 :]
        elif kind == 2:
            data = data[:at] + data[at + length :]
        elif kind == 3:
            data = data[:at] + data[at : at + 40] * 2 + data[at:]
        elif kind == 4:
            data = data[:at] + TOKENS[rng.integers(0, len(TOKENS))] + data[at + length :]
        elif kind == 5:
            lines = data.split(b"\n")
            one, two = rng.integers(0, len(lines), 2)
            lines[one], lines[two] = lines[two], lines[one]
            data = b"\n".join(lines)
        elif kind == 6 and at < len(data) and rng.random() < 0.3:
            data = data[:at]
        elif kind == 7 and rng.random() < 0.1:
            data = others[rng.integers(0, len(others))]
        else:
            # From a random place on: a search through the whole file would take most of the time.
            match = _NUMBER.search(data, at)
            if match:
                data = data[: match.start()] + TOKENS[rng.integers(0, len(TOKENS))] + data[match.end() :]
    return data


def sealed(log: bytes) -> bytes:
    """A mutated journal whose CRCs and chain are made right again, so that what is behind them is reached."""
    crc, lines = 0, []
    for number, line in enumerate(log.split(b"\n")[:-1]):
        body = b"%d %08x %s" % (number, crc, line[line.find(b"{") :] if b"{" in line else line)
        crc = zlib.crc32(body)
        lines.append(b"%08x %s\n" % (crc, body))
    return b"".join(lines)


def repacked(draws: bytes, rng: np.random.Generator, others: list[bytes]) -> bytes:
    """`draws.npz` with one member mutated and its CRC right again."""
    with zipfile.ZipFile(io.BytesIO(draws)) as file:
        members = {name.removesuffix(".npy"): file.read(name) for name in file.namelist()}
    name = sorted(members)[rng.integers(0, len(members))]
    # The header and the first entries: mutations deep in a table of numbers change numbers.
    members[name] = mutate(members[name][:400], rng, others) + members[name][400:]
    return archive(members, zipfile.ZIP_STORED)


@dataclass(frozen=True)
class Target:
    """A file of the good folder, how it is mutated, and its reader."""

    file: str
    read: Callable[[Path], object]
    change: Callable[[bytes, np.random.Generator, list[bytes]], bytes] = mutate


def _read_header(path: Path) -> None:
    keys = parse_toml(path.read_bytes(), path.name)
    parse_header(keys)
    parse_rig_table(keys.table("rig"))


def _read_log(path: Path) -> None:
    verify(path.parent)
    recorded(read_journal(path.parent).records)


STEREO = small_campaign().stereo
TARGETS: dict[str, Target] = {
    "campaign.toml": Target("campaign.toml", _read_header),
    "rig.toml": Target("rig.toml", read_rig),
    "stereo.json": Target("stereo.json", lambda path: parse_stereo(path.read_bytes(), path.name)),
    "moves.csv": Target("moves.csv", lambda path: parse_moves(path.read_bytes(), path.name)),
    "spots.csv": Target("spots.csv", lambda path: parse_spots(path.read_bytes(), path.name, 5, STEREO)),
    "plan.csv": Target("plan.csv", lambda path: parse_plan(path.read_bytes(), path.name)),
    "log.jsonl": Target("journal/log.jsonl", _read_log),
    "log.jsonl, sealed": Target("journal/log.jsonl", _read_log, lambda *args: sealed(mutate(*args))),
    "fit.json": Target("results/fit.json", read_fit),
    "draws.npz": Target("results/draws.npz", read_draws),
    "draws.npz, repacked": Target("results/draws.npz", read_draws, repacked),
    "camera.yml": Target("camera.yml", lambda path: read_calibration([path], SIZE)),
    "picture header": Target("frames/000010_left.png", lambda path: image_size(path.read_bytes(), path.name)),
}


@dataclass(frozen=True)
class Outcome:
    """What a mutation led to; `error` is None where the file was read."""

    target: str
    number: int
    data: bytes
    error: TvsError | None
    peak_bytes: int | None


def mutations(folder: Path, numbers: range, seed: int, traced: bool = False) -> Iterator[Outcome]:
    """Mutate a file of the good folder, read it, put it back; anything but a documented error comes out as it is.

    Args:
        folder: of `good_folder`; whole again after every mutation.
        numbers: of the mutations; each has its own random stream, so that any of them can be repeated alone.
        seed: of all of them.
        traced: measure what Python allocates (three times slower).
    """
    names = list(TARGETS)
    others = [(folder / target.file).read_bytes() for target in TARGETS.values()]
    for number in numbers:
        target = TARGETS[names[number % len(names)]]
        path = folder / target.file
        good = others[number % len(names)]
        data = target.change(good, np.random.default_rng([seed, number]), others)
        error = None
        path.write_bytes(data)
        if traced:
            tracemalloc.start()
        try:
            target.read(path)
        except TvsError as refusal:
            error = refusal
        finally:
            peak = tracemalloc.get_traced_memory()[1] if traced else None
            tracemalloc.stop()
            path.write_bytes(good)
        yield Outcome(names[number % len(names)], number, data, error, peak)
