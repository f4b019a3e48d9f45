"""Commands of a head with sightings, where they differ from the scanner's."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from tvsbayes.cli.app import check_output, finish, report_line, write_files
from tvsbayes.cli.confirmed_import import Import, occupied
from tvsbayes.cli.outcomes import Contents, finish_promised, promise_of
from tvsbayes.cli.report_page import DRAWING, Page
from tvsbayes.display import concise
from tvsbayes.errors import InputError, escaped, refusal, typed
from tvsbayes.files.csv_kind import templates
from tvsbayes.files.disk import make_folder, read_bytes, write_folder
from tvsbayes.files.documents import TOML_BYTES_MAX, toml_line
from tvsbayes.head.first_priors import falls, first_priors
from tvsbayes.head.pointing_model import pointing_model
from tvsbayes.head.urdf import UNSAID, HeadModel, ratios_of
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.columns import table_document, table_lines
from tvsbayes.importing.reader import read_foreign
from tvsbayes.importing.sightings import FIELDS, sighting_rows
from tvsbayes.importing.urdf import URDF_BYTES_MAX, HeadJoints, head_joints
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import MOVES, SPOTS, Move, input_hashes, read_campaign
from tvsbayes.instrument.campaign_header import header_values, mechanism_key
from tvsbayes.instrument.corrections import Correction, corrected
from tvsbayes.instrument.counter_limits import LIMIT_KEYS
from tvsbayes.instrument.mechanisms import HEAD, SIGHTING_HEAD
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.sightings import SIGHTINGS, Sighting, sightings_of
from tvsbayes.pipeline import FITTING, StoredOrFitted
from tvsbayes.progress import Job

if TYPE_CHECKING:
    from tvsbayes.report.document import Document, Issue

HEAD_URDF = "head.urdf"
"""File in a campaign folder: the model from `import --urdf`."""
TEMPLATE_FILES = ("campaign.toml", "moves.csv", "spots.csv")
"""Files of a campaign written by `new`."""
PRIOR_FILES = ("campaign.toml", "rig.toml")
"""Files with [rig.prior]."""
RATIO_U = 0.01
"""Relative u of a nominal ratio."""


def head_templates(sightings: bool) -> dict[str, bytes]:
    """The commented files of an empty campaign of a pan-tilt head, with its rig file."""
    files = templates("head_templates", MOVES, SIGHTINGS if sightings else SPOTS)
    # Lines that begin with #sightings or #spots apply only to heads of that kind.
    kind, other = (b"sightings", b"spots") if sightings else (b"spots", b"sightings")
    files = {name: re.sub(rb"(?m)^#%s .*\n" % other, b"", data) for name, data in files.items()}
    return {name: re.sub(rb"(?m)^#%s " % kind, b"", data) for name, data in files.items()}


INCREMENTAL = (
    "encoders: incremental, with a new zero at each homing; --encoders output (absolute, on the axis itself) or motor "
    "(absolute, before the gears) says another"
)
"""What an import says where --encoders is not given."""


def import_urdf(file: Path, to: Path, joints: Mapping[str, str | None], steps_per_turn: float | None) -> Import:
    """Import the nominal geometry of two joints into a new campaign of a head, or into one made by `new`."""
    data = read_bytes(file, URDF_BYTES_MAX)
    head = head_joints(data, escaped(file.name), joints)
    spots = {name: (to / name).read_bytes() for name in TEMPLATE_FILES if (to / name).is_file()}
    untouched = {name: text for name, text in head_templates(False).items() if name in TEMPLATE_FILES}
    kind = HEAD if spots == untouched else SIGHTING_HEAD
    ratios = {} if steps_per_turn is None else ratios_of(head, steps_per_turn)
    priors = {name: Prior(value, RATIO_U * value) for name, value in ratios.items()}
    terms = {name: value for name, value in head.terms.items() if value and name in kind.parameters}
    priors |= {name: Prior(value, kind.priors[name].u) for name, value in terms.items()}
    assumed = [
        f"pan is joint {escaped(head.names['pan'])}, tilt joint {escaped(head.names['tilt'])}; counter 0 is angle 0 "
        "of a joint",
        "the beam is x of the tilt joint's child link; directions are in the parent link of the pan joint, z up",
    ]
    for axis, angle in (("pan", "azimuth"), ("tilt", "elevation")):
        sense = "rises" if head.sign[axis] > 0 else "falls"
        assumed.append(f"{axis}_steps count up where {angle} grows: there the position of {axis}'s joint {sense}")
    if not ratios:
        assumed.append("degrees per step: the default; --steps-per-turn N, or state them in [rig.prior]")
    files = _urdf_files(head_templates(kind is SIGHTING_HEAD), priors, head, steps_per_turn)
    files[HEAD_URDF] = data
    lines = [f"nominal: {name} = {prior.value:.6g}" for name, prior in priors.items()]
    lines += [f"assumed: {text}" for text in assumed]
    next_step = f"log moves and spots there, then `tvsbayes check {typed(to)}`"
    if kind is SIGHTING_HEAD:
        next_step = f"`tvsbayes import LOG --sightings --to {typed(to)}` with moves and sightings"
    document = {"campaign": str(to), "joints": dict(head.names), "signs": dict(head.sign), "assumed": assumed}
    document |= {"nominal": {name: prior.value for name, prior in priors.items()}}

    def write() -> list[str]:
        (write_folder if kind is SIGHTING_HEAD else write_files)(to, files)
        return [escaped(str(to), 200)]

    def outcome(written: list[str]) -> dict[str, Any]:
        return {"written": bool(written), "files": list(files) if written else []}

    return Import(lines, document, write, next_step, outcome=outcome)


def import_sightings(
    file: Path, to: Path, sheet: str | None, wishes: Wishes, correction: Correction, encoders: str | None
) -> Import:
    """Import a table of moves and sightings into a new campaign of a head, or into one without rows."""
    table = read_foreign(file, sheet)
    rows = sighting_rows(table, wishes)
    assumed = list(rows.assumed)
    listed = [Move(**row) for row in rows.moves], [Sighting(**row) for row in rows.sightings]
    changed = corrected(*listed, correction)
    moves, sightings = changed.moves or (), sightings_of(changed.spots or ())
    joints = _joints_of(to)
    reversed_axes = () if joints is None else [axis for axis in AXES if joints.sign[axis] < 0]
    if turned := tuple(axis for axis in reversed_axes if axis in rows.encoders and falls(moves, sightings, axis)):
        assumed += [f"{axis}_steps: angles of the joint of the URDF, which falls there" for axis in turned]
        of_joint = corrected(moves, None, Correction(flipped=turned))
        moves, assumed = of_joint.moves or (), [*assumed, *of_joint.changes]
    priors = first_priors(moves, sightings, rows.encoders, assumed)
    absolute = _absolute(table.file, rows.encoders, encoders, priors, assumed)
    imported = ImportedHead(moves, sightings, priors, rows.encoders, absolute, (*assumed, *changed.changes))
    contents = _sighting_files(imported, to, table.file)
    ok = sum(sighting.status == "ok" for sighting in sightings)
    lines = table_lines(table, rows.understood, FIELDS, rows.units)
    lines += [f"assumed: {text}" for text in contents.assumed]
    lines.append(f"gives: {len(moves)} moves, {len(sightings)} sightings, {ok} of use")
    document = {**table_document(table, rows.understood), "assumed": contents.assumed, "moves": len(moves)}
    document |= {"sightings": len(sightings), "ok": ok, "campaign": str(to)}

    def write() -> list[str]:
        return (write_folder if contents.is_new else write_files)(to, contents.files)

    return Import(lines, document, write, f"`tvsbayes check {typed(to)}`", ", or correct it with --column")


@dataclass(frozen=True)
class ImportedHead:
    """Moves and sightings of a table, priors, axes read by encoders and by absolute ones, and assumptions in words."""

    moves: Sequence[Move]
    sightings: Sequence[Sighting]
    priors: dict[str, Prior]
    encoders: Set[str]
    absolute: tuple[str, ...]
    assumed: tuple[str, ...]


@dataclass(frozen=True)
class _SightingFiles:
    """Files of a head by name, whether their folder is new, and the assumptions in words."""

    files: dict[str, bytes]
    is_new: bool
    assumed: list[str]


def _sighting_files(rows: ImportedHead, to: Path, table: str) -> _SightingFiles:
    """The tables, with campaign and rig file, whose ratios are added where the folder states none.

    Raises:
        InputError: the folder has another instrument, rows, or stated ratios for angles of an encoder.
    """
    current = templates = head_templates(True)
    stated: set[str] = set()
    if not (is_new := not (to / "campaign.toml").is_file()):
        if mechanism_key(to) != SIGHTING_HEAD.key:
            found, allowed = "a campaign without sightings.csv", "one that `new --mechanism pan-tilt --sightings` made"
            remedy = "name a new folder with --to"
            raise refusal("instrument", file=escaped(str(to), 200), found=found, allowed=allowed, remedy=remedy)
        current = {name: read_bytes(to / name, TOML_BYTES_MAX, to) for name in PRIOR_FILES if (to / name).is_file()}
        stated = _stated_priors(to)
    elif to.exists():
        make_folder(to, empty=True)
    for name in (MOVES.file, SIGHTINGS.file):
        path = to / name
        if path.is_file() and path.read_bytes() != templates[name]:
            raise occupied(path)
    for axis in sorted(rows.encoders):
        if (name := f"degrees_per_step.{axis}") in stated:
            found, allowed = f"angles of an encoder, and {name} in campaign.toml", "counters of the stated ratio"
            remedy = "give a table of counters, or name a new folder with --to"
            raise refusal("encoder", file=table, found=found, allowed=allowed, remedy=remedy)
    priors = {name: prior for name, prior in rows.priors.items() if name not in stated}
    files = dict(templates) if is_new else {}
    files |= with_priors(current, priors) if priors else {}
    if rows.absolute:
        line = toml_line("absolute", list(rows.absolute)).encode()
        files |= {
            name: re.sub(rb"(?m)^\[rig\][^\n]*$", rb"\g<0>\n" + line, files.get(name, current[name]), count=1)
            for name in PRIOR_FILES
            if name in current
        }
    files |= {MOVES.file: MOVES.content(rows.moves), SIGHTINGS.file: SIGHTINGS.content(rows.sightings)}
    return _SightingFiles(files, is_new, [text for text in rows.assumed if text.partition(":")[0] not in stated])


def _absolute(
    file: str, encoders: Set[str], kind: str | None, priors: dict[str, Prior], assumed: list[str]
) -> tuple[str, ...]:
    """Axes whose encoders are absolute, as --encoders says; one on the axis itself has no play and no contrast.

    Raises:
        InputError: --encoders, and no angle of an encoder in the table.
    """
    if kind is not None and not encoders:
        allowed, remedy = "angles of encoders, which have a unit or decimals", "leave --encoders out"
        raise refusal("usage", file=file, found="counters", allowed=allowed, remedy=remedy)
    if encoders and kind is None:
        assumed.append(INCREMENTAL)
    axes = tuple(axis for axis in AXES if axis in encoders) if kind in ("output", "motor") else ()
    for axis in axes if kind == "output" else ():
        priors |= {f"backlash_deg.{axis}": Prior(0.0, 0.0), f"play_variation_deg.{axis}": Prior(0.0, 0.0)}
        priors[f"ratio_contrast_deg_per_step.{axis}"] = Prior(0.0, 0.0)
    return axes


def _joints_of(folder: Path) -> HeadJoints | None:
    """The joints of the URDF in a campaign folder; None if none."""
    if not ((folder / "campaign.toml").is_file() and (folder / HEAD_URDF).is_file()):
        return None
    stated = header_values(folder).get("urdf")
    names: dict[str, Any] = stated if isinstance(stated, dict) else {}
    joints: dict[str, str | None] = {axis: names.get(f"{axis}_joint") for axis in AXES}
    return head_joints(read_bytes(folder / HEAD_URDF, URDF_BYTES_MAX, folder), HEAD_URDF, joints)


def _stated_priors(folder: Path) -> set[str]:
    """Names in [rig.prior] of a campaign folder."""
    rig = header_values(folder).get("rig")
    priors = rig.get("prior") if isinstance(rig, dict) else None
    return set(priors) if isinstance(priors, dict) else set()


def with_priors(
    templates: Mapping[str, bytes], priors: Mapping[str, Prior], tables: Mapping[str, Sequence[str]] | None = None
) -> dict[str, bytes]:
    """Templates of campaign and rig with priors in [rig.prior], and further lines at their ends."""
    entries = [
        toml_line(name, {"value": float(f"{p.value:.9g}"), "u": float(f"{p.u:.3g}")}) for name, p in priors.items()
    ]
    files = {}
    for name in (name for name in PRIOR_FILES if name in templates):
        lines = templates[name].decode().splitlines()
        lines = [line for line in lines if line.partition("=")[0].strip().strip('"') not in priors]
        if "[rig.prior]" not in lines:
            lines.append("[rig.prior]")
        at, end = lines.index("[rig.prior]") + 1, (tables or {}).get(name, ())
        files[name] = "\n".join([*lines[:at], *entries, *lines[at:], *([""] if end else []), *end, ""]).encode()
    return files


def _urdf_files(
    templates: Mapping[str, bytes], priors: Mapping[str, Prior], head: HeadJoints, steps_per_turn: float | None
) -> dict[str, bytes]:
    """Templates of a head with nominal values, joints and limits."""
    joints: dict[str, object] = {f"{axis}_joint": head.names[axis] for axis in AXES}
    joints |= {} if steps_per_turn is None else {"steps_per_turn": float(steps_per_turn)}
    tables = {"campaign.toml": ["[urdf]", *(toml_line(key, value) for key, value in joints.items())], "rig.toml": []}
    for axis, keys in LIMIT_KEYS.items() if steps_per_turn is not None else ():
        ratio = priors[f"degrees_per_step.{axis}"].value
        if (limits := head.limits_deg[axis]) is not None:
            tables["rig.toml"] += [toml_line(key, round(end / ratio)) for key, end in zip(keys, limits, strict=True)]
    if tables["rig.toml"]:
        tables["rig.toml"].insert(0, "[positioner]")
    return {**templates, **with_priors(templates, priors, tables)}


def compensate(folder: Path, out: Path | None, force: bool, seed: int, as_json: bool) -> None:
    """Write the model of the robot with the estimated terms, and YAML with their covariance."""
    import yaml

    from tvsbayes.calibration.calibration_file import Origin
    from tvsbayes.comparison.verified_looks import accepted_calibration
    from tvsbayes.report.compensation_text import aimed_text

    yaml_path = None if out is None else out.with_name(f"{out.name}.yaml")
    for place in (out, yaml_path):
        check_output(place, kind="model of a head", force=force)
    nominal = folder / HEAD_URDF
    if out is not None and not force and out.exists() and nominal.exists() and out.samefile(nominal):
        message = f"-o {escaped(str(out), 200)} would replace the model that this head is corrected from"
        raise InputError("occupied", message, remedy="name another file, or add --force")
    data = read_campaign(folder)
    results, origin = StoredOrFitted(data, report_line), Origin.of(data)
    calibration, kind = accepted_calibration(data, results.stored), data.rig.mechanism
    terms = {f"{block}.{axis}" for axis in AXES for block in ("backlash_deg", "degrees_per_step")}
    terms |= {term.name for term in kind.path if term.name in kind.parameters}
    used = [k for k, name in enumerate(calibration.names) if name in terms and calibration.covariance[k, k] > 0]
    stated = data.header.get("urdf")
    made = f"made by tvsbayes {origin.tvsbayes}, {origin.exported}, of {escaped(origin.campaign)}"
    made += "; applied to nothing yet"
    model = HeadModel(
        names=tuple(calibration.names[k] for k in used),
        values=calibration.mean[used],
        covariance=calibration.covariance[np.ix_(used, used)],
        origin=made,
        data_sha256=hashlib.sha256("".join(input_hashes(data).values()).encode()).hexdigest(),
        steps_per_turn=stated.get("steps_per_turn") if isinstance(stated, dict) else None,
    )
    head = _joints_of(folder)
    document = model.document(head)
    lines = [f"{name} {concise(v, u)}" for name, v, u in zip(model.names, model.values, document["u"], strict=True)]
    lines += [
        f"{axis}: {joint['steps_per_rad']:.9g} counters per radian of joint {escaped(joint['name'])}"
        for axis, joint in document["joints"].items()
    ]
    lines += [f"not in the file: {words}" for words in document["unsaid"]]
    promise, kept = promise_of(results, "urdf", seed, UNSAID)
    if promise is not None:
        lines.append(aimed_text(promise))
        document["promise"] = kept["promise"]
    if out is None:
        described = "xacro properties" if head is None else f"{HEAD_URDF} with these terms"
        lines.append(f"nothing written: give -o FILE; it would hold {described}, and FILE.yaml their covariance")
    beside = f"# {made}\n{yaml.safe_dump(document, sort_keys=False)}"
    contents: Contents = {"urdf": (out, model.urdf(head)), "yaml": (yaml_path, beside)}
    finish_promised(folder, kept, {**document, "target": "urdf"}, "\n".join(lines), contents, as_json)


def classic(folder: Path, as_json: bool) -> None:
    """Print a pointing model by least squares, without gears."""
    from tvsbayes.report.head_document import pointing_table

    model = pointing_model(read_campaign(folder))
    finish(model.as_json(), pointing_table(model).text(), as_json)


def report(folder: Path, issue: Issue, quick: bool, pdf: bool, out: Path | None, as_json: bool) -> None:
    """Write the page of a head; fit first where results are missing."""
    HeadPage(folder, issue, quick).finish(pdf, out, as_json)


@dataclass
class HeadPage(Page):
    """The page of a head, which has no certificate."""

    stages: ClassVar = {FITTING: 3.0, DRAWING: 1.0}

    def document(self, job: Job) -> Document:
        """Make the document; fits first where results are missing."""
        from tvsbayes.estimators.plausibility import check_campaign
        from tvsbayes.report.head_document import head_document

        data = read_campaign(self.folder)
        record = StoredOrFitted(data, report_line, job.part(FITTING), self.tier).reported.record
        job.begin(DRAWING)
        return head_document(data, record, self.issue, check_campaign(data).warnings)
