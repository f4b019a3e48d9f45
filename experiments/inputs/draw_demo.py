"""The README's picture of the demo: ratios of both estimators with their 95 % intervals, beside the truth.

    python -m experiments.inputs.draw_demo

Runs `tvsbayes demo --json` and writes data/tutorial/demo.svg. deg/step.
"""

from __future__ import annotations

import json
import subprocess
import sys

from experiments.common.command_line import print_only
from experiments.common.rows import ROOT
from tvsbayes.instrument.axes import SENSES
from tvsbayes.report.drawing import BLACK, ESTIMATOR_STYLE, drawing, svg

OUT = ROOT / "data" / "tutorial" / "demo.svg"


def draw(demo: dict) -> bytes:
    """The picture of a demo's JSON document."""
    classic, joint = demo["classic"]["directions"], demo["fit"]["effective_deg_per_step"]
    with drawing(2.2) as figure:
        for panel, (axis, pair) in zip(figure.subplots(1, 2), SENSES.items(), strict=True):
            for row, direction in enumerate(pair):
                mean = classic[direction]
                shown = (
                    ("classic", mean["mean_deg_per_step"], mean["interval95_type_a"]),
                    ("joint", joint[direction]["value"], joint[direction]["interval95"]),
                )
                for offset, (name, value, (low, high)) in zip((-0.13, 0.13), shown, strict=True):
                    colour, marker = ESTIMATOR_STYLE[name]
                    bars, label = [[value - low], [high - value]], None if row else name
                    panel.errorbar(
                        value, row + offset, xerr=bars, fmt=marker, color=colour, capsize=3, markersize=4, label=label
                    )
            panel.axvline(demo["truth"][pair[0]], color=BLACK, linewidth=1.2, label="truth")
            panel.set(yticks=range(2), yticklabels=pair, ylim=(1.5, -0.5), xlabel=f"{axis}, deg/step")
            panel.tick_params(axis="x", labelrotation=30)
        figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        return svg(figure)


def main() -> None:
    """Run the demo and draw it."""
    print_only(__doc__)
    done = subprocess.run([sys.executable, "-m", "tvsbayes", "demo", "--json"], capture_output=True, check=True)
    OUT.write_bytes(draw(json.loads(done.stdout)))


if __name__ == "__main__":
    main()
