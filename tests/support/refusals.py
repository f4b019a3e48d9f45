"""What a call refuses."""

from __future__ import annotations

import pytest

from tvsbayes.errors import InputError


def refusal(call) -> InputError:
    with pytest.raises(InputError) as caught:
        call()
    return caught.value
