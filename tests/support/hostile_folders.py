"""Campaign folders from strangers: a good one, edits of its files by Hypothesis, and what edits do not reach, crafted.

Used by `promises/test_hostile.py`. No JAX, no OpenCV.
"""

from __future__ import annotations

import bz2
import io
import json
import os
import re
import struct
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, note, settings
from hypothesis import strategies as st
from support.fit_documents import changed, kept
from support.small_campaign import seen_steps, small_campaign
from support.stored_fits import calibration_bytes

from tvsbayes.acquisition.journal import Journal, encode, read_journal
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.assessment.fitted_calibration import calibration_of_draws
from tvsbayes.calibration.calibration_file import read_draws
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.cameras.imported_calibration import read_calibration
from tvsbayes.errors import TvsError
from tvsbayes.files.disk import shipped_data
from tvsbayes.files.documents import parse_toml
from tvsbayes.files.images import image_size
from tvsbayes.instrument.campaign import (
    input_hashes,
    parse_header,
    parse_moves,
    parse_spots,
    write_campaign,
)
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.plan import parse_plan
from tvsbayes.instrument.rig import parse_rig_table, read_rig
from tvsbayes.instrument.stereo_pair import parse_stereo
from tvsbayes.results.comparison_record import COMPARISON_FORMAT, stored_hold_out
from tvsbayes.results.fit_record import read_fit

MEGABYTE = 1_000_000
SIZE = 1280, 720
CAMPAIGN = small_campaign()
INPUTS = input_hashes(CAMPAIGN)
PEAK_MAX, MESSAGE_BYTES_MAX = 20 * MEGABYTE, 1200
"""The good files hold 0.1 MB; reading one may take a hundred times as much."""
OTHER_FILE = ("missing-file", "not-a-file", "unreadable", "path")
PNG_HEAD = 40
FIT, COMPARED, DRAWS = "results/fit.json", "results/compare.json", "results/draws.npz"
LOG = "journal/log.jsonl"
FRAMES = tuple(f"frames/{spot.spot:06d}_{side}.png" for spot in CAMPAIGN.spots[:2] for side in ("left", "right"))
PAYLOADS = (
    "</script><script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "<svg/onload=alert(1)>",
    "<a href=javascript:alert(1)>x</a>",
    "<!-- <iframe src=//x>",
    "{{ 7*7 }}{% include 'x' %}",
    "]]>&#60;script&#62;",
)


def png(width: int, height: int, raw: bytes | None = None) -> bytes:
    """A grey PNG of zeros, or one whose pixel data are `raw`, made without a decoder's library."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    if raw is None:
        packer = zlib.compressobj(9)
        rows = bytes(1 + width) * 64
        raw = b"".join(packer.compress(rows) for _ in range(height // 64))
        raw += packer.compress(bytes(1 + width) * (height % 64)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", raw) + chunk(b"IEND", b"")


def camera_yaml() -> str:
    """The cameras of the campaign in OpenCV's YAML."""
    pair = {key: np.atleast_2d(getattr(CAMPAIGN.stereo, key)) for key in ("M1", "D1", "M2", "D2", "R", "T")}
    pair["T"] = pair["T"].T
    return "%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\n" + "".join(
        f"{key}: !!opencv-matrix\n   rows: {len(matrix)}\n   cols: {matrix.shape[1]}\n   dt: d\n"
        f"   data: {matrix.ravel().tolist()}\n"
        for key, matrix in pair.items()
    )


