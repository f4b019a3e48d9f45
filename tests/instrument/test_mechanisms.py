"""The list of mechanisms: a copy is the entry itself, also in another process."""

from __future__ import annotations

import copy
import pickle

import pytest

from tvsbayes.instrument.mechanisms import MECHANISMS


@pytest.mark.parametrize("key", sorted(MECHANISMS))
def test_a_copy_is_the_same_object(key):
    """Readers and writers of files compare by identity; studies send rigs to other processes."""
    mechanism = MECHANISMS[key]
    assert copy.deepcopy(mechanism) is mechanism
    assert pickle.loads(pickle.dumps(mechanism)) is mechanism
