"""Random streams: one purpose, one stream, and no stream without a name."""

from __future__ import annotations

import re

import numpy as np
from support.package_imports import MODULES

from tvsbayes.statistics.streams import Stream, random_stream


def test_purposes_of_one_seed_are_independent_and_repeat():
    drawn = [random_stream(3, stream).standard_normal(4).tolist() for stream in Stream]
    assert len({tuple(each) for each in drawn}) == len(Stream)
    np.testing.assert_array_equal(
        random_stream(3, Stream.LOOKS).standard_normal(4), drawn[list(Stream).index(Stream.LOOKS)]
    )


def test_no_module_but_the_twin_numbers_its_streams():
    numbered = re.compile(r"default_rng\(\[[^\]]*, \d+\]\)")
    names = [name for name, path in MODULES.items() if numbered.search(path.read_text(encoding="utf-8"))]
    assert [name for name in names if not name.startswith("twin.")] == []
