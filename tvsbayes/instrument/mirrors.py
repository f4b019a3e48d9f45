"""Trace the laser over the positioner's plane mirrors, with Python floats, NumPy or JAX (formulation 3.2).

Lengths in mm, angles in rad. Frame P: z along the pan axis, up; x along the nominal beam at pan angle 0; y left; origin
where the nominal laser meets mirror 1. Frame Q is P turned by the pan angle: the mirrors are fixed there. Many vectors
are stored as three arrays, for x, y and z (`Vectors`): XLA's loops over one wide array are several times faster than
over an axis of length three. JAX handles named tuples as trees of arrays without an import here. `functions` is `math`
for floats, `numpy` for arrays (also complex, for derivatives) or `jax.numpy`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any, NamedTuple

type Numbers = Any
"""A float, or an array of NumPy or JAX; all arguments of a call broadcast."""
type Materialise = Callable[[Any], Any]
"""Makes the compiler compute a tree of arrays once; see `model.geometry.materialise`."""


def unchanged(tree: Any) -> Any:
    """Return the tree itself, where nothing is compiled."""
    return tree


class Vectors(NamedTuple):
    """Many vectors by their components; a single one broadcasts against them."""

    x: Numbers
    y: Numbers
    z: Numbers

    @classmethod
    def of(cls, stacked: Numbers) -> Vectors:
        """Build from one array of shape (3, ...) whose first axis is x, y, z."""
        return cls(stacked[0], stacked[1], stacked[2])

    def stacked(self) -> Numbers:
        """One array of shape (3, ...) whose first axis is x, y, z, by the array functions of the components' type."""
        functions = self.x.__array_namespace__()
        return functions.stack(functions.broadcast_arrays(*self))

    def __add__(self, other: Vectors) -> Vectors:  # type: ignore[override]
        """Componentwise."""
        return Vectors(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vectors) -> Vectors:
        """Componentwise."""
        return Vectors(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, factor: Numbers) -> Vectors:
        """Scaled by a factor."""
        return Vectors(self.x * factor, self.y * factor, self.z * factor)

    def __rmul__(self, factor: Numbers) -> Vectors:
        """Scaled by a factor on the left; a plain tuple would be repeated."""
        return self * factor

    def dot(self, other: Vectors) -> Numbers:
        """Scalar product."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: Vectors) -> Vectors:
        """Vector product."""
        x = self.y * other.z - self.z * other.y
        y = self.z * other.x - self.x * other.z
        return Vectors(x, y, self.x * other.y - self.y * other.x)


# Makes NumPy arrays leave products with `Vectors` to this class; else they would convert the tuple to an array.
Vectors.__array_ufunc__ = None  # type: ignore[attr-defined]


class Turn(NamedTuple):
    """Turns about z, counter-clockwise seen from +z, by the cosine and sine of their angles."""

    cosine: Numbers
    sine: Numbers

    @classmethod
    def by(cls, angle_rad: Numbers, functions: ModuleType) -> Turn:
        """The turn by an angle."""
        return cls(functions.cos(angle_rad), functions.sin(angle_rad))

    def forward(self, v: Vectors) -> Vectors:
        """Turned vectors."""
        return Vectors(self.cosine * v.x - self.sine * v.y, self.sine * v.x + self.cosine * v.y, v.z)

    def back(self, v: Vectors) -> Vectors:
        """Vectors turned in the opposite sense."""
        return Vectors(self.cosine * v.x + self.sine * v.y, self.cosine * v.y - self.sine * v.x, v.z)


class Ray(NamedTuple):
    """Rays that leave `origin_mm` along the unit vectors `direction`."""

    origin_mm: Vectors
    direction: Vectors

    def at(self, range_mm: Numbers) -> Vectors:
        """Points along the rays."""
        return self.origin_mm + self.direction * range_mm


class Mirror(NamedTuple):
    """A plane mirror by a point of its plane and its unit normal."""

    point_mm: Vectors
    normal: Vectors


class Optics(NamedTuple):
    """Laser and mirrors, with every deviation from the nominal 45-degree chain.

    Fields are the blocks of parameters of these names; those of two parts are arrays of shape (2,), or pairs.
    """

    mirror_offset_mm: Numbers
    mirror1_error_rad: Numbers
    mirror2_error_rad: Numbers
    laser_tilt_rad: Numbers
    laser_offset_mm: Numbers
    tilt_axis_skew_rad: Numbers
    tilt_axis_offset_mm: Numbers

    def leaving(
        self, pan_rad: Numbers, tilt_rad: Numbers, functions: ModuleType, materialise: Materialise = unchanged
    ) -> Ray:
        """The beam after the last mirror, in P; arguments as of `beam_path`."""
        path = beam_path(self, pan_rad, tilt_rad, functions, materialise)
        return Ray(*map(path.pan.forward, path.rays[-1]))

    def leaving_turned(self, pan_rad: Numbers, tilt_rad: Numbers, by_rad: Numbers, functions: ModuleType) -> Ray:
        """The same in P turned about z, by one rotation from Q."""
        ray = beam_path(self, pan_rad, tilt_rad, functions).rays[-1]
        return Ray(*map(Turn.by(pan_rad + by_rad, functions).forward, ray))


class BeamPath(NamedTuple):
    """The path of the laser beam in frame Q: the turn from Q to P, the mirrors in order, the ray after each of them."""

    pan: Turn
    mirrors: tuple[Mirror, ...]
    rays: tuple[Ray, ...]


def reflect(direction: Vectors, normal: Vectors) -> Vectors:
    """Mirror directions at a plane with unit normal: d - 2 (d.n) n."""
    return direction - normal * (2 * direction.dot(normal))


def intersect_plane(origin: Vectors, direction: Vectors, point: Vectors, normal: Vectors) -> Vectors:
    """Points where lines meet the plane through `point`; not finite where they are parallel."""
    return origin + direction * ((point - origin).dot(normal) / direction.dot(normal))


def reflected(ray: Ray, mirrors: Iterable[Mirror], materialise: Materialise = unchanged) -> tuple[Ray, ...]:
    """The ray after each mirror in order: each starts where the previous ray meets the mirror."""
    rays = []
    for mirror in mirrors:
        hit_mm = intersect_plane(*ray, *mirror)
        ray = Ray(*materialise((hit_mm, reflect(ray.direction, mirror.normal))))
        rays.append(ray)
    return tuple(rays)


def laser_of(optics: Optics, functions: ModuleType) -> Ray:
    """The laser, fixed in P."""
    tangent_x, tangent_y = (functions.tan(tilt) for tilt in optics.laser_tilt_rad)
    shorter = 1 / functions.sqrt(1 + tangent_x**2 + tangent_y**2)
    x_mm, y_mm = optics.laser_offset_mm
    return Ray(Vectors(x_mm, y_mm, 0.0), Vectors(tangent_x * shorter, tangent_y * shorter, -shorter))


def mirrors_of(optics: Optics, tilt: Turn, functions: ModuleType) -> tuple[Mirror, ...]:
    """The mirrors of the positioner in Q, in the order in which the laser meets them.

    Args:
        optics: laser and mirrors.
        tilt: turn of the tilt stage about the tilt axis by beta, from its zero.
        functions: see the module.
    """
    cos, sin = functions.cos, functions.sin
    first = functions.pi / 4 + optics.mirror1_error_rad
    second = functions.pi / 4 + optics.mirror2_error_rad
    sin_skew, cos_skew = sin(optics.tilt_axis_skew_rad), cos(optics.tilt_axis_skew_rad)
    x_mm, z_mm = optics.tilt_axis_offset_mm
    ahead = Vectors(sin(second), 0.0, 0.0)
    above = Vectors(0.0, -sin_skew, cos_skew) * sin(second)
    axial = Vectors(0.0, cos_skew, sin_skew) * cos(second)
    second_normal = ahead * tilt.cosine + above * tilt.sine + axial
    return (
        Mirror(Vectors(0.0, 0.0, 0.0), Vectors(0.0, -sin(first), cos(first))),
        Mirror(Vectors(x_mm, -optics.mirror_offset_mm, z_mm), second_normal),
    )


def beam_path(
    optics: Optics,
    pan_rad: Numbers,
    tilt_rad: Numbers,
    functions: ModuleType,
    materialise: Materialise = unchanged,
) -> BeamPath:
    """Traces the laser over all mirrors; the signs are documented in the conventions.

    Args:
        optics: laser and mirrors.
        pan_rad: angles psi of the pan stage.
        tilt_rad: angles beta of the tilt stage.
        functions: see the module.
        materialise: applied to the turns of the stages and to every ray.
    """
    pan, tilt = materialise((Turn.by(pan_rad, functions), Turn.by(tilt_rad, functions)))
    # The laser is fixed in P; in the pan stage's frame Q it turns backwards.
    laser = laser_of(optics, functions)
    mirrors = mirrors_of(optics, tilt, functions)
    return BeamPath(pan, mirrors, reflected(Ray(*map(pan.back, laser)), mirrors, materialise))
