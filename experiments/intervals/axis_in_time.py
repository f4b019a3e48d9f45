"""Do the intervals of an axis hold where zeros creep, follow the temperature, and gears make waves?

    python -m experiments.intervals.axis_in_time run --n 200 --cores 0 1
    python -m experiments.intervals.axis_in_time table > experiments/intervals/axis_in_time.md

Axes are drawn from the priors, half of the requested waves are there (`twin/simulated_axis`, whose
formulas are its own), and fitted by weighted draws. A wave that is not there and is given a probability above 0.95 is a
false one. Amplitude, period and phase are tested on the waves that are there, given that there is one.
"""

from __future__ import annotations

import numpy as np

from experiments.common.against_truth import NOTE, scored, table
from experiments.common.command_line import study
from experiments.common.drawn_axes import drive
from experiments.common.page import heading, line
from experiments.common.rows import commit, commits_of
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_periods import wave_samples
from tvsbayes.single_axis.waves import WavePeriods
from tvsbayes.twin.simulated_axis import simulate_axis

SURE = 0.95
"""Probability from which on a wave is claimed."""
PROTOCOLS = {
    "one after the other": "10 places forward, then backward, warming by sd 0.1 deg of 40 while it is read",
    "stops": "24 uneven places to and fro, creep, temperature, a stated wave of 8 deg, an unknown one of 2.5 to 7",
    "drive": "400 readings in 1600 s at constant rate, seeing, an unknown wave of 60 to 600 s",
}
"""Of drawn axes; stops once a minute."""
PARAMETERS = ("per_command", "ratio_contrast", "backlash", "creep", "thermal_per_K")


def template(protocol: str, seed: int) -> AxisCampaign:
    """Moves beyond the low end, up, beyond the high end, down; statements and requested periods."""
    if protocol == "drive":
        return drive(seed)
    stated, places, periods = {"per_command": AxisPrior(0.01, 0.002)}, np.linspace(-2000, 2000, 10), WavePeriods()
    if protocol == "stops":
        places = np.sort(np.random.default_rng([seed, 99]).choice(np.arange(-2000.0, 2001.0, 10.0), 24, replace=False))
        periods = WavePeriods((8.0,), ((2.5, 7.0),))
    else:
        stated["creep"] = AxisPrior(0.0, 0.1)
    commands = [places[0] - 300.0, *places, places[-1] + 300.0, *places[::-1]]
    # The room cools and warms by some kelvin.
    degC = 20.0 + 3.0 * np.sin(np.arange(len(commands)) / 9.0 + seed)
    moves = tuple(
        AxisMove(k, 0, 60.0 * k, float(c), "" if k else "backward", float(t) if protocol == "stops" else None)
        for k, (c, t) in enumerate(zip(commands, degC, strict=True))
    )
    return AxisCampaign("deg", moves, (), stated, periods=periods)


def one_axis(task: tuple[str, int]) -> dict[str, object]:
    protocol, seed = task
    axis = simulate_axis(template(protocol, seed), seed=seed)
    fit = fit_axis(axis.campaign, tier="importance", seed=seed)
    true, draws, truths, samples = axis.truth.parameters, fit.draws, axis.truth.waves, wave_samples(fit)
    told = [name for name in PARAMETERS if name in draws and draws[name].std() > 0]
    quantities = {name: scored(draws[name], true[name]) for name in told if (protocol, name) != ("drive", "backlash")}
    # Of a range that holds one wave, what was added to it is a false one.
    waves: list[dict] = [{"there": False, "probability": sample.probability} for sample in samples[len(truths) :]]
    for wave, sample in zip(truths, samples, strict=False):
        one: dict = {"there": bool(wave.amplitude > 0), "probability": sample.probability, "quantities": {}}
        if wave.amplitude > 0:
            phase = sample.phase_deg()
            near = phase.mean() + (wave.phase_deg - phase.mean() + 180.0) % 360.0 - 180.0
            one["quantities"] = {"amplitude": scored(sample.amplitude, wave.amplitude), "phase": scored(phase, near)}
            if sample.wave.known is None:
                one["quantities"]["period"] = scored(np.log(sample.true_period), float(np.log(wave.period)))
        waves.append(one)
    row = {"protocol": protocol, "seed": seed, "commit": commit(), "problems": list(fit.missing)}
    return {**row, "quantities": quantities, "waves": waves}


TEXT = """# Axes that creep, follow the temperature and make waves

Made by `python -m experiments.intervals.axis_in_time`: axes drawn from the priors and fitted by `fit --quick`; {note}.
Amplitude, period and phase: of the waves that are there, given that there is one; of those too weak to be seen the
interval is wide. {axes} axes, commit {commit}.
"""


def page(every: list[dict]) -> None:
    print(TEXT.format(axes=len(every), commit=commits_of(every), note=NOTE))
    of = {p: [row for row in every if row["protocol"] == p and not row["problems"]] for p in PROTOCOLS}
    waves = {p: [wave for row in rows for wave in row["waves"]] for p, rows in of.items()}
    print(*(f"- {protocol}: {what}" for protocol, what in PROTOCOLS.items()), "", sep="\n")
    table({p: [row["quantities"] for row in rows] for p, rows in of.items()})
    table({p: [wave["quantities"] for wave in some if wave["there"]] for p, some in waves.items()})
    print("## Is there a wave?\n")
    print(heading(f"protocol | not there | claimed above {SURE:g} | there | claimed above {SURE:g} | not accepted"))
    for protocol, some in waves.items():
        chances = [[wave["probability"] for wave in some if wave["there"] is there] for there in (False, True)]
        cells = (cell for of in chances for cell in (len(of), sum(chance > SURE for chance in of)))
        print(line(protocol, *cells, sum(row["protocol"] == protocol for row in every) - len(of[protocol])))


if __name__ == "__main__":
    study(__file__, __doc__, one_axis, ("protocol", "seed"), PROTOCOLS, page, 200)
