"""A stereo calibration of another program, or a `stereo.json`, as a pair with a covariance.

No file of another program contains an uncertainty: an import gets the covariance of `assumed_covariance`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tvsbayes.cameras.assumed_covariance import GUESS_FACTOR, Provenance, with_assumed_covariance
from tvsbayes.errors import InputError, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.documents import JSON_BYTES_MAX
from tvsbayes.importing.stereo import foreign_pair
from tvsbayes.importing.stereo_trees import read_files
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stereo_pair import ASSUMED_REMEDY, Stereo, pair_doubts, parse_stereo, stereo_bytes

NO_PROVENANCE = Provenance()
ORIGIN = "the imported calibration"


@dataclass(frozen=True)
class Imported:
    """A calibration from another tool.

    Attributes:
        stereo: the pair, mm and px.
        source: the program that wrote it: opencv (also any other whose names are known), ros, kalibr ... or tvsbayes.
        notes: assumptions.
        warnings: implausible values (`pair_doubts`).
    """

    stereo: Stereo
    source: str
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def read_calibration(
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    *,
    unit_mm: float | None = None,
    stated: Provenance = NO_PROVENANCE,
    keys: Mapping[str, str] | None = None,
) -> Imported:
    """Read a stereo calibration from the files of another program, or from `stereo.json`.

    Args:
        paths: one file of a pair, two or three (one for each camera, or intrinsics and extrinsics), or arrays.
        size: image width and height, px, where the files do not state it.
        unit_mm: unit of lengths, mm; None: that of the format; with an implausible baseline the user must state it.
        stated: how the calibration was made, with its uncertainties, for the covariance, which no such file contains.
        keys: keys of M1, D1, M2, D2, R, T in the file, where their names are unknown.

    Raises:
        InputError: unreadable, unknown, contradictory, or of lenses that five coefficients do not describe.
    """
    files = read_files(paths)
    names = ", ".join(keys.file for keys in files)
    if len(paths) == 1 and str(files[0].values.get("format", "")).startswith("tvsbayes"):
        stereo = parse_stereo(read_bytes(paths[0], JSON_BYTES_MAX), files[0].file)
        if stated != NO_PROVENANCE:
            if not stereo.assumed:
                remedy = "leave out --rms-px, --views, --board, --pitch-mm, --u-...: they are for files without one"
                raise refusal("usage", file=names, found="its own covariance", allowed="no other", remedy=remedy)
            stereo = with_assumed_covariance(stereo, stated, NO_PROVENANCE)
        return Imported(stereo, "tvsbayes", (), pair_doubts(stereo))
    pair = foreign_pair(files, size, unit_mm, keys or {})
    bare = Stereo(**pair.values, parameter_covariance=np.zeros((24, 24)), rms_px=0.0, assumed=True)
    bare = parse_stereo(stereo_bytes(bare), ORIGIN)
    doubts = (*pair.warnings, *pair_doubts(bare, pair.places))
    try:
        stereo = with_assumed_covariance(bare, stated, Provenance(**pair.made))
    except InputError as error:
        if error.code != "no-common-view":
            raise
        hint = "; ".join(doubts) or "look at R, T and the image size"
        found = "two cameras that do not see one board together"
        raise refusal("no-common-view", file=names, found=found, allowed="a pair", remedy=hint) from error
    _check_determined(stereo, pair.places, doubts)
    good_to = f"all its sds together are correct within a factor of {GUESS_FACTOR:g}"
    notes = [*pair.notes, f"the file has no covariance: assumed from {stereo.assumed_from}; {good_to}"]
    return Imported(stereo, pair.source, (*notes, f"for a better one {ASSUMED_REMEDY}"), doubts)


def _check_determined(stereo: Stereo, places: Mapping[str, str], doubts: Sequence[str]) -> None:
    """Refuse a pair whose pictures determine no such lens, by the user's file and key.

    Raises:
        InputError: its covariance is none that `stereo.json` can hold.
    """
    try:
        stereo_bytes(stereo)
    except InputError as error:
        sds = np.sqrt(np.diag(stereo.parameter_covariance))
        worst = STEREO_PARAMETER_NAMES[int(np.argmax(sds))]
        side = "1" if "left" in worst else "2"
        matrix, (k1, k2, _, _, k3) = (getattr(stereo, f"{name}{side}") for name in "MD")
        lens = f"k1 {k1:.4g}, k2 {k2:.4g}, k3 {k3:.4g} at fx {matrix[0, 0]:.5g} px"
        remedy = f"is fx that of these pictures ({places[f'M{side}']})? calibrate again with k2 and k3 fixed at 0"
        raise refusal(
            "lens-model",
            file=places.get(f"D{side}", places[f"M{side}"]),
            found=f"{lens}, which no views of a board determine (sd of {worst}: {sds.max():.2g})",
            allowed="coefficients that the corners of pictures determine",
            remedy="; ".join([*doubts, remedy]),
        ) from error
