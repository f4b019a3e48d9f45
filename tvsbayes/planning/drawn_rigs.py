"""Possible instruments: drawn from `[truth]` of the rig file, the posterior of a campaign, or like that of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.instrument.parameters import names_of
from tvsbayes.instrument.stereo_pair import stereo_parameters
from tvsbayes.model.compiled import placed
from tvsbayes.model.parameter_space import ParameterSpace, coordinates_of, physical_at
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.statistics.streams import Stream, random_stream
from tvsbayes.twin.true_rig import Truth, draw_truth, with_derived

BUILD_NAMES = names_of(
    *("backlash_deg", "stop_sd_deg", "look_scatter_deg", "pixel_scale", "transmission_error_deg"),
    *("transmission_error_length_deg", "play_variation_deg", "drift_deg_per_root_hour", "harmonic_amplitude_deg"),
    *("extrinsics.rotation_rad", "extrinsics.translation_mm"),
)
"""What a rig shares with another of its build: play, scatter, sizes of gear errors and drift, and where it stands."""


@dataclass(frozen=True)
class Instruments:
    """Possible points of parameter space, n of them.

    Attributes:
        z: coordinates, shape (n, p).
        value: `value` of their spaces, shape (n, rig): parameters fixed by the priors are at their true values.
        physical: values in the units of their names, shape (n, p).
        common: the rest of their spaces.
    """

    z: np.ndarray
    value: np.ndarray
    physical: np.ndarray
    common: ParameterSpace

    @classmethod
    def at(cls, z: np.ndarray, value: np.ndarray, common: ParameterSpace) -> Instruments:
        """Build points with coordinates (n, p) in spaces that differ by `value` (n, rig)."""
        instruments = cls(z, value, np.empty_like(z), common)
        physical = [physical_at(point, instruments.space_of(row)).value for row, point in enumerate(z)]
        return replace(instruments, physical=np.array(physical).reshape(z.shape))

    def __len__(self) -> int:
        return len(self.z)

    def __getitem__(self, chosen: np.ndarray) -> Instruments:
        return Instruments(self.z[chosen], self.value[chosen], self.physical[chosen], self.common)

    def space_of(self, row: int) -> ParameterSpace:
        """Return the space of one instrument's coordinates."""
        return replace(self.common, value=placed(self.value[row]))


def instruments_in(knowledge: Knowledge, truths: Sequence[Truth]) -> Instruments:
    """Convert rigs to coordinates under the ANALYSIS priors; parameters fixed by these are at their true values."""
    space = knowledge.space
    names = knowledge.rig.table.mechanism.rig_names
    truth_values = np.array([[truth.parameters[name] for name in names] for truth in truths]).reshape(-1, len(names))
    cameras = np.array([stereo_parameters(truth.stereo) for truth in truths]).reshape(len(truth_values), -1)
    # A half-normal with u = 0 is 0 for any value.
    value = np.where(np.asarray(space.u) > 0, np.asarray(space.value), truth_values)
    return Instruments.at(coordinates_of(space, np.concatenate([truth_values, cameras], axis=1)), value, space)


def draws_of(knowledge: Knowledge, count: int, generator: np.random.Generator) -> np.ndarray:
    """Draw coordinates of possible instruments, shape (count, p)."""
    if knowledge.like is not None:
        return _drawn_alike(knowledge, knowledge.like, count, generator).z
    size = len(knowledge.z)
    root = np.linalg.cholesky(knowledge.covariance[:size, :size])
    return knowledge.z + generator.standard_normal((count, size)) @ root.T


def draw_instruments(knowledge: Knowledge, count: int, seed: int) -> Instruments:
    """Draw instruments from `[truth]` of the rig file (the design prior), or from the posterior of a campaign."""
    generator = random_stream(seed, Stream.INSTRUMENTS)
    if knowledge.like is not None:
        return _drawn_alike(knowledge, knowledge.like, count, generator)
    if knowledge.after_data:
        z = draws_of(knowledge, count, generator)
        value = np.asarray(knowledge.space.value)
        return Instruments.at(z, np.broadcast_to(value, (count, len(value))), knowledge.space)
    return instruments_in(knowledge, [draw_truth(knowledge.rig, generator) for _ in range(count)])


def alike(knowledge: Knowledge, like: Knowledge) -> Knowledge:
    """Plan for the next instrument of a build: `BUILD_NAMES` as another's campaign found them, the priors unchanged.

    Args:
        knowledge: the priors of the next one.
        like: the other one after its campaign.
    """
    found = np.asarray(physical_at(like.z, like.space).value)
    centre = np.array(physical_at(knowledge.z, knowledge.space).value)
    build = np.isin(knowledge.space.mechanism.names, BUILD_NAMES)
    centre[build] = found[build]
    return replace(knowledge, z=coordinates_of(knowledge.space, centre), like=like)


def _drawn_alike(knowledge: Knowledge, like: Knowledge, count: int, generator: np.random.Generator) -> Instruments:
    """Draw instruments whose build is drawn from the other's posterior, and the rest from `[truth]`."""
    mechanism = knowledge.rig.table.mechanism
    truths = []
    for z in draws_of(like, count, generator):
        found, truth = physical_at(z, like.space).value, draw_truth(knowledge.rig, generator)
        build = {name: float(found[mechanism.index[name]]) for name in BUILD_NAMES if name in mechanism.index}
        truths.append(replace(truth, parameters=with_derived({**truth.parameters, **build})))
    return instruments_in(knowledge, truths)
