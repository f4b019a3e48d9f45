"""What reports call parameters, causes of uncertainty and tiers: words for readers, beside the names in files."""

from __future__ import annotations

import re

from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.parameters import REGISTRY

MADE_BY = {
    "laplace": "Laplace approximation at the mode",
    "importance": "posterior by importance sampling",
    **dict.fromkeys(("emcee", "posterior"), "posterior sampled by emcee"),
}
"""By tier, or by estimator where results name no tier."""
IN_WORDS = {
    "degrees_per_step": "the ratio of the gears",
    "ratio_contrast_deg_per_step": "the difference of the ratios of both directions",
    "backlash_deg": "the backlash",
    "tilt_zero_deg": "the tilt mirror at counter 0",
    "mirror_offset_mm": "the mirror offset",
    "mirror1_error_deg": "the angle of mirror 1",
    "mirror2_error_deg": "the angle of mirror 2",
    "laser_tilt_deg": "the laser's direction",
    "laser_offset_mm": "the laser's place",
    "tilt_axis_skew_deg": "the skew of the tilt axis",
    "tilt_axis_offset_mm": "the place of the tilt axis",
    "extrinsics": "the positioner's pose",
    "extrinsics.rotation_rad": "the positioner's attitude",
    "extrinsics.translation_mm": "the positioner's place",
    "stop_sd_deg": "the scatter of stops",
    "pixel_scale": "the pixel noise over the stated one",
    "focal_scale": "the focal scale",
    "baseline_mm": "the baseline",
    "pan_zero_emission_deg": "the emission angle at pan 0",
    "aperture_zero_deg": "the aperture's zero",
    "aperture_sd_deg": "the scatter of aperture readings",
    "harmonic_deg": "the periodic error of the gears",
    "transmission_error_deg": "the transmission error, sd",
    "transmission_error_length_deg": "the angle over which the transmission error changes",
    "play_variation_deg": "the variation of play, sd",
    "drift_deg_per_root_hour": "the drift in a root hour, sd",
    "look_scatter_deg": "the scatter of looks, sd",
    "harmonic_amplitude_deg": "the amplitude of a periodic error",
    "creep_deg": "the creep of the zero while the machine warms up, in all",
    "creep_minutes": "the time constant of the creep",
    "thermal_deg_per_K": "the shift of the zero per kelvin",
}
"""By block of parameters; those of the positioner's pose also as one."""
_RESULTS = {
    "effective_mirror_offset_mm": "beam off the pan axis, mm",
    **{f"effective_deg_per_step.{direction}": f"effective ratio, {direction}, deg/step" for direction in DIRECTIONS},
    **{f"degrees_per_step.{direction}": f"ratio of the gears, {direction}, deg/step" for direction in DIRECTIONS},
}
"""What follows from parameters and stands among them."""


def name_in_words(name: str) -> str:
    """A parameter for readers, with its part and unit: "laser's direction, x, deg"; other names stay."""
    parameter = REGISTRY.get(name)
    if parameter is None or parameter.block not in IN_WORDS:
        return _RESULTS.get(name, name)
    part = name.removeprefix(parameter.block).lstrip(".").replace(".", " ")
    unit = "" if parameter.unit == "1" else parameter.unit
    return ", ".join(filter(None, (IN_WORDS[parameter.block].removeprefix("the "), part, unit)))


def source_in_words(source: str) -> str:
    """A row of a budget for readers, with part and unit: a parameter, the prior of one; others stay."""
    for begin, article in (("prior of ln ", ""), ("prior of ", "the ")):
        if source.startswith(begin):
            name = source.removeprefix(begin)
            told = name_in_words(name)
            return begin + article * (told != name) + told
    return name_in_words(source)


def share_in_words(cause: str) -> str:
    """A cause of uncertainty in a table of shares: priors of a group of parameters as one; others stay."""
    name = cause.removeprefix("prior of ")
    return f"prior of {IN_WORDS[name]}" if cause != name and name in IN_WORDS else cause


def cause_in_words(cause: str) -> str:
    """A cause of uncertainty in a sentence."""
    name = cause.removeprefix("prior of ")
    return f"{IN_WORDS[name]} as stated beforehand" if name in IN_WORDS else cause


_NAMES = re.compile(r"\b(?:" + "|".join(sorted(map(re.escape, IN_WORDS), key=len, reverse=True)) + r")\b(?:\.\w+)*")


def sentence_in_words(text: str) -> str:
    """A sentence with parameters by their words; commands between backticks stay."""
    parts = text.split("`")

    def words(found: re.Match[str]) -> str:
        name = found.group()
        parameter = REGISTRY.get(name)
        if parameter is None or parameter.block not in IN_WORDS:
            return IN_WORDS.get(name, name)
        part = name.removeprefix(parameter.block).lstrip(".").replace(".", " ")
        return f"{IN_WORDS[parameter.block]} ({part})" if part else IN_WORDS[parameter.block]

    return "`".join(part if k % 2 else _NAMES.sub(words, part) for k, part in enumerate(parts))
