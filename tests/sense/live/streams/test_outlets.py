"""Ways out: who hears what, who does not, and that nobody has to wait."""

import errno
import json
import re
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from design.common.errors import InputError
from design.common.page.local_page import listening
from sense.live.streams import outlets
from sense.live.streams.messages import Message
from sense.live.streams.outlets import Lines, Osc
from sense.recordings.formats.ros.topics import HEALTH, PRESSED, READINGS, TOUCHES

TOUCH = Message(
    TOUCHES, {}, {"event": "touch", "press": 4, "x_mm": 1.5, "y_mm": -2.25, "r50_mm": 0.5, "r90_mm": 1.0, "lost": []}
)
READING = Message(READINGS, {}, {"event": "readings", "time_s": 0.5, "volts": [1.0, None]})
STATES = Message(HEALTH, {}, {"event": "health", "time_s": 0.0, "states": ["sound", "stuck"]})
TOKEN = "a word of sixteen"
CLIENT = Path(__file__).parents[4] / "docs" / "live-protocol.md"


def wait_for(lines: Lines, clients: int) -> None:
    end = time.monotonic() + 20
    while len(lines._server._clients) < clients:  # pyright: ignore[reportPrivateUsage]
        assert time.monotonic() < end
        time.sleep(0.005)


def test_all_clients_hear_all_from_when_they_came() -> None:
    with ExitStack() as stack:
        with Lines("127.0.0.1", 0) as lines:
            lines.tell(STATES)
            lines.tell(READING)
            clients = [stack.enter_context(socket.create_connection(lines.address)) for _ in range(2)]
            wait_for(lines, 2)
            lines.tell(TOUCH)
        for client in clients:
            told = [json.loads(line) for line in client.makefile()]
            assert [each["topic"] for each in told] == [HEALTH, TOUCHES]
            assert [each["pad"]["number"] for each in told] == [0, 2]


def test_the_client_of_the_docs_prints_places() -> None:
    code = re.search(r"<!-- client -->\n```python\n(.*?)```", CLIENT.read_text(encoding="utf-8"), re.DOTALL)
    assert code
    with Lines("127.0.0.1", 0) as lines:
        client = subprocess.Popen(
            [sys.executable, "-c", code[1], str(lines.address[1])], stdout=subprocess.PIPE, text=True
        )
        wait_for(lines, 1)
        for message in (READING, TOUCH, TOUCH):
            lines.tell(message)
    assert client.communicate(timeout=20)[0] == "1.5, -2.2 mm, within 1.0 mm\n" * 2


def test_without_the_token_nothing_is_heard() -> None:
    with Lines("127.0.0.1", 0, TOKEN) as lines:
        lines.tell(STATES)
        for said in (b"\n", TOKEN[:-1].encode() + b"\n", TOKEN.encode() + b"x\n", b"\xff" * 4000):
            with socket.create_connection(lines.address) as client:
                client.sendall(said)
                client.shutdown(socket.SHUT_WR)
                with suppress(ConnectionResetError):
                    assert client.recv(100) == b""
        with socket.create_connection(lines.address) as client:
            client.sendall(TOKEN.encode() + b"\r\n")
            assert json.loads(client.makefile().readline())["topic"] == HEALTH


class Long(Message):
    """A message whose line is long, and made beforehand."""

    text = '"' + "x" * 400_000 + '"'

    def line(self, number: int) -> str:
        return self.text


def test_one_that_does_not_listen_holds_up_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlets, "MOST_BEHIND", 50)
    with ExitStack() as stack, Lines("127.0.0.1", 0) as lines:
        stack.enter_context(socket.create_connection(lines.address))
        wait_for(lines, 1)
        (deaf,) = lines._server._clients  # pyright: ignore[reportPrivateUsage]
        for _ in range(200):
            lines.tell(Long(READINGS, {}, {}))
        assert deaf._behind  # pyright: ignore[reportPrivateUsage]
        client = stack.enter_context(socket.create_connection(lines.address))
        lines.tell(STATES)  # which also those hear who come a moment later
        assert json.loads(client.makefile().readline())["topic"] == HEALTH
        stack.close()  # whoever sends to the deaf one would wait until it is given up


def test_a_stranger_has_a_moment_to_say_the_token_however_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listening, "ADMIT_S", 0.5)
    with ExitStack() as stack:
        lines = stack.enter_context(Lines("127.0.0.1", 0, "long" * 60))
        lines.tell(STATES)
        known, stranger = (stack.enter_context(socket.create_connection(lines.address)) for _ in range(2))
        known.sendall(b"long" * 60 + b"\n")
        begun = time.monotonic()
        with suppress(OSError):
            while time.monotonic() < begun + 10:
                stranger.sendall(b"x")
                time.sleep(0.1)
        assert time.monotonic() < begun + 5
        lines.tell(TOUCH)
        told = known.makefile()
        assert [json.loads(told.readline())["topic"] for _ in range(2)] == [HEALTH, TOUCHES]


