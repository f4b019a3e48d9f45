"""What do nominal, classic and joint calibration cost in millimetres, over pan, tilt and range?

    python -m experiments.millimetres.error_map > experiments/millimetres/error_map.md     # a minute, also the figure

The paper twin is fitted (Laplace). Its posterior draws stand for the rigs that the data allow; on each the beam is
followed to a range, the aperture reads it, and every calibration locates the point. Nominal and classic get the
shortened baseline and the moved origin that formulation 5 calls fair. The error is the distance from the true point,
root mean square over 500 rigs; it holds stop errors and aperture noise of the look, which no calibration removes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.common.command_line import print_only
from experiments.common.figures import page_figure, title_and_figure
from experiments.common.rigs import twin_campaign
from tvsbayes.assessment.fitted_calibration import calibration_of
from tvsbayes.coordinates.error_map import ErrorMap, error_map
from tvsbayes.coordinates.simple_calibration import simple_calibration
from tvsbayes.estimators.four_point import classic
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.metrology.look_budget import budget
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.report.drawing import ESTIMATOR_STYLE, SEQUENTIAL, colour_map

RANGES_MM = (200.0, 300.0, 400.0, 500.0, 700.0, 1000.0, 1400.0)
PICTURE = Path(__file__).with_suffix(".png")


def main() -> None:
    """Print the page, write the picture."""
    print_only(__doc__)
    use_compilation_cache()
    campaign = twin_campaign("paper_twin")
    calibration = calibration_of(fit(campaign))
    priors = campaign.rig.priors
    simple = {"nominal": simple_calibration(priors), "classic": simple_calibration(priors, classic(campaign))}
    pan, tilt = (np.linspace(*ends, 5).round() for ends in calibration.range_steps)
    errors_mm = error_map(calibration, pan, tilt, RANGES_MM, simple=simple)
    print(
        title_and_figure(
            __file__, "Expected error of a located point", PICTURE, "RMS error by range, and maps at 500 mm"
        )
    )
    print("Written by `python -m experiments.millimetres.error_map`; paper twin, what was done stands in the script.\n")
    print("| range, mm | nominal | classic | joint | poses where all three find a point |\n|---|---|---|---|---|")
    for k, reach in enumerate(RANGES_MM):
        valid = errors_mm.valid[..., k]
        cells = []
        for name in ESTIMATOR_STYLE:
            errors = errors_mm.rms_mm[name][..., k][valid]
            cells.append(f"{np.sqrt(np.mean(errors**2)):.1f}" if errors.size else "-")
        print(f"| {reach:.0f} | {' | '.join(cells)} | {valid.sum()} of {valid.size} |")
    print("\nRMS distance in mm over 5 x 5 poses within the counters of the campaign.\n")
    parts = budget(calibration, *calibration.range_steps.mean(axis=1).round(), 70.0)
    print("## What the uncertainty of one point consists of\n")
    print("Middle of the counters, aperture reading 70 deg.\n")
    print("| cause | share of the variance, % |\n|---|---|")
    for index in np.argsort(-parts.share):
        if parts.share[index] >= 0.001:
            print(f"| {parts.causes[index]} | {100 * parts.share[index]:.1f} |")
    draw(errors_mm)


def draw(mapped: ErrorMap) -> None:
    """RMS error against range, and over the counters at 500 mm."""
    with page_figure(PICTURE, 3.2, width_in=10.0) as figure:
        axes = figure.subplots(1, 3)
        for name, (colour, marker) in ESTIMATOR_STYLE.items():
            curve = [np.sqrt(np.nanmean(mapped.rms_mm[name][..., k] ** 2)) for k in range(len(RANGES_MM))]
            axes[0].semilogy(RANGES_MM, curve, color=colour, marker=marker, markersize=4, label=name)
        axes[0].set(xlabel="range, mm", ylabel="RMS error, mm", title="against range")
        axes[0].legend()
        reach = RANGES_MM.index(500.0)
        for axis, name in zip(axes[1:], ("classic", "joint"), strict=True):
            errors = mapped.rms_mm[name][..., reach].T
            counters = (mapped.pan_steps, mapped.tilt_steps)
            image = axis.pcolormesh(*counters, errors, shading="nearest", cmap=colour_map(SEQUENTIAL))
            figure.colorbar(image, ax=axis, label="mm")
            axis.set(xlabel="pan, steps", ylabel="tilt, steps", title=f"{name}, at 500 mm")
            axis.grid(visible=False)


if __name__ == "__main__":
    main()
