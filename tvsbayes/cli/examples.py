"""Examples at the end of every command's help, and at the beginning of `tvsbayes --help`."""

from __future__ import annotations

EXAMPLES = {
    "demo": ("tvsbayes demo", "tvsbayes demo kept"),
    "new": ("tvsbayes new mine", "tvsbayes new mine --pictures FOLDER", "tvsbayes new stage --axis"),
    "import": ("tvsbayes import looks.xlsx --to mine",),
    "simulate": (
        "tvsbayes simulate rig.toml plan.csv trial --aperture --seed 7",
        "tvsbayes simulate rig.toml plan.csv trial --frames",
    ),
    "detect": ("tvsbayes detect mine", "tvsbayes detect mine --overlay"),
    "stereo": (
        "tvsbayes stereo pictures --board 9x6 --pitch-mm 25 -o stereo.json",
        "tvsbayes stereo --import left.yaml --import right.yaml -o stereo.json",
    ),
    "check": ("tvsbayes check mine", "tvsbayes check rig.toml plan.csv"),
    "acquire": (
        "tvsbayes acquire rig.toml plan.csv run1 --dry-run",
        "tvsbayes acquire rig.toml plan.csv run1 --laser-class 3B",
        "tvsbayes acquire rig.toml plan.csv run1 --resume",
        "tvsbayes acquire rig.toml plan.csv run1 --simulate --live",
    ),
    "doctor": ("tvsbayes doctor rig.toml",),
    "export": ("tvsbayes export run1 --nexus run1.nxs",),
    "classic": ("tvsbayes classic mine", "tvsbayes classic mine --json"),
    "fit": ("tvsbayes fit mine --quick", "tvsbayes fit mine", "tvsbayes fit mine --robust --details"),
    "calibrate": ("tvsbayes calibrate mine", "tvsbayes calibrate mine --quick --limit-deg-per-step 4e-4 --pdf"),
    "report": (
        "tvsbayes report mine --limit-deg-per-step 4e-4 --pdf",
        "tvsbayes report mine --laboratory 'Optics Lab' --customer 'Robotics group'",
    ),
    "view": ("tvsbayes view mine", "tvsbayes view january --beside march"),
    "compare": ("tvsbayes compare mine", "tvsbayes compare january march"),
    "watch": ("tvsbayes watch mine tonight", "tvsbayes watch mine tonight --append nights.csv"),
    "locate": (
        "tvsbayes locate mine --pan-steps 169 --tilt-steps 46 --aperture-deg 63.4",
        "tvsbayes locate mine --points points.csv --json",
    ),
    "steps-for": (
        "tvsbayes steps-for mine --x-mm 500 --y-mm 150 --z-mm 40",
        "tvsbayes steps-for mine --export header > tvs_calibration.h",
    ),
    "compensate": (
        "tvsbayes compensate stage --to csv -o stage.csv",
        "tvsbayes compensate stage --to linuxcnc -o stage.comp",
        "tvsbayes compensate stage --to grbl --in-force 250 -o stage.nc",
    ),
    "verify": ("tvsbayes verify stage fresh",),
    "plan": (
        "tvsbayes plan rig.toml --minutes 30 -o plan.csv",
        "tvsbayes plan rig.toml --given mine --target 'u(worst) <= 8e-5 deg/step'",
        "tvsbayes plan mine --watch --minutes 10 -o looks.csv",
    ),
    "study": ("tvsbayes study rig.toml plan.csv --n 100 --engine processes",),
}
"""Examples by command; they run unchanged with files of these names."""
FIRST = ("tvsbayes demo", "tvsbayes new mine", "tvsbayes calibrate mine")
"""First commands of a new user."""


def epilog(examples: tuple[str, ...]) -> str:
    r"""The end of a help page; `\b` keeps the lines as they are."""
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in examples)])
