"""Access: browsers with the link, from this page alone; one of them controls."""

from __future__ import annotations

import pytest

from tvsbayes.view.access import BROWSERS_MAX, KEY_HEADER, SECURITY_HEADERS, SILENT_S, Access


class Clock:
    """A clock that the test advances, s."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def access(clock):
    return Access(4711, clock)


def token_of(access: Access) -> str:
    return access.link.partition("#")[2]


def carrying(access: Access) -> dict[str, str]:
    """The headers of a new browser with the link."""
    return {KEY_HEADER: access.key_for(token_of(access))}


def test_every_browser_with_the_token_gets_a_key_of_its_own(access):
    token = token_of(access)
    assert access.link == f"http://127.0.0.1:4711/#{token}" and len(token) >= 43
    for wrong in (token[:-1], "", "ä", "\ud800"):
        assert access.key_for(wrong) is None
    first, second = carrying(access), carrying(access)
    assert len({token, first[KEY_HEADER], second[KEY_HEADER]}) == 3
    assert access.knows(first) and access.knows(second)
    assert not any(access.knows(wrong) for wrong in ({KEY_HEADER: token}, {}, {KEY_HEADER: ""}, {KEY_HEADER: "ä"}))
    assert access.controls(first) and not access.controls(second) and not access.controls({})


def test_control_passes_once_who_has_it_is_silent(access, clock):
    first, second = carrying(access), carrying(access)
    clock.now_s += 0.6 * SILENT_S
    assert not access.takes_over(first) and not access.takes_over({}) and not access.takes_over({KEY_HEADER: "x"})
    clock.now_s += 0.6 * SILENT_S
    assert not access.takes_over(second) and access.controls(first), "it asked a while ago"
    clock.now_s += 0.6 * SILENT_S
    assert access.takes_over(second) and access.controls(second) and not access.controls(first)
    assert not access.takes_over(second), "once"
    assert not access.takes_over(first) and access.controls(second), "who comes back watches"


def test_keys_are_bounded_and_control_is_not_lost_by_it(access, clock):
    first, second = carrying(access), carrying(access)
    for _ in range(BROWSERS_MAX):
        clock.now_s += 0.001
        last = carrying(access)
    assert access.controls(first) and access.knows(last) and not access.knows(second)


def test_no_two_pages_share_a_token(access):
    assert token_of(access) != token_of(Access(4711))


@pytest.mark.parametrize("host", ["127.0.0.1:4711", "localhost:4711"])
def test_own_page_may_ask(access, host):
    headers = {"Host": host}
    assert access.stranger(headers) is None
    assert access.stranger({**headers, "Origin": f"http://{host}", "Sec-Fetch-Site": "same-origin"}) is None
    assert access.stranger({**headers, "Sec-Fetch-Site": "none"}) is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"Host": "evil.example:4711"},
        {"Host": "127.0.0.1"},
        {"Host": "127.0.0.1:4712"},
        {"Host": "127.0.0.1:4711.evil.example"},
        {"Host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "https://127.0.0.1:4711"},
        {"Origin": "http://127.0.0.1:4712"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
)
def test_strangers_are_refused_in_words(access, wrong):
    assert access.stranger({"Host": "127.0.0.1:4711"} | wrong)


def test_page_may_load_from_its_server_alone():
    rules = dict(rule.split(" ", 1) for rule in SECURITY_HEADERS["Content-Security-Policy"].split("; "))
    assert rules["default-src"] == "'none'" and rules["connect-src"] == rules["script-src"] == "'self'"
    assert not [rule for rule in rules.values() if "http" in rule or "*" in rule]
