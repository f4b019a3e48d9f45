"""Choice of the model of a fit: simpler or more general gears than the rig file states, exclusion of spots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tvsbayes.errors import InputError
from tvsbayes.instrument.parameters import HARMONIC_NAMES, REGISTRY, Prior, names_of

if TYPE_CHECKING:
    from tvsbayes.instrument.rig import RigTable

HARMONIC_SD_DEG = 0.1
"""Prior standard deviation of every component of a freed transmission error."""


@dataclass(frozen=True)
class ModelChoice:
    """Options of `fit` that change the priors of the rig; the defaults leave them as stated.

    Attributes:
        robust: downweight and exclude outliers (Huber weights and a gate on leave-one-out residuals).
        per_axis: one ratio per axis, with the contrasts of left and right, up and down fixed at 0.
        harmonics: free the transmission error of every axis with a stated period, N(0, 0.1 deg) each, where
            `[rig.prior]` states no other prior; a harmonic stated as exactly 0 counts as unstated.
        no_backlash: gears without play, both backlashes fixed at 0.
        perfect_gears: gears without transmission error of unknown shape, without drift, and with constant play;
            harmonics that `[rig.prior]` states, or that are freed, stay.
    """

    robust: bool = False
    per_axis: bool = False
    harmonics: bool = False
    no_backlash: bool = False
    perfect_gears: bool = False

    def table(self, stated: RigTable) -> RigTable:
        """The rig with the chosen priors of the gears.

        Raises:
            InputError: `harmonics` is set, but no axis states the period of its error.
        """
        changed: dict[str, Prior] = {}
        if self.per_axis:
            changed |= dict.fromkeys(names_of("ratio_contrast_deg_per_step"), Prior(0.0, 0.0))
        if self.no_backlash:
            changed |= dict.fromkeys(names_of("backlash_deg"), Prior(0.0, 0.0, "half-normal"))
        if self.no_backlash or self.perfect_gears:
            changed |= dict.fromkeys(names_of("play_variation_deg"), Prior(0.0, 0.0, "half-normal"))
        if self.perfect_gears:
            error_names = names_of("transmission_error_deg", "drift_deg_per_root_hour", "harmonic_amplitude_deg")
            changed |= dict.fromkeys(error_names, Prior(0.0, 0.0, "half-normal"))
            # The correlation length of an error fixed at zero is not estimated.
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
                is_default = stated.priors[name] == REGISTRY[name].prior
                if is_default and name.split(".")[1] in stated.harmonic_period_deg:
                    changed[name] = Prior(0.0, HARMONIC_SD_DEG)
        return replace(stated, priors={**stated.priors, **changed})


AS_STATED = ModelChoice()
"""The model of the rig file itself."""
