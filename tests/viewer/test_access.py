"""The rules for addresses, origins and tokens."""

from __future__ import annotations

import pytest

from snarfcli.viewer.access import Access, Request, is_loopback

PORT = 4321


def refusal(access: Access, path: str = "/", hosts=("127.0.0.1:4321",), origins=(), cookies=()) -> str | None:
    return access.refusal(Request(path, PORT, hosts, origins, cookies))


@pytest.mark.parametrize("host", ["127.0.0.1:4321", "localhost:4321", "[::1]:4321", "LOCALHOST:4321"])
def test_names_of_this_machine_need_no_token_on_loopback(host):
    access = Access("127.0.0.1")
    assert access.token is None
    assert access.address(PORT) == "http://127.0.0.1:4321"
    assert access.cookie(PORT) is None
    assert refusal(access, hosts=[host]) is None
    assert refusal(access, hosts=[host], origins=[f"http://{host}"]) is None


@pytest.mark.parametrize(
    "hosts",
    [["evil.example:4321"], ["evil.example"], ["127.0.0.1"], ["127.0.0.1:4322"], ["127.0.0.1.evil.example:4321"], [""], [],
     ["127.0.0.1:4321", "evil.example"], ["127.0.0.1:4321@evil.example"], ["10.0.0.1:4321"]],
)  # fmt: skip
def test_a_foreign_host_is_refused_on_loopback(hosts):
    assert refusal(Access("127.0.0.1"), hosts=hosts)
    assert refusal(Access("127.0.0.1"), hosts=hosts, origins=[f"http://{host}" for host in hosts])


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "", "http://127.0.0.1:9999", "http://127.0.0.1", "http://localhost:4321", "file://",
     "http://127.0.0.1:4321.evil.example", "http://127.0.0.1:4321/", "ws://127.0.0.1:4321"],
)  # fmt: skip
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_foreign_origin_is_refused_with_and_without_the_token(host, origin):
    access = Access(host)
    assert refusal(access, f"/?token={access.token}", origins=["http://127.0.0.1:4321"]) is None
    assert refusal(access, f"/?token={access.token}", origins=[origin])
    assert refusal(access, f"/?token={access.token}", origins=["http://127.0.0.1:4321", origin])


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "", "example.org"])
def test_other_addresses_need_the_token_of_this_start(host):
    access, other = Access(host), Access(host)
    assert access.token
    assert len(access.token) >= 32
    assert access.token != other.token
    name = f"snarf-view-{PORT}"
    for wrong in ("", "x", access.token[:-1], access.token + "x", other.token, "None", "\udc80", "ä"):
        assert refusal(access, f"/?token={wrong.encode(errors='replace').decode()}")
        assert refusal(access, cookies=[f"{name}={wrong}"])
    assert refusal(access)
    assert refusal(access, cookies=[f"snarf-view-9999={access.token}", ";;=;", access.token])
    assert refusal(access, f"/?token={access.token}") is None
    assert refusal(access, hosts=["any.name:80"], cookies=["a=b; c", f"d=e;{name}={access.token} ; f=g"]) is None
    assert refusal(access, f"/?token=wrong&token={access.token}", cookies=[f"{name}={access.token}"])


def test_the_cookie_is_hidden_from_scripts_and_foreign_pages():
    access = Access("0.0.0.0")
    assert access.cookie(PORT) == f"snarf-view-4321={access.token}; Path=/; HttpOnly; SameSite=Strict"


def test_addresses():
    assert Access("0.0.0.0").address(1).startswith("http://127.0.0.1:1/?token=")
    assert Access("::").address(1).startswith("http://[::1]:1/?token=")
    assert Access("192.168.0.7").address(1).startswith("http://192.168.0.7:1/?token=")
    assert Access("::1").address(1) == "http://[::1]:1"


def test_loopback():
    assert is_loopback("127.0.0.1")
    assert is_loopback("localhost")
    assert is_loopback("::1")
    assert not is_loopback("0.0.0.0")
    assert not is_loopback("192.168.0.2")
    assert not is_loopback("example.org")
