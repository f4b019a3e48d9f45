"""How many designs are scored per second, up to 10 000 candidates?

    python -m experiments.speed.planning_speed > experiments/speed/planning_speed.md       # two minutes

Exact: a whole plan through the filter, `information_of`, after compilation; looks at many instruments, one by
one and mapped by `jax.vmap`. Search: one step of the greedy choice scores every candidate beside what
is chosen already.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.clock import shortest
from experiments.common.command_line import print_only
from experiments.common.rigs import mounted_rig
from tvsbayes.estimators.campaign_arrays import bucket
from tvsbayes.instrument.protocols import grid_protocol, paper_protocol
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.expectation import (
    DESIGN_GROWTH,
    PARAMETERS,
    SMALLEST_DESIGN,
    expect,
    information_of,
    prior_knowledge,
)
from tvsbayes.planning.looks import LookArrays, Looks
from tvsbayes.planning.search import Search

SIZES = (100, 1000, 10_000)
REPEATS = 5
BATCH = 8


def warm(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Shortest of several runs, after one that compiles."""
    work()
    return shortest(work, repeats)


def main() -> None:
    """Print the tables."""
    print_only(__doc__)
    use_compilation_cache()
    knowledge = prior_knowledge(mounted_rig())
    print("# Speed of planning\n")
    print("Written by `python -m experiments.speed.planning_speed`; times of a shared machine are upper bounds.\n")
    print("| exact evaluation | looks | padded to | ms | designs/s |\n|---|---|---|---|---|")
    for name, steps in (("grid, one sheet", grid_protocol(("d1",))), ("paper", paper_protocol())):
        one = warm(lambda steps=steps: information_of(steps, knowledge))
        looks = sum(step.action == "look" for step in steps)
        padded = bucket(looks, SMALLEST_DESIGN, DESIGN_GROWTH)
        print(f"| {name} | {looks} | {padded} | {1e3 * one:.1f} | {1 / one:.0f} |")

    generator = np.random.default_rng(1)

    def drawn(count: int) -> Looks:
        steps = np.stack([generator.integers(-60, 240, count), generator.integers(-100, 100, count)], axis=1)
        return Looks(steps, generator.choice([-1, 1], (count, 2)), generator.integers(0, 3, count))

    arrays = LookArrays(drawn(100), knowledge, False)
    (block, depth) = arrays.blocks[0]
    points = 0.1 * generator.standard_normal((BATCH, PARAMETERS))
    with jax.enable_x64(True):
        size = block.spots.valid.size
        sheets = jnp.asarray(np.resize(depth, size))
        image = jnp.asarray([1279.0, 719.0, 1279.0, 719.0])
        mapped = jax.jit(jax.vmap(lambda z: expect(z, knowledge.space, block, sheets, image).rows))
        batched = warm(lambda: mapped(jnp.asarray(points)).block_until_ready(), 3) / BATCH
        single = warm(lambda: arrays.at(points[0], knowledge.space), 3)
    print(
        f"\n100 looks at {BATCH} instruments: {1e3 * single:.1f} ms each one by one, {1e3 * batched:.1f} ms mapped.\n"
    )

    print("| candidates | looks linearised, s | one greedy step, ms | designs scored per second | 40 looks chosen, s |")
    print("|---|---|---|---|---|")
    for count in SIZES:
        looks = drawn(count)
        arrays = LookArrays(looks, knowledge, False)
        linearised = warm(lambda arrays=arrays: arrays.at(knowledge.z, knowledge.space), 1)
        seen = arrays.at(knowledge.z, knowledge.space)
        rows = seen.rows[..., :PARAMETERS]
        gradient = generator.standard_normal((4, PARAMETERS))
        search = Search(rows, knowledge.precision, gradient, np.zeros(4))
        step = warm(lambda search=search: search.after_one_more(search.covariance), 3)
        start = time.perf_counter()
        search.greedy(40)
        chosen = time.perf_counter() - start
        print(f"| {count} | {linearised:.2f} | {1e3 * step:.1f} | {count / step:.0f} | {chosen:.2f} |")


if __name__ == "__main__":
    main()
