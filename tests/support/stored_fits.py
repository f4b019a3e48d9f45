"""Files of a fit, made by hand: what a store of results wrote, or should refuse."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec import structs
from support.small_results import small_draws, small_record, whole_summary

from tvsbayes.calibration.calibration_file import calibration_arrays
from tvsbayes.calibration.pointing import Calibration
from tvsbayes.results.stored_draws import write_results


def npz(**arrays: object) -> bytes:
    """The bytes of an .npz."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def calibration_bytes(calibration: Calibration, **more: object) -> bytes:
    """A `draws.npz` by itself, as before ids."""
    return npz(**calibration_arrays(calibration), **more)


def store(results: Path, calibration: Calibration | None, **inputs: str) -> None:
    """Write the files of a fit of the small campaign, by default, with a calibration."""
    record = small_record(whole_summary())
    provenance = structs.replace(record.provenance, inputs=record.provenance.inputs | inputs)
    write_results(results, replace(record, provenance=provenance), small_draws(), calibration)


def edit_fit(results: Path, **keys: object) -> None:
    """Set keys of `fit.json`."""
    path = results / "fit.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | keys))
