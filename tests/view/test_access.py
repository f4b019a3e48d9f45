"""Access: browsers with the link, from this page alone."""

from __future__ import annotations

import pytest

from tvsbayes.view.live_server import SECURITY_HEADERS, TOKEN_HEADER, Access


@pytest.fixture
def access():
    return Access(4711)


def token_of(access: Access) -> str:
    return access.link.partition("#")[2]


def test_only_the_token_of_the_link_is_known(access):
    token = token_of(access)
    assert access.link == f"http://127.0.0.1:4711/#{token}" and len(token) >= 43
    assert access.knows({TOKEN_HEADER: token})
    for wrong in (token[:-1], token + "x", "", "ä", "\ud800", token_of(Access(4711))):
        assert not access.knows({TOKEN_HEADER: wrong})
    assert not access.knows({})


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
