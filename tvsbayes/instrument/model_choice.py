"""Which model a fit holds against the data: gears simpler or richer than a rig file states, spots to be left out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tvsbayes.errors import InputError
from tvsbayes.instrument.parameters import HARMONIC_NAMES, REGISTRY, Prior, names_of

if TYPE_CHECKING:
    from tvsbayes.instrument.rig import RigTable

HARMONIC_SD_DEG = 0.1
"""Prior standard deviation of every part of a freed transmission error."""


@dataclass(frozen=True)
class ModelChoice:
    """What `fit` is asked for beyond the priors of the rig; the defaults take those as they are stated.

    Attributes:
        robust: downweight and exclude spots that disagree with all others (Huber weights and a gate on leave-one-out
            residuals).
        per_axis: one ratio per axis, the contrasts of left and right, up and down fixed at 0.
        harmonics: free the transmission error of every axis with a stated period, N(0, 0.1 deg) each, where
            `[rig.prior]` says nothing else; a harmonic stated as exactly 0 counts as nothing said.
        no_backlash: gears without play, both backlashes fixed at 0.
        perfect_gears: gears that repeat no error of unknown shape, do not drift and have the same play everywhere;
            harmonics that `[rig.prior]` states, or that are freed, stay.
    """

    robust: bool = False
    per_axis: bool = False
    harmonics: bool = False
    no_backlash: bool = False
    perfect_gears: bool = False

    def table(self, stated: RigTable) -> RigTable:
        """The rig with the priors of the gears that are chosen.

        Raises:
            InputError: harmonics are wanted and no axis states the period of its error.
        """
        changed: dict[str, Prior] = {}
        if self.per_axis:
            changed |= dict.fromkeys(names_of("ratio_contrast_deg_per_step"), Prior(0.0, 0.0))
        if self.no_backlash:
            changed |= dict.fromkeys(names_of("backlash_deg"), Prior(0.0, 0.0, "half-normal"))
        if self.no_backlash or self.perfect_gears:
            changed |= dict.fromkeys(names_of("play_variation_deg"), Prior(0.0, 0.0, "half-normal"))
        if self.perfect_gears:
            repeated = names_of("transmission_error_deg", "drift_deg_per_root_hour", "harmonic_amplitude_deg")
            changed |= dict.fromkeys(repeated, Prior(0.0, 0.0, "half-normal"))
            # A length of nothing is not estimated.
            for name in names_of("transmission_error_length_deg"):
                changed[name] = Prior(stated.priors[name].value, 0.0, "log-normal")
        if self.harmonics:
            if not stated.harmonic_period_deg:
                raise InputError(
                    "missing-period",
                    "no axis states the period of its transmission error",
                    file="campaign.toml",
                    column="rig.harmonic_period_deg",
                    allowed="a period in degrees of the output, 360 for the wheel, less for the pinion",
                    remedy='add "harmonic_period_deg.pan" = { value = 360.0, u = 0.0 } (or tilt) to [rig]',
                )
            for name in HARMONIC_NAMES:
                unasked = stated.priors[name] == REGISTRY[name].prior
                if unasked and name.split(".")[1] in stated.harmonic_period_deg:
                    changed[name] = Prior(0.0, HARMONIC_SD_DEG)
        return replace(stated, priors={**stated.priors, **changed})


AS_STATED = ModelChoice()
"""The model of the rig file itself."""
