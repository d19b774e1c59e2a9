"""Attack a running `snarf view`, and report what it lets in, how its memory grows and how fast it ends.

    python tools/trust_viewer.py
    python tools/trust_viewer.py --avatar outputs/builtin/50002/demo/avatar.pt

The long form of `tests/viewer/test_door.py`, on a process of its own (Linux). The exit code is 1 if something is not as wanted.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import itertools
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from viser_page import Client, open_socket
from websockets.exceptions import ConnectionClosed, InvalidStatus
from wrong_messages import wrong_bytes, wrong_messages

from snarfcli.viewer.door import MAX_CLIENTS

_ROOT = Path(__file__).resolve().parents[1]
_PATIENCE_S = 300
_MOST_GROWTH_MIB = 32  # the first wrong messages and clients load modules and fill caches
_MOST_CTRL_C_S = 2.0
_CHILD = "import sys; from snarfcli.cli.main import main; sys.exit(main(sys.argv[1:]))"
_FOREIGN = ("http://evil.example", "https://evil.example", "null", "http://127.0.0.1:1", "http://localhost", "file://", None)


class Viewer:
    """A process that runs `snarf view`."""

    def __init__(self, avatar: Path, *settings: str) -> None:
        command = [sys.executable, "-c", _CHILD, "view", "--no-open", f"ckpt={avatar}", *settings]
        path = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH")]))
        self.process = subprocess.Popen(
            command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": path}
        )
        assert self.process.stdout is not None
        for line in self.process.stdout:
            address = re.search(r"page: (http://127\.0\.0\.1:(\d+)\S*)", line)
            if address:
                self.token, self.port = address[1].partition("?token=")[2], int(address[2])
                return
        sys.exit(f"the viewer did not start: {self.process.communicate()[1]}")

    @property
    def memory_mib(self) -> float:
        """Resident memory, MiB."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(r"VmRSS:\s+(\d+) kB", status)[1]) / 1024

    def interrupt(self) -> tuple[float, str]:
        """Send what Ctrl-C sends; return the time until the process has ended, and how."""
        start = time.monotonic()
        self.process.send_signal(signal.SIGINT)
        _, errors = self.process.communicate(timeout=_PATIENCE_S)
        return time.monotonic() - start, f"exit code {self.process.returncode}, {errors.strip()}"


@contextlib.contextmanager
def running(*arguments) -> Iterator[Viewer]:
    """Start a viewer, and end it whatever happens."""
    viewer = Viewer(*arguments)
    try:
        yield viewer
    finally:
        viewer.process.kill()


class Report:
    """Prints one line per test, and remembers whether all went well."""

    def __init__(self) -> None:
        self.is_good = True

    def add(self, what: str, result: str, is_good: bool) -> None:
        """Print one line."""
        self.is_good &= is_good
        print(f"{'ok    ' if is_good else 'FAILED'}  {what:46}  {result}", flush=True)


