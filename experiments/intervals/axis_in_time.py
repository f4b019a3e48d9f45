"""Do the intervals of an axis hold where zeros creep, follow the temperature, and gears make waves?

    python -m experiments.intervals.axis_in_time run --n 200 --cores 0 1
    python -m experiments.intervals.axis_in_time table > experiments/intervals/axis_in_time.md

Axes are drawn from the priors, half of the requested waves are there (`twin/simulated_axis`, whose
formulas are its own), and fitted by weighted draws. A wave that is not there and is given a probability above 0.95 is a
false one. Amplitude, period and phase are tested on the waves that are there, given that there is one.
"""

from __future__ import annotations

import numpy as np

from experiments.common.command_line import study
from experiments.common.drawn_axes import drive, scored, scores_line
from experiments.common.page import line
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


def _stops(places: np.ndarray, seed: int) -> tuple[AxisMove, ...]:
    """Beyond the low end, up, beyond the high end, down; the room cools and warms by some kelvin."""
    commands = [places[0] - 300.0, *places, places[-1] + 300.0, *places[::-1]]
    kelvin = 20.0 + 3.0 * np.sin(np.arange(len(commands)) / 9.0 + seed)
    return tuple(
        AxisMove(k, 0, 60.0 * k, float(c), "" if k else "backward", float(t))
        for k, (c, t) in enumerate(zip(commands, kelvin, strict=True))
    )


def template(protocol: str, seed: int) -> AxisCampaign:
    """Moves, statements and requested periods."""
    if protocol == "drive":
        return drive(seed)
    stated = {"per_command": AxisPrior(0.01, 0.002)}
    if protocol == "stops":
        places = np.sort(np.random.default_rng([seed, 99]).choice(np.arange(-2000.0, 2001.0, 10.0), 24, replace=False))
        periods = WavePeriods((8.0,), ((2.5, 7.0),))
        return AxisCampaign("deg", _stops(places, seed), (), stated, periods=periods)
    moves = tuple(
        AxisMove(m.move, m.segment, m.time_s, m.command, m.approach) for m in _stops(np.linspace(-2000, 2000, 10), seed)
    )
    return AxisCampaign("deg", moves, (), stated | {"creep": AxisPrior(0.0, 0.1)})


def one_axis(task: tuple[str, int]) -> dict[str, object]:
    """Draw, read and fit one axis."""
    protocol, seed = task
    axis = simulate_axis(template(protocol, seed), seed=seed)
    fit = fit_axis(axis.campaign, tier="importance", seed=seed)
    true, draws = axis.truth.parameters, fit.draws
    row: dict[str, object] = {"protocol": protocol, "seed": seed, "commit": commit(), "waves": []}
    row["problems"] = list(fit.missing)
    for name in PARAMETERS:
        if name in draws and draws[name].std() > 0 and not (protocol == "drive" and name == "backlash"):
            row[name] = scored(draws[name], true[name])
    samples, truths = wave_samples(fit), axis.truth.waves
    # Of a range that holds one wave, what was added to it is a false one.
    waves: list[dict[str, object]] = [
        {"there": False, "probability": sample.probability} for sample in samples[len(truths) :]
    ]
    for wave, sample in zip(truths, samples, strict=False):
        one: dict[str, object] = {"there": bool(wave.amplitude > 0), "probability": sample.probability}
        if wave.amplitude > 0:
            one["amplitude"] = scored(sample.amplitude, wave.amplitude)
            phase = sample.phase_deg()
            one["phase"] = scored(phase, phase.mean() + (wave.phase_deg - phase.mean() + 180.0) % 360.0 - 180.0)
            if sample.wave.known is None:
                one["period"] = scored(np.log(sample.true_period), float(np.log(wave.period)))
        waves.append(one)
    return {**row, "waves": waves}


TEXT = """# Axes that creep, follow the temperature and make waves

Made by `python -m experiments.intervals.axis_in_time`: axes drawn from the priors and fitted by `fit --quick`. Shares
of truths in central intervals, RMS of z = (mean - truth) / sd; bounds are two-sided at 1e-4 for so many axes.
Amplitude, period and phase: of the waves that are there, given that there is one; of those too weak to be seen the
interval is wide. {axes} axes, commit {commit}.

| protocol | quantity | axes | in 50 % | bounds | in 95 % | bounds | RMS z | bounds |
|---|---|---|---|---|---|---|---|---|"""
WAVES_TEXT = """
## Is there a wave?

| protocol | waves that are not there | claimed above 0.95 | waves that are there | claimed above 0.95 | not accepted |
|---|---|---|---|---|---|"""


def table(every: list[dict]) -> None:
    """Both tables."""
    rows = [row for row in every if not row["problems"]]
    print(TEXT.format(axes=len(every), commit=commits_of(every)))
    for protocol, what in PROTOCOLS.items():
        mine = [row for row in rows if row["protocol"] == protocol]
        for name in PARAMETERS:
            if scores := [row[name] for row in mine if name in row]:
                print(scores_line(f"{protocol}: {what}", name, scores))
        waves = [wave for row in mine for wave in row["waves"] if wave["there"]]
        for name in ("amplitude", "period", "phase"):
            if scores := [wave[name] for wave in waves if name in wave]:
                print(scores_line(protocol, name, scores))
    print(WAVES_TEXT)
    for protocol in PROTOCOLS:
        mine = [row for row in rows if row["protocol"] == protocol]
        refused = sum(row["protocol"] == protocol for row in every) - len(mine)
        waves = [wave for row in mine for wave in row["waves"]]
        cells = [protocol]
        for there in (False, True):
            chances = [wave["probability"] for wave in waves if wave["there"] is there]
            cells += [str(len(chances)), str(sum(chance > SURE for chance in chances))]
        if waves:
            print(line(*cells, refused))


if __name__ == "__main__":
    study(__file__, __doc__, one_axis, ("protocol", "seed"), PROTOCOLS, table, 200)