def test_what_was_told_before_the_end_still_arrives() -> None:
    """To one that is slow: the end of the program would cut it off."""
    heard: list[str] = []

    def listen(client: socket.socket) -> None:
        time.sleep(0.2)
        heard.extend(client.makefile())

    with ExitStack() as stack:
        with Lines("127.0.0.1", 0) as lines:
            client = stack.enter_context(socket.create_connection(lines.address))
            wait_for(lines, 1)
            for _ in range(30):
                lines.tell(Long(READINGS, {}, {}))
            slow = threading.Thread(target=listen, args=(client,))
            slow.start()
        assert not lines._server._clients  # pyright: ignore[reportPrivateUsage]
        slow.join(20)
    assert len(heard) == 30


def test_others_may_listen_only_with_a_token() -> None:
    for host, token, message in (
        ("0.0.0.0", "", "whoever knows a token may listen"),
        ("127.0.0.1", "short", "token has 5 characters, allowed are 16 to 256"),
        ("127.0.0.1", "é" * 20, "those of plain text"),
        ("203.0.113.1", TOKEN, "expected an address of this machine"),
        ("no.such.host.invalid", TOKEN, "expected an address of this machine"),
    ):
        with pytest.raises(InputError, match=message):
            Lines(host, 0, token)


def test_osc_tells_numbers() -> None:
    from pythonosc.osc_message import OscMessage

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(20)
        pressed = Message(PRESSED, {}, {"event": "pressed", "pressed": True})
        for message, values in (
            (TOUCH, [4, 1.5, -2.25, 0.5, 1.0]),
            (pressed, [True]),
            (STATES, ["sound", "stuck"]),
        ):
            with Osc(f"127.0.0.1:{heard.getsockname()[1]}") as osc:
                osc.tell(message)
                osc.tell(READING)
            told = OscMessage(heard.recv(4096))
            assert (told.address, told.params) == (message.topic, values)
            volts = OscMessage(heard.recv(4096)).params
            assert volts[0] == 1.0
            assert volts[1] != volts[1]


def test_osc_goes_on_while_its_network_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """And looks no name up again, which may take long then."""
    with Osc("localhost:9") as osc:
        looked_up, gone = [], OSError(errno.ENETUNREACH, "Network is unreachable")
        monkeypatch.setattr(socket, "getaddrinfo", lambda *asked, **more: looked_up.append(asked))

        class Away:
            def sendto(self, data: bytes, address: tuple[str, int]) -> None:
                looked_up.extend([address] if address[0] == "localhost" else [])
                raise gone

            def close(self) -> None: ...

        osc._client._sock.close()  # pyright: ignore[reportPrivateUsage]
        osc._client._sock = Away()  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]
        osc.tell(TOUCH)
    assert looked_up == []


def test_an_address_that_nothing_can_be_sent_to_is_told() -> None:
    for address, reason in (("255.255.255.255:9", "nothing can be sent there"), ("a..b:9", "no such host")):
        with pytest.raises(InputError, match=reason):
            Osc(address)


@pytest.mark.parametrize("address", ["", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:x", ":9000", "127.0.0.1:99999"])
def test_an_address_of_osc_is_a_host_and_a_port(address: str) -> None:
    with pytest.raises(InputError, match="expected HOST:PORT"):
        Osc(address)


def test_lsl_tells_readings_and_touches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process of its own, which looks for streams on this machine alone."""
    (tmp_path / "lsl.cfg").write_text("[multicast]\nResolveScope = machine\n[log]\nlevel = -3\n")
    code = """
import pylsl
from sense.live.streams.outlets import Lsl
from tests.sense.live.streams.test_outlets import READING, TOUCH
lsl = Lsl("a pad", 2, 13.0)
found = [pylsl.resolve_byprop("name", f"a pad {what}", timeout=20)[0] for what in ("readings", "touches")]
readings, touches = (pylsl.StreamInlet(info) for info in found)
for inlet in (readings, touches):
    inlet.open_stream(timeout=20)
channel = readings.info().desc().child("channels").child("channel")
print(channel.child_value("label"), channel.child_value("unit"), found[0].nominal_srate(), found[0].channel_count())
lsl.tell(READING)
lsl.tell(TOUCH)
print(readings.pull_sample(timeout=20)[0], touches.pull_sample(timeout=20)[0])
"""
    monkeypatch.setenv("LSLAPICFG", str(tmp_path / "lsl.cfg"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.splitlines() == ["fibre 1 V 13.0 2", "[1.0, nan] [4.0, 1.5, -2.25, 0.5, 1.0]"], done.stderr
