"""An axis that is drawn, not measured: true gears from the priors, moved by a list of moves, read with noise.

Written from the definition (formulation 8.1), one stop after the other; it shares no formula with the model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.files.disk import write_atomically
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading, write_axis
from tvsbayes.single_axis.axis_parameters import CONTRAST_SHARE, AxisPrior, axis_priors, kind_of

READING_SHARE = 5e-5
"""Stated u of simulated readings, of the travel, where nothing else is known."""
TRUTH_FORMAT = "tvsbayes-axis-truth/1"


@dataclass(frozen=True)
class AxisTruth:
    """A true axis.

    Attributes:
        parameters: by the names of `[axis]`, stop scatter by direction, with `ratio_contrast`.
        command: positions at which both curves are given, ascending, shape (n,).
        error: of the position, and `play_variation`: about the mean play; unit, each (n,).
    """

    parameters: dict[str, float]
    command: np.ndarray
    error: np.ndarray
    play_variation: np.ndarray

    def as_json(self) -> dict[str, object]:
        """The content of `truth.json`."""
        curves = {"command": self.command, "error": self.error, "play_variation": self.play_variation}
        lists = {name: values.tolist() for name, values in curves.items()}
        return {"format": TRUTH_FORMAT, "parameters": self.parameters, **lists}


@dataclass(frozen=True, repr=False)
class SimulatedAxis(Shown):
    """A campaign and the truth behind it."""

    campaign: AxisCampaign
    truth: AxisTruth

    def shown(self) -> View:
        """Its campaign; the truth stands in `truth`."""
        view = self.campaign.shown()
        return replace(view, title=f"Simulated {view.title}; the truth is in .truth")

    def write(self, folder: Path) -> None:
        """Campaign folder with `truth.json`."""
        write_axis(self.campaign, folder)
        write_atomically(folder / "truth.json", json.dumps(self.truth.as_json(), indent=1, allow_nan=False).encode())


def _drawn(name: str, prior: AxisPrior, rng: np.random.Generator) -> float:
    kind = kind_of(name)
    normal = float(rng.standard_normal())
    if kind == "log-normal":
        return prior.value * float(np.exp(prior.u * normal))
    # True play is never negative, whatever a fit allows for.
    return abs(prior.value + prior.u * normal) if kind == "half-normal" or name == "backlash" else prior.value


def _curve(distance: np.ndarray, length: float, sd: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth curve at points of these mutual distances (n, n)."""
    a = np.sqrt(5.0) * np.abs(distance) / length
    values, vectors = np.linalg.eigh((1 + a + a * a / 3) * np.exp(-a))
    return sd * (vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values))))


def draw_axis(
    commands: Sequence[float],
    stated: Mapping[str, AxisPrior],
    per_command: float,
    travel: float,
    rng: np.random.Generator,
) -> AxisTruth:
    """A true axis for a list of commands.

    Args:
        commands: of all moves.
        stated: entries of `[axis]`.
        per_command: true unit per command; `[axis]` says only how well it is known beforehand.
        travel: range of what is read, unit, with which default scales grow.
        rng: source of everything random.
    """
    at = np.unique(np.asarray(commands, dtype=float))
    priors = axis_priors(stated, travel, per_command)
    names = [
        *(name for name in priors if name not in ("per_command", "stop_sd")),
        "stop_sd.forward",
        "stop_sd.backward",
    ]
    true = {name: _drawn(name, priors[name.split(".")[0]], rng) for name in names}
    true["per_command"] = per_command
    true["ratio_contrast"] = CONTRAST_SHARE * abs(per_command) * float(rng.standard_normal())
    distance = abs(per_command) * (at[:, None] - at)
    length = max(true["transmission_error_length"], 1e-9 * travel)
    error = _curve(distance, length, true["transmission_error"], rng)
    play = _curve(distance, length, true["play_variation"], rng)
    return AxisTruth(true, at, error, play)