def drawn_calibration() -> Calibration:
    """Normal draws about the default rig, 1 % of every parameter: small enough for all draws to meet."""
    generator = np.random.default_rng(8)
    names, columns = tuple(dict.fromkeys((*INPUT_NAMES, *NOISE_NAMES))), []
    for name in names:
        value = TWO_MIRROR.priors[name].value
        columns.append(value + 0.01 * abs(value) * generator.standard_normal(600))
    calibration = calibration_of_draws(names, np.stack(columns, axis=1), CAMPAIGN, "posterior", 0, seen_steps(CAMPAIGN))
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
    write_campaign(CAMPAIGN, place)
    write_campaign(CAMPAIGN, place / "journal")
    for name in ("results", "frames", "boards"):
        (place / name).mkdir()
    document = kept("fit-1-laplace.json") | {"inputs": INPUTS}
    # Reports need these; documents of the first version lack them.
    document |= {"residuals": [], "residual_causes": [], "gap": None, "budgets": [], "positioning": []}
    (place / FIT).write_text(json.dumps(document, indent=1))
    ratios = np.tile([0.06, 0.06, 0.07, 0.07], (600, 1))
    draws = calibration_bytes(drawn_calibration(), effective_deg_per_step=ratios)
    (place / DRAWS).write_bytes(draws)
    score = {"rms_deg": 0.1, "rms_block_deg": 0.05, "coverage": 0.95, "log_density": 1.0}
    held = {"by": "steps", "predictions": [], "classic": score, "joint": score, "ratio": 1.0, "interval95": None}
    held |= {"verdict": "joint", "reason": "smaller errors", "unseen": {"left": 1e-4}}
    compared = {"format": COMPARISON_FORMAT, "inputs": INPUTS, "held_out": held}
    (place / COMPARED).write_text(json.dumps(compared, indent=1))
    for frame in FRAMES:
        (place / frame).write_bytes(png(*SIZE))
    for side in ("left", "right"):
        (place / "boards" / f"{side}01.png").write_bytes(png(320, 240))
    mounted = shipped_data() / "rigs" / "mounted"
    (place / "rig.toml").write_bytes((mounted / "rig.toml").read_bytes())
    (place / "plan.csv").write_bytes((mounted / "mixed.csv").read_bytes())
    (place / "camera.yml").write_text(camera_yaml())
    write_journal(place / "journal")
    return place


@dataclass(frozen=True)
class Crafted:
    """A folder that edits of single files practically never make.

    Attributes:
        proves: what holds where all commands end with their codes and do no harm.
        spoil: makes a good folder hostile; its parent may be used for what lies outside.
        commands: what is run, `@` standing for the folder.
        codes: exit codes that are right for the commands, all of them.
        large: takes seconds or much disk: for the experiment only.
    """

    proves: str
    spoil: Callable[[Path], object]
    commands: tuple[str, ...]
    codes: frozenset[int] = frozenset({2})
    large: bool = False


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
    packed, name = bz2.compress(bytes(megabytes * MEGABYTE)), b"format.npy"
    local = (
        struct.pack("<4sHHHHHIIIHH", b"PK\3\4", 46, 0, 12, 0, 33, 0, len(packed), 1000, len(name), 0) + name + packed
    )
    sizes = (0, len(packed), 1000, len(name), 0, 0, 0, 0, 0, 0)
    central = struct.pack("<4sHHHHHHIIIHHHHHII", b"PK\1\2", 46, 46, 0, 12, 0, 33, *sizes) + name
    return local + central + struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 1, 1, len(central), len(local), 0)


def draws_with(folder: Path, **changes: object) -> None:
    """A `draws.npz` of the right hashes with some arrays of its own."""
    path = folder / DRAWS
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez_compressed(path, **{**arrays, **changes})


class Touch:
    """Unpickled, it runs a command."""

    def __reduce__(self):
        return os.system, ("touch pwned",)


def change(document: Path, **values: object) -> None:
    """Sets values of a JSON file; the parts of a key are split at "/"."""
    content = json.loads(document.read_text())
    for key, value in values.items():
        content = changed(content, key, value)
    document.write_text(json.dumps(content))


def long_log(folder: Path) -> None:
    """A whole, chained log of 100 000 equal events."""
    content, crc = [], 0
    for number in range(100_000):
        event = {"format": "tvsbayes-log/1"} if number == 0 else {"a": [[]] * 20}
        content.append(encode(number, crc, "intent" if number else "created", event))
        crc = int(content[-1][:8], 16)
    (folder / LOG).write_bytes(b"".join(content))


