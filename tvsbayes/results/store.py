"""The files of a fit in `results/`, of any instrument: written as one set and read as one set. NumPy alone.

Every file of a fit carries its id. All are prepared beside their places, then renamed, `fit.json` last; a reader takes
only draws of the id in `fit.json`. Files of 0.1 to 0.3 have no id: there the hashes of the inputs tie them.
"""

from __future__ import annotations

import datetime
import hashlib
import io
import json
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from tvsbayes.errors import InputError, Reason, escaped, refusal
from tvsbayes.files.disk import (
    RESULTS_BYTES_MAX,
    locked,
    make_folder,
    read_arrays,
    read_bytes,
    remove_unfinished,
    unwritable,
    write_together,
)
from tvsbayes.files.documents import JSON_BYTES_MAX, Keys, parse_json
from tvsbayes.files.packages import version_of

if TYPE_CHECKING:
    import numpy as np

    from tvsbayes.results.records import HasFolder

FIT, DRAWS, POSTERIOR, CHAIN, LOCK = "fit.json", "draws.npz", "posterior.nc", "chain.npz", "fit.lock"
INPUT_NAMES = {
    **{"moves": ("moves.csv",), "spots": ("spots.csv", "sightings.csv"), "readings": ("readings.csv",)},
    **{"stereo": ("stereo.json",), "rig": ("[rig]",), "axis": ("[axis]",)},
}
"""Names of the inputs of an estimate for the user: files of which a campaign has one, or a table."""
MODELS = ("rig", "axis")
"""Inputs whose canonical text another version writes in another way."""
AGAIN = "run `tvsbayes fit` on the folder again"
LOCK_BYTES_MAX = 1000


class FitFiles(NamedTuple):
    """`fit.json`, not yet held to its schema, and the arrays of `draws.npz`, of one fit."""

    keys: Keys
    arrays: dict[str, np.ndarray]


def fit_id(document: Mapping[str, object]) -> str:
    """The id of a fit: SHA-256 of its document, which states inputs, versions and seed, without the command."""
    content = {key: value for key, value in document.items() if key not in ("command", "fit_id")}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def write_fit(
    folder: Path, document: Mapping[str, object], arrays: Mapping[str, object], posterior: bytes | None = None
) -> dict[str, str]:
    """Write the files of a fit; a `posterior.nc` of another fit is removed.

    Args:
        folder: is created where it does not exist.
        document: content of `fit.json`, with `fit_id` and `inputs`.
        arrays: content of `draws.npz`; the id and the hashes of the inputs are added.
        posterior: content of `posterior.nc`, None for a fit without.

    Returns:
        Paths by "draws", "fit" and "posterior".

    Raises:
        InputError: the folder cannot be written; the files are then those of before.
    """
    fit, draws = json.dumps(document, indent=1, allow_nan=False).encode(), io.BytesIO()
    tie = {"fit_id": document["fit_id"], "inputs_sha256": json.dumps(document["inputs"])}
    # Within a command that writes: `--help` loads no array library.
    import numpy as np

    np.savez(draws, allow_pickle=False, **{name: np.asarray(array) for name, array in {**arrays, **tie}.items()})
    make_folder(folder)
    write_together(folder, {DRAWS: draws.getvalue(), POSTERIOR: posterior, FIT: fit})
    names = {"draws": DRAWS, "fit": FIT} | ({} if posterior is None else {"posterior": POSTERIOR})
    return {kind: str(folder / name) for kind, name in names.items()}


def read_fit_files(place: Path, inputs: Mapping[str, str] | None, *, other_models: bool = False) -> FitFiles | Reason:
    """Read the files of one fit, of these inputs; else the reason why there are none, in words.

    Args:
        place: the folder `results`.
        inputs: hashes of the campaign's inputs; None where there is no campaign.
        other_models: also take results without id of another version, where only `[rig]` or `[axis]` differ.

    Raises:
        InputError: a file is damaged.
    """
    if not (place / FIT).exists():
        interrupted = "results/ hold only an interrupted chain (`tvsbayes fit --resume`)"
        return Reason(interrupted if (place / CHAIN).exists() else "there are no results/ yet", AGAIN)
    keys = parse_json(read_bytes(place / FIT, JSON_BYTES_MAX), f"results/{FIT}")
    if inputs is not None and (why := _other_inputs(place.parent, keys, inputs, other_models)):
        return Reason(why, AGAIN)
    if not (place / DRAWS).exists():
        return Reason(f"results/ lack {DRAWS}", AGAIN)
    try:
        arrays = read_arrays(place / DRAWS, RESULTS_BYTES_MAX)
    except ValueError as error:
        raise damaged_draws(error) from error
    if not _of_one_fit(keys, arrays):
        return Reason(f"results/{DRAWS} is of another fit than {FIT}", AGAIN)
    return FitFiles(keys, arrays)


