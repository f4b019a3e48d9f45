"""Chains of the beam by mechanism; that of a head with two geared axes by exact rotations, for floats, NumPy and JAX.

Lengths in mm, angles in rad. The frame is P of `instrument.mirrors`: z up, azimuth counted from x towards y, as the pan
counter. Two small angles tilt the azimuth axis in it; elevation axis and beam follow that axis. To first order the
additions to the axes' angles are TPOINT's terms (P. T. Wallace, TPOINT - Telescope Pointing Analysis System, terms
IA IE AN AW NPAE CA TF TX), with their signs, A the azimuth from north (x) through east (y) and E the elevation:

    dA = -IA - AN sin A tan E - AW cos A tan E - CA sec E - NPAE tan E
    dE = IE - AN cos A + AW sin A - TF cos E - TX cot E

where azimuth_zero = -IA, elevation_zero = IE, azimuth_axis_tilt = (AN, -AW), axes_not_square = NPAE,
beam_not_square = CA, flexure = TF, tangent_flexure = TX.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

from tvsbayes.instrument.mechanisms import HEAD, TWO_MIRROR, Mechanism
from tvsbayes.instrument.mirrors import Materialise, Numbers, Optics, Ray, Turn, Vectors, unchanged

LEAST_ELEVATION = 1e-3
"""Sine of the elevation below which the cotangent is limited: a law in tan z does not hold near the horizon."""


class HeadOptics(NamedTuple):
    """Deviations of a head's line of sight from its two angles; fields are the names of the terms, in rad and mm.

    The zero of elevation is not among them: it is part of that axis' angle, as is the scanner's tilt zero.
    """

    elevation_axis_offset_mm: Numbers
    axes_not_square_rad: Numbers
    beam_not_square_rad: Numbers
    azimuth_axis_tilt_rad: Numbers
    beam_offset_mm: Numbers
    flexure_rad: Numbers
    azimuth_zero_rad: Numbers
    tangent_flexure_rad: Numbers

    def leaving(
        self, pan_rad: Numbers, tilt_rad: Numbers, functions: ModuleType, materialise: Materialise = unchanged
    ) -> Ray:
        """The line of sight in P for angles of both axes.

        Args:
            pan_rad: angles of the azimuth axis, from its counter's zero.
            tilt_rad: angles of the elevation axis, the zero of elevation included.
            functions: see `instrument.mirrors`.
            materialise: applied to the turns of the axes and to the ray.
        """
        cos, sin = functions.cos, functions.sin
        above = sin(tilt_rad)
        # Without a branch: one limited cotangent for all elevations, finite at the horizon.
        held = above / (above * above + LEAST_ELEVATION**2)
        bent = tilt_rad - self.flexure_rad * cos(tilt_rad) - self.tangent_flexure_rad * cos(tilt_rad) * held
        azimuth, elevation = materialise(
            (Turn.by(pan_rad + self.azimuth_zero_rad, functions), Turn.by(bent, functions))
        )
        sin_skew, cos_skew = sin(self.axes_not_square_rad), cos(self.axes_not_square_rad)
        axis = Vectors(0.0, cos_skew, sin_skew)
        up = Vectors(0.0, -sin_skew, cos_skew)
        ahead = Vectors(elevation.cosine, up.y * elevation.sine, up.z * elevation.sine)
        over = Vectors(-elevation.sine, up.y * elevation.cosine, up.z * elevation.cosine)
        aside_mm, over_mm = self.beam_offset_mm
        origin = Vectors(self.elevation_axis_offset_mm, 0.0, 0.0) + axis * aside_mm + over * over_mm
        sight = ahead * cos(self.beam_not_square_rad) + axis * -sin(self.beam_not_square_rad)
        return Ray(*materialise(tuple(self._leaning(azimuth.forward(v)) for v in (origin, sight))))

    def leaving_turned(self, pan_rad: Numbers, tilt_rad: Numbers, by_rad: Numbers, functions: ModuleType) -> Ray:
        """The line of sight in P turned about z."""
        return Ray(*map(Turn.by(by_rad, functions).forward, self.leaving(pan_rad, tilt_rad, functions)))

    def _leaning(self, v: Vectors) -> Vectors:
        """Vectors turned about the horizontal axis that tilts z to the azimuth axis (Rodrigues)."""
        north, east = self.azimuth_axis_tilt_rad
        square = north * north + east * east
        # sin(a)/a and (1 - cos a)/a^2 by their series: accurate to 11 digits for an axis tilted by 30 degrees.
        sinc = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72 * (1 - square / 110))))
        versine = 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90 * (1 - square / 132))))
        axis = Vectors(-east, north, 0.0)
        once = axis.cross(v)
        return v + once * sinc + axis.cross(once) * versine


type Chain = Optics | HeadOptics
"""What carries the beam: the laser over mirrors, or a line of sight on two axes."""
CHAINS: dict[str, type[Optics] | type[HeadOptics]] = {TWO_MIRROR.word: Optics, HEAD.word: HeadOptics}
"""Chains by the word of a mechanism."""


def chain_of(mechanism: Mechanism, block: Callable[[str], Numbers]) -> Chain:
    """Build the chain of a mechanism from `block`, which returns the values of a block of parameters in mm and rad."""
    kind = CHAINS[mechanism.word]
    return kind(*(block(field.replace("_rad", "_deg")) for field in kind._fields))