def stops_of(truth: AxisTruth, moves: Sequence[AxisMove], rng: np.random.Generator) -> np.ndarray:
    """Where the output stands after every move, unit, shape (moves,)."""
    true = truth.parameters
    ratio, contrast, backlash = true["per_command"], true["ratio_contrast"], true["backlash"]
    found = np.empty(len(moves))
    wheel = stand = zero = stop = 0.0
    side = 0
    last: AxisMove | None = None
    for row, move in enumerate(moves):
        if last is None or move.segment != last.segment:
            home = 0.0 if last is None else true["home_sd"] * float(rng.standard_normal())
            wheel, zero = ratio * move.command + home, 0.0
            side = {"forward": 1, "backward": -1}.get(move.approach, 0)
            turned = side * np.sign(ratio)
            share = -turned if side else rng.uniform(-1.0, 1.0)
            stand = wheel + 0.5 * share * backlash
            fresh = True
        else:
            step = move.command - last.command
            wheel += (ratio + 0.5 * contrast * np.sign(step)) * step
            stand = min(max(stand, wheel - 0.5 * backlash), wheel + 0.5 * backlash)
            side = int(np.sign(step)) or side
            hours = (move.time_s - last.time_s) / 3600.0
            zero += true["drift_per_root_hour"] * np.sqrt(hours) * float(rng.standard_normal())
            fresh = step != 0
        if fresh:
            sd = true["stop_sd.backward"] if side < 0 else true["stop_sd.forward"]
            stop = sd * float(rng.standard_normal())
        place = int(np.searchsorted(truth.command, move.command))
        share = 2 * (stand - wheel) / backlash if backlash else -side * np.sign(ratio)
        found[row] = stand + truth.error[place] + 0.5 * share * truth.play_variation[place] + zero + stop
        last = move
    return found


def simulate_axis(
    template: AxisCampaign, moves: Sequence[AxisMove] | None = None, seed: int = 0, repeats: int = 1
) -> SimulatedAxis:
    """An axis with the priors of a folder, moved as listed and read after every move.

    Args:
        template: unit, `[axis]`; its readings, where there are any, say how far a command goes and how well it is read.
        moves: to make; None for those of the template, read where it has readings (everywhere if it has none).
        seed: of the true axis, its stops and the noise.
        repeats: readings at each.

    Raises:
        InputError: neither `[axis]` nor readings say what one command does.
        NothingToEstimate: the readings do not say it.
    """
    rng = np.random.default_rng([seed, 11])
    read = {r.move for r in template.readings} if moves is None and template.readings else None
    moves = template.moves if moves is None else tuple(moves)
    per_command = _per_command(template)
    commands = [m.command for m in moves]
    seen = [m.command for m in moves if read is None or m.move in read]
    travel = (max(seen) - min(seen)) * abs(per_command)
    if not travel > 0:
        raise NothingToEstimate("too-few-positions", "all moves are to one position", remedy="list more positions")
    truth = draw_axis(commands, template.stated, per_command, travel, rng)
    stated = [r.u for r in template.readings if r.u > 0]
    u = float(np.median(stated)) if stated else READING_SHARE * travel
    stops = stops_of(truth, moves, rng)
    readings: list[Reading] = []
    for move, stand in zip(moves, stops, strict=True):
        for _ in range(repeats if read is None or move.move in read else 0):
            noise = truth.parameters["reading_scale"] * u * float(rng.standard_normal())
            readings.append(Reading(len(readings), move.move, float(stand + noise), u))
    header = {**template.header, "synthetic": True, "seed": seed}
    campaign = replace(template, moves=moves, readings=tuple(readings), header=header, path=None)
    return SimulatedAxis(campaign, truth)


def _per_command(template: AxisCampaign) -> float:
    if "per_command" in template.stated:
        return template.stated["per_command"].value
    seen = (r for r in template.readings if r.status == "ok" and r.value is not None)
    used = [(template.moves[r.move].command, r.value) for r in seen]
    if len({command for command, _ in used}) < 2:
        raise InputError(
            "unstated",
            "campaign.toml: nothing says what one command does",
            file="campaign.toml",
            column="axis.per_command",
            remedy="add per_command = { value = ..., u = ... } to [axis]",
        )
    command, value = np.array(used, dtype=float).T
    slope = float(np.polyfit(command, value, 1)[0])
    if slope == 0:
        raise NothingToEstimate("no-motion", "the readings do not move with the command", remedy="state per_command")
    return slope