def stored_fit(campaign: HasFolder, inputs: Mapping[str, str]) -> FitFiles | Reason:
    """The files of the fit in a campaign's `results/`; as of `read_fit_files`."""
    if campaign.path is None:
        return Reason("there are no results/ yet", AGAIN)
    return read_fit_files(campaign.path / "results", inputs)


def damaged_draws(reason: object, allowed: str = "arrays as `tvsbayes fit` writes them") -> InputError:
    """Build the refusal of a `draws.npz` that tvsbayes did not write."""
    found = escaped(str(reason), 200)
    return refusal("damaged-results", file=f"results/{DRAWS}", found=found, allowed=allowed, remedy=AGAIN)


def _other_inputs(campaign: Path, keys: Keys, inputs: Mapping[str, str], other_models: bool) -> str:
    """Which inputs the results have not, in words; "" where they are of these inputs."""
    stored, versions = (keys.values.get(key) for key in ("inputs", "versions"))
    hashes, version = (value if isinstance(value, dict) else {} for value in (stored, versions))
    changed = [name for name, digest in inputs.items() if hashes.get(name) != digest]
    made_by = version.get("tvsbayes")
    if len(changed) == 1 and changed[0] in MODELS and made_by != version_of("tvsbayes"):
        if other_models and "fit_id" not in keys.values:
            return ""
        model, words = changed[0], f"results/ are of tvsbayes {escaped(str(made_by), 40)}, with another model of the"
        return f"{words} {model}, or of another [{model}]"
    names = [next((n for n in INPUT_NAMES[k] if (campaign / n).exists()), INPUT_NAMES[k][0]) for k in changed]
    return f"results/ are of other {', '.join(names)}" if names else ""


def _of_one_fit(keys: Keys, arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether the draws have the id of `fit.json`; without ids, the hashes that they state, if any."""
    if keys.values.get("fit_id") is not None or "fit_id" in arrays:
        return keys.values.get("fit_id") == str(arrays.get("fit_id"))
    if "tables" not in arrays:
        return True
    tables = parse_json(str(arrays["tables"]).encode(), f"results/{DRAWS}").values
    return tables.get("inputs_sha256") == keys.values.get("inputs")


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Hold the folder of a fit: nobody else fits into it until the block ends; files of killed fits are removed.

    The system releases the lock of a process that dies. On a disk without locks the folder is not held.

    Raises:
        InputError: another process fits into it, or it cannot be written.
    """
    is_new = not folder.exists()
    make_folder(folder)
    descriptor, is_alone = _lock_of(folder / LOCK)
    try:
        if is_alone is False:
            raise _other_writer(folder, os.read(descriptor, LOCK_BYTES_MAX).decode(errors="replace"))
        since = datetime.datetime.now(datetime.UTC).isoformat(" ", "seconds")
        # On a full disk the lock holds without its words.
        with suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()} on {platform.node()} since {since}".encode())
        if is_alone:
            remove_unfinished(folder, (FIT, DRAWS, POSTERIOR, CHAIN))
        try:
            yield
        finally:
            with suppress(OSError):
                (folder / LOCK).unlink()
                if is_new and not any(folder.iterdir()):
                    folder.rmdir()
    finally:
        os.close(descriptor)


def _lock_of(path: Path) -> tuple[int, bool | None]:
    """Open and lock a file; whether this process holds it alone, None on a disk without locks."""
    # A hostile folder may contain a link or a pipe of this name.
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    while True:
        try:
            descriptor = os.open(path, flags, 0o666)
        except OSError as error:
            raise unwritable(path, error, "a folder that can be written", "free it, or name another place") from error
        try:
            is_alone = locked(descriptor)
        except OSError:
            return descriptor, None
        # Its former holder may have removed it in between.
        with suppress(FileNotFoundError):
            if not is_alone or os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor, is_alone
        os.close(descriptor)


def _other_writer(folder: Path, holder: str) -> InputError:
    found = f"another fit of this folder: {escaped(holder, 200) or 'a process that has just begun'}"
    remedy = "wait for it or end it, or fit into another folder: `tvsbayes fit` has --out"
    return refusal(
        "locked", file=escaped(str(folder), 200), found=found, allowed="one fit of a folder at once", remedy=remedy
    )