def inject(folder: Path) -> None:
    """Payloads in every text that a report shows."""
    path = folder / "campaign.toml"
    kept = [line for line in path.read_text().split("\n") if not line.startswith(("name", "notes"))]
    texts = {"name": PAYLOADS[1], "operator": PAYLOADS[0], "notes": "".join(PAYLOADS)}
    kept[1:1] = [f"{key} = {json.dumps(text)}" for key, text in texts.items()]
    path.write_text("\n".join(kept))
    versions = dict(zip(("python", "tvsbayes", "jax"), PAYLOADS[2:], strict=False))
    lists = {key: list(PAYLOADS) for key in ("problems", "prior_conflicts")}
    change(folder / FIT, command=PAYLOADS[0], versions=versions, **lists)
    change(folder / COMPARED, **{"held_out/verdict": PAYLOADS[0]})
    draws_with(folder, estimator=np.array(PAYLOADS[0]))


def move_out(folder: Path, name: str) -> None:
    """An inner folder lies outside, with a link to it."""
    (folder / name).rename(folder.parent / "elsewhere")
    (folder / name).symlink_to(folder.parent / "elsewhere")


def pipes(folder: Path) -> None:
    """Named pipes in the place of files."""
    for file in ("log.jsonl", FRAMES[0], DRAWS):
        (folder / file).unlink(missing_ok=True)
        os.mkfifo(folder / file)


def largest_frames(folder: Path) -> None:
    """Pictures of 49 million pixels, as `stereo.json` says."""
    change(folder / "stereo.json", image_width=7000, image_height=7000)
    for frame in FRAMES:
        (folder / frame).write_bytes(png(7000, 7000))


def many_spots(folder: Path) -> None:
    """As many as are allowed, every cell its own text; a wide character makes the text four times as large."""
    path = folder / "spots.csv"
    header = path.read_text().split("\n")[0].split(",")
    fixed = {"status": "ok", "experiment": "", "point": "", "aperture_deg": "50.125", "move": "1"}
    with path.open("w") as file:
        file.write(",".join(header) + "\n")
        for row in range(200_000):
            cells = {**fixed, "spot": str(row), "target": ("\U0001f600" if row == 0 else f"t{row}") + "x" * 90}
            values = (cells.get(c, f"{100 + 1e-4 * row:.13f}" if c[1] == "_" else f"0.1{row}") for c in header)
            file.write(",".join(values) + "\n")


