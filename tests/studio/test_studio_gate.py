"""Who may use the studio: hosts, origins, the token, by request and by websocket."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys

import pytest

pytest.importorskip("nicegui", reason="the extra `studio` is not installed")

from typer.testing import CliRunner

from drive_env.commands import studio
from drive_env.commands.cli import app
from drive_env.studio.gate import COOKIE, StudioGate, checked_token, is_loopback, new_token
from drive_env.studio.runs_page import HEADERS
from drive_env.studio.server import address, listen

TOKEN = "a-token-of-sixteen"
PASSED = {"type": "passed"}
HOST = "127.0.0.1:29640"


def ask(gate, kind="http", path="/axes", query="", **headers):
    """Return what the gate sends, or what is behind it; a header of two values is two headers."""
    sent = []

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    scope = {
        "type": kind, "path": path, "query_string": query.encode(),
        "headers": [
            (name.replace("_", "-").encode(), one.encode())
            for name, value in headers.items()
            for one in (value if isinstance(value, tuple) else (value,))
        ],
    }  # fmt: skip
    asyncio.run(gate(scope, receive, send))
    return sent


def gate(host="127.0.0.1", token=None):
    async def behind(scope, receive, send):
        await send(PASSED)

    return StudioGate(behind, host, 29640, token)


@pytest.mark.parametrize("host", ["127.0.0.1:29640", "localhost:29640", "LOCALHOST:29640", "[::1]:29640"])
def test_a_name_of_this_computer_may_come(host):
    assert ask(gate(), host=host) == [PASSED]


@pytest.mark.parametrize(
    "host", ["evil.example:29640", "127.0.0.1", "127.0.0.1:80", "localhost.evil.example:29640", ""]
)
@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_a_name_that_is_not_ours_is_refused(host, kind):
    """A page of another site that has pointed its own name at this computer: DNS rebinding."""
    sent = ask(gate(), kind, host=host)
    assert PASSED not in sent
    assert sent[0].get("status") == 421 or sent[0]["type"] == "websocket.close"


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:8000", "https://localhost:1"])
def test_a_page_of_another_site_is_refused(origin, kind):
    sent = ask(gate(), kind, host="127.0.0.1:29640", origin=origin)
    assert PASSED not in sent


def test_our_own_page_may_come():
    assert ask(gate(), "websocket", host="127.0.0.1:29640", origin="http://127.0.0.1:29640") == [PASSED]


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize("cookie", ["", f"{COOKIE}=wrong", f"other={TOKEN}", f"{COOKIE}={TOKEN}x"])
def test_without_the_token_nobody_comes(kind, cookie):
    sent = ask(gate("0.0.0.0", TOKEN), kind, host="machine:29640", cookie=cookie)
    assert PASSED not in sent
    assert sent[0].get("status") == 401 or sent[0]["type"] == "websocket.close"


def test_the_token_in_the_address_becomes_a_cookie():
    sent = ask(gate("0.0.0.0", TOKEN), path="/scope", query=f"axis=1&token={TOKEN}", host="machine:29640")
    headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    assert sent[0]["status"] == 303 and headers["location"] == "/scope?axis=1"
    assert "HttpOnly" in headers["set-cookie"]
    cookie = headers["set-cookie"].partition(";")[0]
    for kind in ("http", "websocket"):
        assert ask(gate("0.0.0.0", TOKEN), kind, host="machine:29640", cookie=cookie) == [PASSED]


def test_a_wrong_token_in_the_address_is_refused():
    assert ask(gate("0.0.0.0", TOKEN), query="token=guess", host="machine:29640")[0]["status"] == 401


def test_the_token_does_not_let_another_site_in():
    sent = ask(gate("0.0.0.0", TOKEN), host="machine:29640", cookie=f"{COOKIE}={TOKEN}", origin="http://evil.example")
    assert sent[0]["status"] == 403


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    "twice",
    [{"host": (HOST, HOST)}, {"host": ("evil.example", HOST)},
     {"host": HOST, "origin": ("http://evil.example", f"http://{HOST}")},
     {"host": HOST, "origin": (f"http://{HOST}", f"http://{HOST}")}],
)  # fmt: skip
def test_two_hosts_or_two_origins_are_refused(twice, kind):
    sent = ask(gate(), kind, **twice)
    assert PASSED not in sent
    assert sent[0].get("status") == 400 or sent[0]["type"] == "websocket.close"


@pytest.mark.parametrize(
    "origin", ["http://[", "http://]", "\x00", f"//{HOST}/http://", "file://", "chrome-extension://x"]
)
def test_an_origin_that_is_none_is_refused(origin):
    assert ask(gate(), host=HOST, origin=origin)[0].get("status") == 403


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize("token", [None, TOKEN])
@pytest.mark.parametrize(
    "path", ["//evil.example/", "///evil.example", "/\\evil.example/", "/axes\r\nset-cookie: a=b", "/a\x00b", "/\x7f"]
)
def test_an_address_that_leads_elsewhere_or_breaks_a_header_is_refused(path, token, kind):
    """A redirect to //evil.example was one to evil.example; a line break in a redirect was a traceback."""
    where, query = ("0.0.0.0", f"token={token}") if token else ("127.0.0.1", "")
    for cookie in ("", f"{COOKIE}={TOKEN}"):
        sent = ask(gate(where, token), kind, path, query, host=HOST, cookie=cookie)
        assert PASSED not in sent
        assert sent[0].get("status") == 400 or sent[0]["type"] == "websocket.close"


