"""What must stay the same for an interrupted run to go on, and what may change meanwhile.

A campaign has one rig: what its rows mean must not change between two of its runs. That is what stands in its files
([rig], the stereo calibration) and what a counter means (the driver with its options, the counters at the home
switches); of a simulated campaign also what the twin is made of ([truth], sheets, the sd of its spots). It is written
into the journal's first event entry by entry, so that a refusal can name the one that changed.

Everything else says only how the instrument is reached and driven: port, baud, devices of the cameras, exposure,
limits, speeds, settling, watchdog, on the bench the nominal places of the sheets, which no estimate uses. It is logged
at every start and may change. Every resumed run begins a new segment, and its closing homing tells whether a higher
speed has lost steps. Costs are the planner's.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence

from tvsbayes.acquisition.journal import Record
from tvsbayes.cameras.capture import without_password
from tvsbayes.errors import escaped, refusal
from tvsbayes.instrument.counter_limits import HOME_KEYS
from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES, LATE_NAMES, RIG_PRIORS
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig, rig_table_toml
from tvsbayes.instrument.stereo_pair import stereo_bytes
from tvsbayes.positioner.interface import DEFAULT_DRIVER

ENTRIES_BYTES_MAX = 12_000
"""Entries beyond this would not fit into a line of the journal: then only their SHA-256 stands there."""
Entries = dict[str, object]
"""Entries of a rig file as JSON holds them, by table and key: "positioner.port"."""


def data_entries(rig: Rig, synthetic: bool) -> Entries:
    """What must not change between two runs of a campaign.

    Args:
        rig: the rig.
        synthetic: whether the twin stands in for the instrument.
    """
    table = rig.table
    entries: Entries = {f"rig.{name}": [prior.value, prior.u] for name, prior in table.priors.items()}
    entries["rig.aperture_convention"] = table.aperture_convention
    for axis, periods in table.harmonic_period_deg.items():
        entries[f"rig.harmonic_period_deg.{axis}"] = ", ".join(map(str, periods))
    entries["stereo"] = hashlib.sha256(stereo_bytes(rig.stereo)).hexdigest()
    entries["positioner.driver"] = rig.positioner.get("driver", DEFAULT_DRIVER)
    entries |= {f"positioner.{key}": value for key, value in rig.positioner.items() if _means_counters(key)}
    if synthetic:
        entries |= {f"sheets.{name}": x_mm for name, x_mm in rig.sheets_mm.items()}
        entries["cameras.spot_sd_px"] = rig.spot_sd_px
        stated = {name: prior for name, prior in rig.truth.items() if prior != table.priors[name]}
        entries |= {f"truth.{name}": [prior.value, prior.u] for name, prior in stated.items()}
    return _short(entries)


def setup_entries(rig: Rig, synthetic: bool) -> Entries:
    """What may change between two runs of a campaign, and is logged at every start, without passwords of cameras."""
    entries: Entries = {f"positioner.{key}": value for key, value in rig.positioner.items()}
    entries |= {f"cameras.{key}": value for key, value in rig.cameras.items()}
    entries |= {f"sheets.{name}": x_mm for name, x_mm in rig.sheets_mm.items()}
    fixed = data_entries(rig, synthetic)
    shown = {key: without_password(value) if isinstance(value, str) else value for key, value in entries.items()}
    return _short({key: value for key, value in shown.items() if key not in fixed})


def _means_counters(key: str) -> bool:
    return key in HOME_KEYS.values() or key.startswith("options.")


def _short(entries: Entries) -> Entries:
    text = json.dumps(entries, sort_keys=True)
    if len(text) <= ENTRIES_BYTES_MAX:
        return dict(json.loads(text))
    return {"entries": hashlib.sha256(text.encode()).hexdigest()}


def plan_sha256(plan: Sequence[PlanStep]) -> str:
    """What makes a plan the same plan: its steps, not its file."""
    rows = [(s.step, s.action, s.pan_steps, s.tilt_steps, s.target, s.experiment, s.point) for s in plan]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def identity(rig: Rig, plan: Sequence[PlanStep], synthetic: bool) -> dict[str, object]:
    """What the first event of a journal says of plan and rig."""
    return {"plan_sha256": plan_sha256(plan), "rig": data_entries(rig, synthetic)}


def check_same(before: Mapping[str, object], rig: Rig, plan: Sequence[PlanStep], header: Mapping[str, object]) -> None:
    """Refuses to go on with another plan, rig, seed or kind of instrument than the journal began with.

    Args:
        before: data of the journal's first event.
        rig: the rig now.
        plan: the plan now.
        header: `synthetic` and `seed` now, as `Created` has them.

    Raises:
        InputError: what changed, from what to what, and what to do.
    """
    for name in ("synthetic", "seed"):
        if before.get(name) != header.get(name):
            allowed, remedy = f"{name} {before.get(name)}, as before", "give the options of the first run"
            raise refusal("changed", file=name, found=str(header.get(name)), allowed=allowed, remedy=remedy)
    if before.get("plan_sha256") != plan_sha256(plan):
        allowed = f"the plan that this campaign began with (SHA-256 {before.get('plan_sha256')})"
        remedy = "give the unchanged plan, or begin a new campaign in another folder"
        raise refusal("changed", file="plan", found="another plan", allowed=allowed, remedy=remedy)
    began = before.get("rig")
    if not isinstance(began, dict):
        _check_earlier(before, rig)
        return
    now = data_entries(rig, bool(header.get("synthetic")))
    # Journals from before looks scattered and zeros shifted say nothing of it, and their twins had none.
    for name in LATE_NAMES:
        prior = RIG_PRIORS[name]
        silent = {f"rig.{name}": [prior.value, prior.u], f"truth.{name}": [prior.value, 0.0]}
        now = {key: value for key, value in now.items() if key in began or value != silent.get(key)}
    changed = changes(began, now)
    if changed:
        (key, (old, new)), more = next(iter(changed.items())), len(changed) - 1
        others = f"; {more} more entries differ: {', '.join(list(changed)[1:4])}" if more else ""
        found = f"{_value(new)}, another rig than this campaign began with{others}"
        remedy = "put the old value back, or begin a new campaign in another folder"
        raise refusal("changed", file="rig file", column=_place(key), found=found, allowed=_value(old), remedy=remedy)


def _check_earlier(before: Mapping[str, object], rig: Rig) -> None:
    """The same of a journal that knows its rig by one SHA-256 only, port and cameras included."""
    tables = json.dumps([rig.sheets_mm, rig.positioner, rig.cameras], sort_keys=True)
    # The errors of the gears came later, with defaults.
    later = tuple(f'"{name}" = ' for name in GEAR_ERROR_NAMES)
    lines = rig_table_toml(rig.table).splitlines(keepends=True)
    known = "".join(line for line in lines if not line.startswith(later))
    content = known.encode() + stereo_bytes(rig.stereo) + tables.encode()
    if before.get("rig_sha256") != hashlib.sha256(content).hexdigest():
        allowed = f"the rig file that this campaign began with (SHA-256 {before.get('rig_sha256')})"
        remedy = "give the unchanged rig file (port and cameras count too), or begin a new campaign in another folder"
        raise refusal("changed", file="rig file", found="another rig", allowed=allowed, remedy=remedy)


def changes(before: Mapping[str, object], now: Mapping[str, object]) -> dict[str, tuple[object, object]]:
    """Entries that differ, as they were and as they are; None where there is none."""
    keys = [*before, *(key for key in now if key not in before)]
    return {key: (before.get(key), now.get(key)) for key in keys if before.get(key) != now.get(key)}


def setup_changes(records: Sequence[Record], rig: Rig, synthetic: bool) -> list[str]:
    """What of the setup has changed since the last start, in words; nothing before the first."""
    starts = [record.data.get("setup") for record in records if record.event == "start"]
    before = starts[-1] if starts else None
    if not isinstance(before, dict):
        return []
    return [
        f"{_place(key)} was {_value(old)} and is {_value(new)}: logged"
        for key, (old, new) in changes(before, setup_entries(rig, synthetic)).items()
    ]


def _place(key: str) -> str:
    table, _, name = key.partition(".")
    return f"[{table}] {escaped(name)}" if name else key


def _value(value: object) -> str:
    """An entry as a message quotes it."""
    if value is None:
        return "not stated"
    if isinstance(value, list) and len(value) == 2:
        return f"value = {value[0]:g}, u = {value[1]:g}"
    return escaped(json.dumps(value), 80)
