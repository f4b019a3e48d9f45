"""The planner's order of looks for the worst effective ratio, before anything is measured."""

from __future__ import annotations

from msgspec import structs

from tvsbayes.planning.assurance import Family
from tvsbayes.planning.candidates import candidates
from tvsbayes.planning.expectation import Knowledge
from tvsbayes.planning.looks import LookArrays
from tvsbayes.planning.search import DesignProblem, Scope, design_family
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target, sensitivity

UNREACHED = 1e-9
"""A limit that no plan keeps: the search goes on to its largest design."""


def searched_family(knowledge: Knowledge, scope: Scope | None = None) -> Family:
    """However small u becomes; by expected information at the most probable instrument."""
    pool = candidates(knowledge)
    looks = LookArrays(pool.looks, knowledge, False).at(knowledge.z, knowledge.space)
    target = structs.replace(parse_target(DEFAULT_TARGET), limit=UNREACHED)
    pose = looks.mirror_angles_rad.mean(axis=0)
    centre = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
    return design_family(DesignProblem(knowledge, pool, looks, target, centre), scope)