LOCATE = "locate @ --pan-steps 100 --tilt-steps 20 --aperture-deg 70"
IMPORT = "stereo --import @/camera.yml --image-size 1280x720"
BOARDS = "stereo @/boards --board 9x6 --pitch-mm 20"
CALL = '!!python/object/apply:os.system ["touch pwned"]\n'
LAUGHS = "a0: &a0 [x,x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1},*a{k - 1}]\n" for k in range(1, 9))
PORT = '\n[positioner]\ndriver = "teensy"\nport = "spy:///dev/ptmx?file=spied.txt"\n'
HUGE = {"format": npy("<f8", (10**11,))}
WITHOUT_WIDTH = {"format": FORMAT_NPY, "input_names": npy("<U0", (3 * 10**7,))}
CRAFTED: dict[str, Crafted] = {
    "picture of 900 million pixels": Crafted(
        "a picture that unpacks to gigabytes is refused by its header",
        lambda folder: (folder / FRAMES[0]).write_bytes(png(30000, 30000)),
        ("detect @",),
        large=True,
    ),
    "pictures of 49 million pixels": Crafted(
        "the largest frames allowed fit into the memory", largest_frames, ("detect @",), frozenset({0, 2, 3}), True
    ),
    "boards of 20 million pixels": Crafted(
        "the largest pictures of boards allowed fit into the memory",
        lambda folder: [path.write_bytes(png(5000, 4000)) for path in (folder / "boards").iterdir()],
        (BOARDS,),
        frozenset({3}),
        True,
    ),
    "yaml that calls a command": Crafted(
        "YAML makes no objects", lambda folder: (folder / "camera.yml").write_text(CALL), (IMPORT,)
    ),
    "yaml that doubles eight times": Crafted(
        "anchors are refused", lambda folder: (folder / "camera.yml").write_text(LAUGHS), (IMPORT,)
    ),
    "pickle in draws.npz": Crafted(
        "nothing is unpickled",
        lambda folder: np.savez(folder / DRAWS, format=np.array([Touch()], dtype=object)),
        (LOCATE, "report @"),
    ),
    "npy header of 800 GB": Crafted(
        "an array is as large as its bytes, whatever its header states",
        lambda folder: (folder / DRAWS).write_bytes(archive(HUGE)),
        (LOCATE,),
    ),
    "npz of entries without width": Crafted(
        "entries of no bytes are counted",
        lambda folder: (folder / DRAWS).write_bytes(archive(WITHOUT_WIDTH)),
        (LOCATE,),
    ),
    "npz of bzip2 that lies about its size": Crafted(
        "a bomb that states few bytes is not unpacked",
        lambda folder: (folder / DRAWS).write_bytes(lying_bzip2(30)),
        (LOCATE,),
    ),
    "npz with ANSI and bidi characters": Crafted(
        "a text of results that cannot be printed is refused",
        lambda folder: draws_with(folder, estimator=np.array("\x1b[2J\u202elaplace")),
        (LOCATE,),
    ),
    "frames folder links outside": Crafted(
        "pictures are read inside the folder", lambda folder: move_out(folder, "frames"), ("detect @",)
    ),
    "results folder links outside": Crafted(
        "nothing is written outside the folder",
        lambda folder: move_out(folder, "results"),
        ("detect @ --overlay", "fit @ --no-sample", "report @"),
    ),
    "pipes": Crafted("no reader waits for a writer", pipes, ("check @", "detect @", LOCATE)),
    "rig file whose port writes a file": Crafted(
        "a rig file opens no spy of pySerial",
        lambda folder: (folder / "rig.toml").write_text((folder / "rig.toml").read_text() + PORT),
        ("check @/rig.toml", "doctor @/rig.toml"),
    ),
    "markup in every text": Crafted(
        "no text becomes part of a page", inject, ("check @", "report @ --dcc"), frozenset({0})
    ),
    "table of 200 000 spots": Crafted(
        "the longest table allowed fits into memory and time", many_spots, ("check @",), frozenset({0, 2}), True
    ),
    "log of 100 000 lines": Crafted(
        "the longest journal allowed fits into memory and time", long_log, ("check @/journal",), frozenset({0}), True
    ),
    "folder of 20 000 frames": Crafted(
        "frames that no spot names cost nothing",
        lambda folder: [(folder / "frames" / f"{k:06d}_left.png").touch() for k in range(20_000)],
        ("check @", "detect @"),
        frozenset({0, 2}),
        True,
    ),
}


@dataclass(frozen=True)
class Edit:
    """The bytes of a good file from `start` to `stop` give way to `new`, `times` over."""

    start: int
    stop: int
    new: bytes
    times: int = 1


def edited(data: bytes, edits: Iterable[Edit]) -> bytes:
    """From the last edit to the first: places are those of the good file."""
    for edit in sorted(edits, key=lambda edit: edit.start, reverse=True):
        data = data[: edit.start] + edit.new * edit.times + data[edit.stop :]
    return data


VALUES = (
    *(b"null", b"true", b"{}", b"[]", b"[[1]]", b'""', b'"a"', b"", b"0", b"-1", b"1e308", b"1e-400", b"1979-05-27"),
    *(b"nan", b"NaN", b"-inf", b"1e999", b"9_4.7", b"0x1F", b"1-2", b".", b"1e", b"9,4", b" 7", b"1" * 19, b"1.5"),
    *(b"=1+1", b"@SUM(A1)", "\u0661".encode(), b'"\\ud800"'),
)
SYNTAX = (
    *(b"{", b"}", b"[", b"]", b'"', b"'", b'"""', b",", b";", b":", b"=", b".", b"#", b"\\", b"\n", b"\r", b"\0"),
    *(b"&a", b"*a", b"!!int", b"../", b"\x1b[2J", b"\xff", b"\xef\xbb\xbf", "\u202e".encode(), "\u2028".encode()),
    *(b"GIF89a", b"PK\3\4", b"\x89HDF\r\n\x1a\n"),
)
LONG = ((b"[", 100_000), (b"{b = ", 10_000), (b'{"a":', 20_000), (b"a.", 20_000), (b"1", 5000), (b"x", 200_000))
"""Repeated: nesting, dotted keys, digits, texts."""


