"""What do two nights of a telescope's pointing say, and does one predict the other?

    python -m experiments.real.pointing run FOLDER        # tables as `import --format pointing` takes them
    python -m experiments.real.pointing table > experiments/real/pointing.md

Every table is fitted three times: by least squares of the small-angle model (`small_angles`, nothing of the package in
it), by `classic` of the package, exact rotations, and by the joint model, sampled by importance. Then every second star
is left out of the joint fit and predicted. `table` compares the terms, and the nights with each other.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from experiments.common.against_truth import rms as spread
from experiments.common.command_line import act, parser
from experiments.common.page import heading
from experiments.common.rows import append_row, output, read_rows
from tvsbayes.assessment.weaknesses import weak_directions
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.head.pointing_model import PointingModel, pointing_model
from tvsbayes.head.pointing_table import AZIMUTH_FROM_DEG, Star, campaign_of, read_stars
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.sightings import sightings_of
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.predictive import looks_again
from tvsbayes.posterior.sampling import sample
from tvsbayes.statistics.chances import rms_bounds

ROWS = output(__file__, "pointing.jsonl")
TERMS = {
    "IA": ("azimuth_zero_deg", -1),
    "IE": ("elevation_zero_deg", 1),
    "AN": ("azimuth_axis_tilt_deg.north", 1),
    "AW": ("azimuth_axis_tilt_deg.east", -1),
    "CA": ("beam_not_square_deg", 1),
    "NPAE": ("axes_not_square_deg", 1),
    "TF": ("flexure_deg", 1),
    "TX": ("tangent_flexure_deg", 1),
}
"""TPOINT's terms by the package's names and signs."""
GEARS = ("backlash_deg.pan", "backlash_deg.tilt", *(f"stop_sd_deg.{d}" for d in ("left", "right", "up", "down")))
ARCSEC = 3600.0
PREDICTED_DRAWS = 512


def small_angles(stars: tuple[Star, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """TPOINT's linear model by ordinary least squares: terms, standard errors, residuals on the sky (n, 2), arcsec.

    Azimuth differences times cos(elevation), so that stars high up weigh no more than others.
    """
    encoder, true = (np.array([getattr(star, name) for star in stars]) for name in ("encoder_deg", "true_deg"))
    elevation, azimuth = np.radians(true[:, 0]), np.radians(AZIMUTH_FROM_DEG - true[:, 1])
    off = ((encoder[:, 1] - true[:, 1]) + 180.0) % 360.0 - 180.0
    offsets = ARCSEC * np.concatenate([off * np.cos(elevation), true[:, 0] - encoder[:, 0]])
    se, ce, sa, ca, none = *(f(elevation) for f in (np.sin, np.cos)), np.sin(azimuth), np.cos(azimuth), 0 * azimuth
    # Columns IA IE AN AW CA NPAE TF TX; azimuth times cos(elevation) above, elevation below.
    upper = [-ce, none, -sa * se, -ca * se, none - 1, -se, none, none]
    lower = [none, none + 1, -ca, sa, none, none, -ce, -ce / se]
    design = np.concatenate([np.stack(upper, axis=1), np.stack(lower, axis=1)])
    terms, _, _, _ = np.linalg.lstsq(design, offsets, rcond=None)
    left = offsets - design @ terms
    variance = left @ left / (len(offsets) - len(terms))
    return terms, np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design))), left.reshape(2, -1).T


def rms_arcsec(residual_deg: np.ndarray) -> float:
    """Of the distance on the sphere."""
    return float(ARCSEC * np.sqrt(np.mean(np.sum(residual_deg**2, axis=1))))


def predicted(campaign: Campaign) -> dict[str, object]:
    """Every second star left out of the joint fit and predicted by it: z, and arcsec, of both angles."""
    spots = ordered_spots(campaign)
    out = np.arange(len(spots)) % 2 == 1
    model = fit(campaign, without={spot.spot for spot, left in zip(spots, out, strict=True) if left})
    rng, draws = np.random.default_rng(3), PREDICTED_DRAWS
    physical, errors = np.asarray(model.draws.physical)[:draws], np.asarray(model.draws.place_errors_rad)[:draws]
    again = looks_again(model, model.draws_z[:draws], physical, errors, rng)[:, out, 1:3]
    mean, sd = again.mean(axis=0), again.std(axis=0)
    return {"z": (-mean / sd).ravel().tolist(), "rms": rms_arcsec(np.degrees(mean)), "stars": int(out.sum())}


def night(file: Path) -> dict[str, object]:
    """All results of one table."""
    began, stars = time.process_time(), read_stars(file).stars
    terms, errors, left = small_angles(stars)
    campaign = campaign_of(stars, file.stem)
    classic = pointing_model(campaign)
    by_name = {n: (v, e) for n, v, e in zip(classic.names, classic.value, classic.standard_error, strict=True)}
    model = fit(campaign)
    posterior = sample(model, "importance")
    weights, draws = posterior.weights.ravel(), posterior.by_name

    def stated(name: str, sign: int = 1) -> tuple[float, float]:
        mean = float(weights @ draws[name])
        return sign * ARCSEC * mean, ARCSEC * float(np.sqrt(weights @ (draws[name] - mean) ** 2))

    row = {"file": file.name, "stars": len(stars), "left_out": predicted(campaign), "problems": list(model.problems)}
    row["least"] = {n: (float(v), float(e)) for n, v, e in zip(TERMS, terms, errors, strict=True)}
    row["classic"] = {n: [s * ARCSEC * by_name[t][0], ARCSEC * by_name[t][1]] for n, (t, s) in TERMS.items()}
    row |= {"least_rms": float(np.sqrt(np.mean(np.sum(left**2, axis=1)))), "classic_rms": ARCSEC * classic.rms_deg}
    row |= {"joint": {n: stated(*term) for n, term in TERMS.items()}, "gears": {name: stated(name) for name in GEARS}}
    row["weak"] = [weak.text for weak in weak_directions(model)]
    return {**row, "answer": posterior.convergence.answer, "cpu_s": time.process_time() - began}


def between(folder: Path) -> dict[str, object]:
    """Night one's least-squares terms on night two: arcsec before, after, and after with zeros of its own."""
    one, two = (campaign_of(read_stars(file).stars, file.stem) for file in sorted(folder.glob("*.dat"))[:2])
    taught, new = pointing_model(one), pointing_model(two)
    rows = sightings_of(ordered_spots(two))
    bare = PointingModel((), np.zeros(0), np.zeros(0), np.zeros((0, 2)), {**new.known, **dict.fromkeys(new.names, 0.0)})
    off, raw = taught.off_deg(two, rows), bare.off_deg(two, rows)
    return {"file": "between", "before": rms_arcsec(raw), "after": rms_arcsec(off), "own": rms_arcsec(new.residual_deg)}


