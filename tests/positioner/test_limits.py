"""Every soft limit holds at its last step, and an arrival elsewhere is none, whatever the device says of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
from positioner.test_driver import connected, simulated

from tvsbayes.errors import DeviceFault
from tvsbayes.positioner.firmware_model import DeviceModel

LIMITS = {"hp": -60, "ht": -40, "pmin": -300, "pmax": 200, "tmin": -150, "tmax": 100}


@pytest.mark.parametrize(("axis", "last"), [(0, -300), (0, 200), (1, -150), (1, 100)])
def test_the_last_step_inside_a_limit_is_reached_and_the_next_refused(axis, last):
    positioner = connected(simulated(), LIMITS)
    positioner.home()
    inside, outside = [0, 0], [0, 0]
    inside[axis], outside[axis] = last, last + (1 if last > 0 else -1)
    state = positioner.move_to(*inside)
    assert [state.pan_steps, state.tilt_steps] == inside
    with pytest.raises(DeviceFault) as caught:
        positioner.move_to(*outside)
    assert caught.value.code == "refused-limit"
    state = positioner.state()
    assert [state.pan_steps, state.tilt_steps] == inside, "a refused move moves nothing"


@pytest.mark.parametrize("field", ["pan_steps", "tilt_steps", "pan_target_steps", "tilt_target_steps"])
def test_done_at_another_place_is_no_arrival(field, monkeypatch):
    """A step lost between the counter and the answer; the sequence and the status are those of an arrival."""
    positioner = connected(simulated(), LIMITS)
    positioner.home()
    truth = DeviceModel.state.fget

    def lie(device):
        state = truth(device)
        return replace(state, **{field: getattr(state, field) - 1})

    monkeypatch.setattr(DeviceModel, "state", property(lie))
    with pytest.raises(DeviceFault) as caught:
        positioner.move_to(120, 30)
    assert caught.value.code == "position"
