"""Settings that must not change between two runs of a campaign, and settings that may.

A campaign has one rig: the meaning of its rows must not change between two of its runs. This concerns the content of
its files ([rig], the stereo calibration) and the meaning of a counter (the driver with its options, the counters at the
home switches). For a simulated campaign it also concerns the twin ([truth], sheets, the sd of its spots). The journal's
first event lists these entries, so that a refusal can name the changed one.

Everything else concerns how the instrument is connected and driven: port, baud, devices of the cameras, exposure,
limits, speeds, settling, watchdog, on the bench also the nominal positions of the sheets, which no estimate uses. It is
logged at every start and may change. Every resumed run begins a new segment, and its closing homing shows whether a
higher speed has lost steps. Costs concern only the planner.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence

from tvsbayes.acquisition.journal import Record
from tvsbayes.cameras.capture import without_password
from tvsbayes.errors import escaped, refusal
from tvsbayes.instrument.counter_limits import HOME_KEYS
from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES, LATE_NAMES, REGISTRY
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig, rig_table_toml
from tvsbayes.instrument.stereo_pair import stereo_bytes
from tvsbayes.positioner.interface import DEFAULT_DRIVER

ENTRIES_BYTES_MAX = 12_000
"""Largest size of the entries in a line of the journal; larger entries are replaced by their SHA-256."""
Entries = dict[str, object]
"""Entries of a rig file as JSON values, by table and key: "positioner.port"."""


def data_entries(rig: Rig, synthetic: bool) -> Entries:
    """Entries that must not change between two runs of a campaign.

    Args:
        rig: the rig.
        synthetic: whether the twin replaces the instrument.
    """
    table = rig.table
    entries: Entries = {f"rig.{name}": [prior.value, prior.u] for name, prior in table.priors.items()}
    entries["rig.aperture_convention"] = table.aperture_convention
    for axis, periods in table.harmonic_period_deg.items():
        entries[f"rig.harmonic_period_deg.{axis}"] = ", ".join(map(str, periods))
    entries["stereo"] = hashlib.sha256(stereo_bytes(rig.stereo_pair)).hexdigest()
    entries["positioner.driver"] = rig.positioner.get("driver", DEFAULT_DRIVER)
    entries |= {f"positioner.{key}": value for key, value in rig.positioner.items() if _means_counters(key)}
    if synthetic:
        entries |= {f"sheets.{name}": x_mm for name, x_mm in rig.sheets_mm.items()}
        entries["cameras.spot_sd_px"] = rig.spot_sd_px
        truth = {name: prior for name, prior in rig.truth.items() if prior != table.priors[name]}
        entries |= {f"truth.{name}": [prior.value, prior.u] for name, prior in truth.items()}
    return _fitted_to_line(entries)


def setup_entries(rig: Rig, synthetic: bool) -> Entries:
    """Entries that may change between two runs of a campaign, logged at every start, without passwords of cameras."""
    entries: Entries = {f"positioner.{key}": value for key, value in rig.positioner.items()}
    entries |= {f"cameras.{key}": value for key, value in rig.cameras.items()}
    entries |= {f"sheets.{name}": x_mm for name, x_mm in rig.sheets_mm.items()}
    fixed = data_entries(rig, synthetic)
    printable = {key: without_password(value) if isinstance(value, str) else value for key, value in entries.items()}
    return _fitted_to_line({key: value for key, value in printable.items() if key not in fixed})


def _means_counters(key: str) -> bool:
    return key in HOME_KEYS.values() or key.startswith("options.")


def _fitted_to_line(entries: Entries) -> Entries:
    text = json.dumps(entries, sort_keys=True)
    if len(text) <= ENTRIES_BYTES_MAX:
        return dict(json.loads(text))
    return {"entries": hashlib.sha256(text.encode()).hexdigest()}


def plan_sha256(plan: Sequence[PlanStep]) -> str:
    """SHA-256 of the steps of a plan, independent of its file."""
    rows = [(s.step, s.action, s.pan_steps, s.tilt_steps, s.target, s.experiment, s.point) for s in plan]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def identity(rig: Rig, plan: Sequence[PlanStep], synthetic: bool) -> dict[str, object]:
    """Entries of plan and rig in the first event of a journal."""
    return {"plan_sha256": plan_sha256(plan), "rig": data_entries(rig, synthetic)}


def check_same(created: Mapping[str, object], rig: Rig, plan: Sequence[PlanStep], header: Mapping[str, object]) -> None:
    """Refuses to continue with another plan, rig, seed or kind of instrument than at the journal's start.

    Args:
        created: entries of the journal's first event.
        rig: the present rig.
        plan: the present plan.
        header: the present `synthetic` and `seed`, as in `Created`.

    Raises:
        InputError: the changed entry, with old value, new value and remedy.
    """
    for name in ("synthetic", "seed"):
        if created.get(name) != header.get(name):
            allowed, remedy = f"{name} {created.get(name)}, as before", "give the options of the first run"
            raise refusal("changed", file=name, found=str(header.get(name)), allowed=allowed, remedy=remedy)
    if created.get("plan_sha256") != plan_sha256(plan):
        allowed = f"the plan that this campaign began with (SHA-256 {created.get('plan_sha256')})"
        remedy = "give the unchanged plan, or begin a new campaign in another folder"
        raise refusal("changed", file="plan", found="another plan", allowed=allowed, remedy=remedy)
    recorded = created.get("rig")
    if not isinstance(recorded, dict):
        _check_earlier(created, rig)
        return
    present = data_entries(rig, bool(header.get("synthetic")))
    # Journals may lack the scatter of looks and the shift of zeros, which their twins did not have.
    for name in LATE_NAMES:
        prior = REGISTRY[name].prior
        silent = {f"rig.{name}": [prior.value, prior.u], f"truth.{name}": [prior.value, 0.0]}
        present = {key: value for key, value in present.items() if key in recorded or value != silent.get(key)}
    changed = changes(recorded, present)
    if changed:
        (key, (old, new)), extra = next(iter(changed.items())), len(changed) - 1
        remark = f"; {extra} more entries differ: {', '.join(list(changed)[1:4])}" if extra else ""
        found = f"{_quoted(new)}, another rig than this campaign began with{remark}"
        remedy = "put the old value back, or begin a new campaign in another folder"
        column = _key_name(key)
        raise refusal("changed", file="rig file", column=column, found=found, allowed=_quoted(old), remedy=remedy)


def _check_earlier(created: Mapping[str, object], rig: Rig) -> None:
    """As `check_same`, for a journal with one SHA-256 of its rig, which includes port and cameras."""
    tables = json.dumps([rig.sheets_mm, rig.positioner, rig.cameras], sort_keys=True)
    # Later versions added the errors of the gears, with defaults.
    later = tuple(f'"{name}" = ' for name in GEAR_ERROR_NAMES)
    lines = rig_table_toml(rig.table).splitlines(keepends=True)
    table = "".join(line for line in lines if not line.startswith(later))
    content = table.encode() + stereo_bytes(rig.stereo_pair) + tables.encode()
    if created.get("rig_sha256") != hashlib.sha256(content).hexdigest():
        allowed = f"the rig file that this campaign began with (SHA-256 {created.get('rig_sha256')})"
        remedy = "give the unchanged rig file (port and cameras count too), or begin a new campaign in another folder"
        raise refusal("changed", file="rig file", found="another rig", allowed=allowed, remedy=remedy)


def changes(before: Mapping[str, object], now: Mapping[str, object]) -> dict[str, tuple[object, object]]:
    """Entries that differ, with old and new value; None for a missing one."""
    keys = [*before, *(key for key in now if key not in before)]
    return {key: (before.get(key), now.get(key)) for key in keys if before.get(key) != now.get(key)}


def setup_changes(records: Sequence[Record], rig: Rig, synthetic: bool) -> list[str]:
    """Changes of the setup since the last start, in words; empty before the first."""
    starts = [record.data.get("setup") for record in records if record.event == "start"]
    setup = starts[-1] if starts else None
    if not isinstance(setup, dict):
        return []
    return [
        f"{_key_name(key)} was {_quoted(old)} and is {_quoted(new)}: logged"
        for key, (old, new) in changes(setup, setup_entries(rig, synthetic)).items()
    ]


def _key_name(key: str) -> str:
    table, _, name = key.partition(".")
    return f"[{table}] {escaped(name)}" if name else key


def _quoted(value: object) -> str:
    """Format an entry for a message."""
    if value is None:
        return "not stated"
    if isinstance(value, list) and len(value) == 2:
        return f"value = {value[0]:g}, u = {value[1]:g}"
    return escaped(json.dumps(value), 80)
