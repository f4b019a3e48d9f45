"""Do the intervals hold the truth of scanners that creep, follow the temperature and make waves?

    python -m experiments.intervals.rig_in_time run --n 300 --cores 0 1    # of each protocol, 10 CPU s a rig
    python -m experiments.intervals.rig_in_time table > experiments/intervals/rig_in_time.md

Rig i of a shipped protocol is drawn with seed i, every quantity from its prior: the mounted rig, whose zeros creep from
the first move on and shift with a recorded temperature. Rigs of odd seed state a period of both axes: pan has a wave
drawn from the prior of its amplitude, tilt has none. Each is simulated by the twin, fitted and sampled by importance.
The paper's protocol measures one direction after the other, which a creep resembles.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.common.against_truth import NOTE, USABLE, answers, failures, table, tried
from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.rigs import creeping_rig, shipped_plan
from experiments.common.rows import commit
from tvsbayes.assessment.gear_waves import gear_periods
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import names_of
from tvsbayes.instrument.rig import PERIODIC_NAMES, Rig
from tvsbayes.statistics.chances import binomial_bounds
from tvsbayes.twin.simulated_campaign import simulate

KEYS = ("kind", "seed")
PROTOCOLS = {"paper": "The paper's, one direction after the other", "mixed": "Mixed directions", "grid": "Grid"}
NAMES = names_of("creep_deg", "thermal_deg_per_K")
PERIOD_DEG, SURE = 12.0, 0.95
"""Of the stated wave; probability from which on a wave is claimed."""


def moving_rig(periodic: bool) -> Rig:
    """Priors and truths of a rig: the mounted one, whose zeros move in time, with periods or without."""
    rig = creeping_rig()
    if not periodic:
        return rig
    priors = {name: prior for name, prior in rig.table.priors.items() if name not in PERIODIC_NAMES}
    table = replace(rig.table, priors=priors, harmonic_period_deg={axis: (PERIOD_DEG,) for axis in AXES})
    wave = "harmonic_amplitude_deg.pan.1"
    return replace(rig, table=table, truth={**rig.truth, wave: TWO_MIRROR.priors[wave]})


def temperature_degC(time_s: np.ndarray) -> np.ndarray:
    """Of a room that swings by 2 K to either side in ten minutes."""
    return 20.0 + 2.0 * np.sin(2 * np.pi * time_s / 600.0)


def one_rig(task: tuple[str, int]) -> dict[str, object]:
    protocol, seed = task
    rig, options = moving_rig(seed % 2 == 1), {"aperture": protocol == "grid", "temperature_degC": temperature_degC}
    run = simulate(rig, shipped_plan(protocol), seed, **options)

    def waves(posterior) -> dict[str, object]:
        """Of each axis: whether amplitude and phase are in their intervals, how probable a wave is."""
        found = {}
        for wave in gear_periods(posterior):
            # The wave stands behind those of the aperiodic part.
            error = run.truth.gear_errors[wave.axis].error_deg
            true = complex(error.cosine_deg[-1], error.sine_deg[-1])
            (low, high), (first, last) = wave.amplitude.interval95, wave.phase_deg.interval95
            off = (np.degrees(np.angle(true)) - (first + last) / 2 + 180) % 360 - 180
            held = {"amplitude": bool(low <= abs(true) <= high), "phase": bool(abs(off) <= (last - first) / 2)}
            found[wave.axis] = {**held, "probability": round(wave.probability, 3)}
        return {"waves": found}

    row = {"kind": protocol, "seed": seed, "commit": commit()}
    return row | tried(run.campaign, run.truth, "importance", names=NAMES, more=waves)


TEXT = f"""# Coverage over scanners that creep, follow the temperature and make waves

Made by `python -m experiments.intervals.rig_in_time`. Mounted rigs drawn from their priors, whose zeros creep (sd 0.05
deg of 20 min) and shift by 0.01 deg/K (sd) with a recorded temperature; those of odd seed state a period of 12 deg.
Fitted and sampled by importance; judged are those accepted or rough. Rigs of one seed are one rig, measured by other
protocols. {NOTE}.
"""
WAVES_TEXT = f"""## Waves of stated period

Pan has a wave, tilt has none. Most stops of the paper's protocol and of the mixed one are half a period apart: they see
one phase of the wave. Those of the grid are not.

{heading(f"protocol | rigs | amplitude held | phase held | bounds | wave: P >= {SURE:g} | no wave: P >= {SURE:g}")}"""


def page(rows: list[dict]) -> None:
    print(TEXT)
    good = {kind: [r for r in rows if r["kind"] == kind and r["answer"] in USABLE] for kind in PROTOCOLS}
    for kind, title in PROTOCOLS.items():
        if mine := [row for row in rows if row["kind"] == kind]:
            print(f"## {title}\n\n{answers(mine, 'rig')}")
            table({kind: [row["posterior"] for row in good[kind]]})
            failures(mine, KEYS)
    print(WAVES_TEXT)
    for kind, title in PROTOCOLS.items():
        if waves := [row["waves"] for row in good[kind] if row.get("waves")]:
            held = (f"{100 * np.mean([w['pan'][part] for w in waves]):.1f} %" for part in ("amplitude", "phase"))
            bounds = "{:.0f} to {:.0f} %".format(*(100 * share for share in binomial_bounds(len(waves), 0.95)))
            claimed = (sum(w[axis]["probability"] >= SURE for w in waves) for axis in AXES)
            print(line(title, len(waves), *held, bounds, *(f"{count} of {len(waves)}" for count in claimed)))


if __name__ == "__main__":
    study(__file__, __doc__, one_rig, KEYS, PROTOCOLS, page, 300)