def test_a_redirect_writes_the_address_as_it_was_asked_for():
    sent = ask(gate("0.0.0.0", TOKEN), path="/größe und mehr", query=f"token={TOKEN}", host=HOST)
    assert dict(sent[0]["headers"])[b"location"] == b"/gr%C3%B6%C3%9Fe%20und%20mehr"


# --- frames -------------------------------------------------------------------------------------------------------
def framed(message):
    """Return X-Frame-Options and Content-Security-Policy of an answer, each as often as it is there."""
    names = (b"x-frame-options", b"content-security-policy")
    return [value for wanted in names for name, value in message["headers"] if name.lower() == wanted]


def answering(headers=()):
    async def behind(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": list(headers)})

    return StudioGate(behind, "127.0.0.1", 29640, None)


def test_nobody_shows_an_answer_in_a_frame():
    """A click for the page around it would have been one of ours."""
    nobody = [b"DENY", b"frame-ancestors 'none'"]
    assert framed(ask(answering(), host=HOST)[0]) == nobody
    assert framed(ask(answering(), host="evil.example")[0]) == nobody  # what is refused
    assert framed(ask(gate("0.0.0.0", TOKEN), host=HOST)[0]) == nobody
    assert framed(ask(gate("0.0.0.0", TOKEN), host=HOST, query=f"token={TOKEN}")[0]) == nobody


def test_reports_are_shown_in_frames_of_our_own():
    own = {name.lower().encode(): value.encode() for name, value in HEADERS.items()}
    options, policy = framed(ask(answering(own.items()), host=HOST)[0])
    assert options == b"SAMEORIGIN" and policy.endswith(b"frame-ancestors 'self'")


@pytest.mark.parametrize(("host", "is_it"), [
    ("127.0.0.1", True), ("localhost", True), ("::1", True), ("127.5.5.5", True), ("0.0.0.0", False),
    ("192.168.1.4", False), ("machine", False),
])  # fmt: skip
def test_what_a_loopback_address_is(host, is_it):
    assert is_loopback(host) is is_it


def test_tokens():
    assert len(new_token()) >= 20 and new_token() != new_token()
    assert checked_token(TOKEN) == TOKEN
    for wrong in ("short", "with spaces in it", "x" * 11):
        with pytest.raises(ValueError, match="12 or more"):
            checked_token(wrong)


def test_a_taken_port_is_told_with_what_to_do():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=rf"{port}: another program has it; .* --port"):
            listen("127.0.0.1", port)


def test_an_address_that_is_none_of_this_computer():
    with pytest.raises(
        ValueError, match=r"cannot listen on 192\.0\.2\.1.*no such address; give --listen one of its own"
    ):
        listen("192.0.2.1", 0)


def test_what_a_browser_opens():
    assert address("127.0.0.1", 29640, None) == "http://127.0.0.1:29640/"
    assert address("0.0.0.0", 29640, TOKEN).endswith(f":29640/?token={TOKEN}")
    assert address("::1", 29640, None) == "http://[::1]:29640/"


# --- the command --------------------------------------------------------------------------------------------------
def run(*options):
    return CliRunner().invoke(app, ["studio", "--no-browser", *options])


def test_a_taken_port_ends_the_command_with_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        found = run("--port", str(port))
    assert found.exit_code == 2
    assert found.output.strip().startswith(f"drive-env: cannot listen on 127.0.0.1:{port}: another program has it")
    assert "Traceback" not in found.output


def test_without_the_extra_the_command_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(studio.importlib.util, "find_spec", lambda name: None)
    found = run()
    assert found.exit_code == 2
    assert "pip install 'drive-env[studio]'" in found.output


@pytest.mark.parametrize(("options", "says"), [
    (("--channel", "socket://127.0.0.1:1", "--load", "belt"), "--load is of an emulated machine"),
    (("--port", "70000"), "must be 0 to 65535"),
    (("--listen", ""), "must be an address"),
    (("--token", "short"), "12 or more"),
    (("--load", "no such load"), "no such load"),
    (("--device", "no such device"), "no such device"),
    (("--motor", "no such motor"), "no such motor"),
    (("--duration", "0"), "above 0 s"),
])  # fmt: skip
def test_mistakes_are_told_before_anything_is_opened(options, says):
    found = run(*options)
    assert found.exit_code == 2 and says in found.output, found.output


@pytest.mark.slow
def test_a_bus_that_is_not_there_ends_the_command_with_one_line():
    command = [sys.executable, "-c", "from drive_env.programs import drive_env; drive_env()", "studio"]
    options = ["--no-browser", "--port", "0", "--channel", "socket://127.0.0.1:1"]
    found = subprocess.run([*command, *options], capture_output=True, text=True, timeout=60, check=False)
    assert found.returncode == 2
    assert "no hub answers at socket://127.0.0.1:1" in found.stderr and "Traceback" not in found.stderr, found.stderr