def edits_of(data: bytes) -> st.SearchStrategy[list[Edit]]:
    """One or two: of cells, keys and values into values, or of words, lines and any bytes into anything."""
    words, lines = ([m.span() for m in re.finditer(p, data)] for p in (rb'"[^"\n]*"|[^\s,:=]+', rb"[^\n]*\n|[^\n]+$"))
    word, line = st.sampled_from(words), st.sampled_from([*lines, (0, len(data))])
    anywhere = st.tuples(st.integers(0, len(data)), st.integers(0, 12)).map(lambda at: (at[0], at[0] + at[1]))
    copy, copies = (place.map(lambda at: (data[slice(*at)], 1)) for place in (word, line))
    texts = (st.floats().map(str), st.integers().map(str), st.text(max_size=8))
    raw = (st.sampled_from(VALUES), *(text.map(str.encode) for text in texts), st.binary(max_size=8))
    value, *numbers, text, noise = (st.tuples(new, st.just(1)) for new in raw)
    often = st.sampled_from([*((token, 1) for token in SYNTAX), *LONG])

    def edits(place: st.SearchStrategy, *new: st.SearchStrategy) -> st.SearchStrategy[list[Edit]]:
        one = st.builds(lambda at, new: Edit(*at, *new), place, st.one_of(*new))
        return st.lists(one, min_size=1, max_size=2)

    more = (often, copy, copies, text, noise)
    return edits(word, value, copy, *numbers) | edits(word | line | anywhere, value, *numbers, *more)


def sealed(log: bytes) -> bytes:
    """An edited journal whose CRCs and chain are made right again, so that what is behind them is reached."""
    crc, lines = 0, []
    for number, line in enumerate(log.split(b"\n")[:-1]):
        body = b"%d %08x %s" % (number, crc, line[line.find(b"{") :] if b"{" in line else line)
        crc = zlib.crc32(body)
        lines.append(b"%08x %s\n" % (crc, body))
    return b"".join(lines)


def members(draws: bytes) -> dict[str, bytes]:
    """The `.npy` files of an archive."""
    with zipfile.ZipFile(io.BytesIO(draws)) as file:
        return {name.removesuffix(".npy"): file.read(name) for name in file.namelist()}


SEAM, MEMBER_HEAD = b"\n--- next member ---\n", 400
"""Bytes of a member that are edited: header and first entries; edits deep in a table of numbers change numbers."""


def heads(draws: bytes) -> bytes:
    """The heads of all members, one after the other."""
    return SEAM.join(data[:MEMBER_HEAD] for data in members(draws).values())


def repacked(draws: bytes, edits: Sequence[Edit]) -> bytes:
    """`draws.npz` with edits of `heads`; CRCs are right again, and a member without its seam is lost."""
    pairs = zip(members(draws).items(), edited(heads(draws), edits).split(SEAM), strict=False)
    return archive({name: head + data[MEMBER_HEAD:] for (name, data), head in pairs}, zipfile.ZIP_STORED)


@dataclass(frozen=True)
class Target:
    """A file of the good folder.

    Attributes:
        file: its place.
        read: its reader.
        command: one that reads it, `@` standing for the folder.
        view: what of it is edited.
        build: makes a file of the good one and the edits.
    """

    file: str
    read: Callable[[Path], object]
    command: str = "classic @"
    view: Callable[[bytes], bytes] = bytes
    build: Callable[[bytes, Sequence[Edit]], bytes] = edited


def _read_header(path: Path) -> None:
    keys = parse_toml(path.read_bytes(), path.name)
    parse_header(keys)
    parse_rig_table(keys.table("rig"))


def _read_log(path: Path) -> None:
    verify(path.parent)
    recorded(read_journal(path.parent).records)