def run(arguments: argparse.Namespace) -> None:
    """A row for every table that is not there yet, and one of the first two nights together."""
    use_compilation_cache()
    done = {row["file"] for row in read_rows(ROWS)}
    for file in sorted(arguments.folder.glob("*.dat")):
        if file.name not in done:
            append_row(ROWS, night(file))
    if "between" not in done:
        append_row(ROWS, between(arguments.folder))


TEXT = """# Two nights of a telescope

Made by `python -m experiments.real.pointing`. Pointing tables of a 6.5 m telescope with encoders on both axes
(MMTObservatory/pytelpoint, commit e6230b9350, BSD-3), read by `import --format pointing`. Arcsec; least squares:
TPOINT's linear terms, standard errors by the residuals; exact: `classic` of the package; joint: mean and sd of the
posterior."""


def table(_: argparse.Namespace) -> None:
    """Terms of each night, stars left out, and one night against the other."""
    every = read_rows(ROWS)
    rows = [row for row in every if row["file"] != "between"]
    print(TEXT)
    for row in rows:
        held = row["left_out"]
        rms, (low, high) = spread(held["z"]), rms_bounds(len(held["z"]))
        print(f"\n## `{row['file']}`, {row['stars']} stars\n\n{heading('term | least squares | exact | joint')}")
        for name in TERMS:
            cells = (f"{row[kind][name][0]:.2f} ({row[kind][name][1]:.2f})" for kind in ("least", "classic", "joint"))
            print(f"| {name} | {' | '.join(cells)} |")
        print(f"| RMS on the sky | {row['least_rms']:.2f} | {row['classic_rms']:.2f} | |\n")
        gears = ", ".join(f"`{name}` {value:.2f} ({sd:.2f})" for name, (value, sd) in row["gears"].items())
        print(f"Answer: {row['answer']}, {row['cpu_s']:.0f} CPU s. Gears, arcsec: {gears}.\n")
        print(f"{held['stars']} stars left out and predicted by the others: {held['rms']:.2f} arcsec RMS,")
        print(f"RMS z {rms:.2f} of {len(held['z'])} angles (bounds {low:.2f} to {high:.2f}).\n")
        print("Weak directions:\n")
        print("\n".join(f"- {text}" for text in row["weak"]) or "- none")
    if len(rows) < 2:
        return
    one, two = (row["joint"] for row in rows[:2])
    print("\n## One night and the other\n\n| term | difference | z |\n|---|---|---|")
    for name in TERMS:
        off, u = two[name][0] - one[name][0], np.hypot(one[name][1], two[name][1])
        print(f"| {name} | {off:+.2f} ({u:.2f}) | {off / u:+.1f} |")
    for row in every:
        if row["file"] == "between":
            text = "\nNight two, arcsec RMS: {:.1f} without terms, {:.1f} by those of night one, {:.2f} by its own."
            print(text.format(row["before"], row["after"], row["own"]))


if __name__ == "__main__":
    cli = parser(__doc__, run=run, table=table)
    cli.add_argument("folder", type=Path, nargs="?", help="of tables, for run")
    act(cli)
