"""The queue of requests: order, no doubles, bounds, the end."""

from __future__ import annotations

import threading

import pytest

from tvsbayes.acquisition.live_control import (
    ACKNOWLEDGED,
    FAILED,
    KEPT_MAX,
    LASER_OFF,
    PAUSE,
    REQUESTED,
    RESUME,
    STOP,
    Requests,
)


def test_requests_come_in_order_and_laser_off_first():
    requests = Requests()
    for what in ("pause", "stop", "laser off", "resume"):
        requests.ask(what)
    done = []
    while (request := requests.next()) is not None:
        done.append(requests.settle(request, ACKNOWLEDGED, "yes").what)
    assert done == ["laser off", "pause", "stop", "resume"]


def test_a_double_click_is_one_request():
    requests = Requests()
    first = requests.ask("pause")
    assert requests.ask("pause") == first and len(requests.recent()) == 1
    requests.settle(first, ACKNOWLEDGED, "")
    assert requests.ask("pause").number == 2


def test_unknown_request_is_refused():
    requests = Requests()
    for what in ("laser on", "", None, 3):
        with pytest.raises(ValueError):
            requests.ask(what)
    assert requests.recent() == ()


def test_settled_requests_are_kept_but_not_all():
    requests = Requests()
    for _ in range(3 * KEPT_MAX):
        requests.settle(requests.ask("pause"), ACKNOWLEDGED, "")
    assert len(requests.recent()) <= KEPT_MAX + 1
    assert requests.recent()[-1].number == 3 * KEPT_MAX


def test_after_the_end_nothing_waits_and_nothing_is_taken():
    requests = Requests()
    for what in (PAUSE, STOP, LASER_OFF, RESUME):
        requests.ask(what)
    requests.close("the run has ended")
    assert requests.next() is None and requests.ask("stop") is None
    assert {(r.state, r.answer) for r in requests.recent()} == {(FAILED, "the run has ended")}


def test_waiting_ends_with_a_request_of_another_thread():
    requests = Requests()
    thread = threading.Thread(target=requests.ask, args=("stop",))
    thread.start()
    while requests.next() is None:
        requests.wait(60.0)
    thread.join()
    assert requests.next().what == "stop"


@pytest.mark.parametrize("what", [PAUSE, STOP, LASER_OFF])
def test_a_resume_that_waits_is_withdrawn_by_what_stops(what: str) -> None:
    """Also where the stopping request waited before it and is not made a second time."""
    requests = Requests()
    requests.ask(what)
    requests.ask(RESUME)
    requests.ask(what)
    waiting = [request.what for request in requests.recent() if request.state == REQUESTED]
    assert waiting == [what]
    assert [request.state for request in requests.recent() if request.what == RESUME] == [FAILED]