def _read_comparison(path: Path) -> None:
    stored_hold_out(replace(CAMPAIGN, path=path.parents[1]), INPUTS)


STEPS = "steps-for @ --export json"
TARGETS: dict[str, Target] = {
    "campaign.toml": Target("campaign.toml", _read_header),
    "rig.toml": Target("rig.toml", read_rig, "check @/rig.toml"),
    "stereo.json": Target("stereo.json", lambda path: parse_stereo(path.read_bytes(), path.name)),
    "moves.csv": Target("moves.csv", lambda path: parse_moves(path.read_bytes(), path.name)),
    "spots.csv": Target(
        "spots.csv", lambda path: parse_spots(path.read_bytes(), path.name, CAMPAIGN.moves[:5], CAMPAIGN.stereo)
    ),
    "plan.csv": Target("plan.csv", lambda path: parse_plan(path.read_bytes(), path.name), "check @/plan.csv"),
    "log.jsonl": Target(LOG, _read_log, "check @/journal"),
    "log.jsonl, sealed": Target(LOG, _read_log, "check @/journal", build=lambda *args: sealed(edited(*args))),
    "fit.json": Target(FIT, read_fit, "report @"),
    "compare.json": Target(COMPARED, _read_comparison, "report @"),
    "draws.npz": Target(DRAWS, read_draws, STEPS),
    "draws.npz, repacked": Target(DRAWS, read_draws, STEPS, heads, repacked),
    "camera.yml": Target("camera.yml", lambda path: read_calibration([path], SIZE), IMPORT),
    "picture header": Target(
        FRAMES[0], lambda path: image_size(path.read_bytes(), path.name), "detect @", lambda data: data[:PNG_HEAD]
    ),
}


@dataclass(frozen=True)
class Outcome:
    """What an edited file led to; `error` is None where it was read."""

    data: bytes
    error: TvsError | None
    peak_bytes: int
    cpu_s: float

    @property
    def code(self) -> str:
        """Of the refusal."""
        return "read" if self.error is None else self.error.code


def printable(error: TvsError) -> bool:
    """Whether a message can go to a terminal and into JSON, and says what was wrong."""
    text = error.message
    return text.isprintable() and len(text.encode()) < MESSAGE_BYTES_MAX and bool(error.remedy)


def outcome(folder: Path, target: Target, data: bytes, traced: bool = False) -> Outcome:
    """Read a file with other content and put it back; anything but a documented, printable error comes out as it is.

    Args:
        folder: of `good_folder`; whole again afterwards.
        target: what is read.
        data: the content.
        traced: measure what Python allocates (three times slower).
    """
    path, error, peak = folder / target.file, None, 0
    good = path.read_bytes()
    path.write_bytes(data)
    before = time.process_time()
    if traced:
        tracemalloc.start()
    try:
        target.read(path)
    except TvsError as refusal:
        error = refusal
    finally:
        if traced:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        path.write_bytes(good)
    if error is not None:
        # A rig file names another file, its stereo.json.
        assert printable(error) and ((error.file or "").endswith(path.name) or error.code in OTHER_FILE), error
    assert peak < PEAK_MAX, f"{peak} bytes allocated"
    return Outcome(data, error, peak, time.process_time() - before)


def edited_files(
    folder: Path, target: Target, count: int, seen: Callable[[Outcome], object], traced: bool = False
) -> None:
    """Edited files, by Hypothesis, always the same; one that breaks the law comes out shrunken.

    Args:
        folder: of `good_folder`; whole again afterwards.
        target: what is edited and read.
        count: examples.
        seen: called with every outcome.
        traced: as in `outcome`.
    """
    good = (folder / target.file).read_bytes()
    view = target.view(good)

    @settings(max_examples=count, derandomize=True, deadline=None, database=None, suppress_health_check=HealthCheck)
    @given(edits_of(view))
    def read_or_refused(edits: list[Edit]) -> None:
        for edit in edits:
            note(f"{target.file}: {view[edit.start : edit.stop]!r} gives way to {edit.new!r}, {edit.times} times")
        seen(outcome(folder, target, target.build(good, edits), traced))

    read_or_refused()
