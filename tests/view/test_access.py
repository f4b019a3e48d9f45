"""Who may ask: one link, one browser, this page alone."""

from __future__ import annotations

import pytest

from tvsbayes.view.access import KEY_HEADER, SECURITY_HEADERS, Access


@pytest.fixture
def access():
    return Access(4711)


def token_of(access: Access) -> str:
    return access.link.partition("#")[2]


def test_token_is_good_once(access):
    token = token_of(access)
    assert access.link == f"http://127.0.0.1:4711/#{token}" and len(token) >= 43
    assert access.key_for(token[:-1]) is None and access.key_for("") is None and access.key_for("ä") is None
    assert access.key_for("\ud800") is None
    key = access.key_for(token)
    assert key and key != token
    assert access.key_for(token) is None
    assert access.link == "http://127.0.0.1:4711/#"
    assert access.knows({KEY_HEADER: key}) and not access.knows({KEY_HEADER: token}) and not access.knows({})
    assert not access.knows({KEY_HEADER: "ä"})


def test_no_two_pages_share_a_token(access):
    assert token_of(access) != token_of(Access(4711))


@pytest.mark.parametrize("host", ["127.0.0.1:4711", "localhost:4711"])
def test_own_page_may_ask(access, host):
    own = {"Host": host}
    assert access.stranger(own) is None
    assert access.stranger({**own, "Origin": f"http://{host}", "Sec-Fetch-Site": "same-origin"}) is None
    assert access.stranger({**own, "Sec-Fetch-Site": "none"}) is None


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
def test_strangers_are_told_so(access, wrong):
    assert access.stranger({"Host": "127.0.0.1:4711"} | wrong)


def test_page_may_load_from_its_server_alone():
    rules = dict(rule.split(" ", 1) for rule in SECURITY_HEADERS["Content-Security-Policy"].split("; "))
    assert rules["default-src"] == "'none'" and rules["connect-src"] == rules["script-src"] == "'self'"
    assert not [rule for rule in rules.values() if "http" in rule or "*" in rule]