def handshake(port: int, **changes) -> int:
    """Return the status of the answer to a handshake, 101 for a connection."""
    try:
        with open_socket(port, **changes):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def get(port: int, path: str = "/", **headers: str) -> int:
    """Return the status of the answer to a request."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_PATIENCE_S)
    connection.request("GET", path, headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


def try_foreigners(viewer: Viewer, report: Report) -> None:
    """Connect as pages of other origins, and under other names."""
    port = viewer.port
    answers = [handshake(port, origin=origin) for origin in _FOREIGN]
    answers += [get(port, Origin=origin) for origin in _FOREIGN if origin is not None]
    report.add("foreign origins", f"{answers.count(403)} of {len(answers)} refused", set(answers) == {403})
    hosts = (f"evil.example:{port}", "evil.example", "127.0.0.1", f"127.0.0.1.evil.example:{port}", f"192.168.0.1:{port}")
    answers = [handshake(port, headers={"Host": host}, origin=f"http://{host}") for host in hosts]
    answers += [get(port, Host=host) for host in hosts]
    report.add("foreign Host", f"{answers.count(403)} of {len(answers)} refused", set(answers) == {403})
    answers = [handshake(port), get(port)]
    report.add("the page itself", f"answers {answers}", answers == [101, 200])


def try_tokens(viewer: Viewer, report: Report) -> None:
    """Connect with and without the token to a viewer at all addresses."""
    port, token = viewer.port, viewer.token
    wrong = ["", "x", token[:-1], token + "x", token.swapcase()]
    answers = [get(port), handshake(port)]
    answers += [get(port, f"/?token={word}") for word in wrong]
    answers += [handshake(port, headers={"Cookie": f"snarf-view-{port}={word}"}) for word in wrong]
    report.add("no or a wrong token", f"{answers.count(403)} of {len(answers)} refused", set(answers) == {403})
    cookie = {"Cookie": f"snarf-view-{port}={token}"}
    answers = [get(port, f"/?token={token}"), get(port, "/", **cookie), handshake(port, headers=cookie)]
    report.add("the right token", f"answers {answers}", answers == [303, 200, 101])


def try_wrong_messages(viewer: Viewer, report: Report, count: int) -> None:
    """Send wrong messages of every kind; a page must work afterwards."""
    source, before = random.Random(0), viewer.memory_mib
    with Client(viewer.port) as page:
        page.until_text("vertices")
        inputs = [message["uuid"] for message in page.messages if "value" in message]
        for message in itertools.islice(itertools.cycle(wrong_messages(inputs, source)), count):
            page.send(message)
        for data in wrong_bytes(source):
            page.send_bytes(data)
        wait_until_read(page)
        page.change("height", 0.25)
        page.until_node("/avatar/plain", "vertices")
    grown = viewer.memory_mib - before
    what = f"{count} wrong messages, of {len(inputs)} inputs and others"
    report.add(what, f"{before:.0f} MiB, {grown:+.1f} MiB", grown < _MOST_GROWTH_MIB)


def wait_until_read(page: Client) -> None:
    """Wait until the viewer has read all messages of a page: it answers a wrong value with the true one."""
    page.change("Resolution", "3000")
    resolution = page.uuid("Resolution")
    page.until(lambda message: message.get("uuid") == resolution and "value" in message["updates"])


def try_clients(viewer: Viewer, report: Report, count: int, rounds: int) -> None:
    """Connect many clients at once, several times."""
    before, stayed, memory = viewer.memory_mib, [], []
    for _ in range(rounds):
        sockets = [open_socket(viewer.port) for _ in range(count)]
        stayed.append(0)
        for connection in sockets:
            try:
                connection.recv(timeout=_PATIENCE_S)
                stayed[-1] += 1
            except ConnectionClosed:
                pass
        for connection in sockets:
            connection.close()
        deadline = time.monotonic() + _PATIENCE_S
        while handshakes_left(viewer.port) and time.monotonic() < deadline:
            time.sleep(0.1)
        memory.append(viewer.memory_mib - before)
    growth = ", ".join(f"{grown:+.1f}" for grown in memory)
    result = f"{max(stayed)} at a time served, {before:.0f} MiB, {growth} MiB"
    report.add(f"{count} clients, {rounds} times", result, set(stayed) == {MAX_CLIENTS} and memory[-1] < _MOST_GROWTH_MIB)


def handshakes_left(port: int) -> bool:
    """Return whether a new client is sent away because the others have not left yet."""
    with open_socket(port) as connection:
        try:
            connection.recv(timeout=_PATIENCE_S)
        except ConnectionClosed:
            return True
    return False


def try_flood(viewer: Viewer, report: Report, count: int) -> None:
    """Move a slider as fast as the connection takes it."""
    before, start, source = viewer.memory_mib, time.monotonic(), random.Random(0)
    with Client(viewer.port) as page:
        page.until_text("vertices")
        slider = page.uuid("height")
        for _ in range(count):
            page.send({"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": source.uniform(-1, 1)}})
        wait_until_read(page)
    rate, grown = count / (time.monotonic() - start), viewer.memory_mib - before
    report.add(
        f"{count} values as fast as they are taken", f"{rate:.0f} per second, {grown:+.1f} MiB", grown < _MOST_GROWTH_MIB
    )


def try_ctrl_c(viewer: Viewer, report: Report, when: str) -> None:
    """End a viewer that is computing a surface for a client."""
    with Client(viewer.port) as page:
        page.until_text("computing")
        seconds, how = viewer.interrupt()
    is_good = seconds < _MOST_CTRL_C_S and how == "exit code 130, snarf view: interrupted"
    report.add(f"Ctrl-C {when}", f"{seconds:.2f} s, {how}", is_good)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--avatar", type=Path, default=_ROOT / "tests/golden/avatar.pt", help="avatar to view")
    parser.add_argument("--messages", type=int, default=500, help="number of wrong messages")
    parser.add_argument("--clients", type=int, default=100, help="number of clients at once")
    options = parser.parse_args()
    report = Report()
    with running(options.avatar, "resolution=64") as viewer:
        try_foreigners(viewer, report)
        try_wrong_messages(viewer, report, options.messages)
        try_clients(viewer, report, options.clients, rounds=5)
        try_flood(viewer, report, 2 * options.messages)
    with running(options.avatar, "resolution=64", "host=0.0.0.0") as viewer:
        try_tokens(viewer, report)
    for surface in ("skinned", "field"):
        with running(options.avatar, "resolution=512", f"surface={surface}") as viewer:
            try_ctrl_c(viewer, report, f"during a {surface} surface, resolution 512")
    return 0 if report.is_good else 1


if __name__ == "__main__":
    sys.exit(main())
