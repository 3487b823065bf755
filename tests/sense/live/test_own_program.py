"""The programs of the docs, and its node for ROS 2, which publishes what `live --tcp` sends.

There is no ROS here. `rclpy` and the packages of messages are stood in for by modules whose types come from the
definitions of a distribution, and which take no value that the real ones refuse.
"""

import json
import math
import re
import sys
import threading
import time
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import serial
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from padforge.sense import Live, Recording
from padforge.sense.formats.ros_messages import HEALTH, PRESSED, READINGS, TOPICS, TOUCHES
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live.outputs import JsonLines, Message, MessageBuilder
from padforge.sense.localizer.model import LocalizerModel
from tests.docs.pages import BLOCK, ROOT
from tests.helpers.presses import changed
from tests.sense.conftest import first_presses
from tests.sense.recording.test_recording import repeated

pytestmark = pytest.mark.usefixtures("here")
PAGE = (ROOT / "docs" / "howto-program.md").read_text(encoding="utf-8")
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
PLACE = re.compile(r"press (\d+): (-?[\d.]+), (-?[\d.]+) mm, within")


def check_places(printed: str, recording: Recording) -> int:
    """Check that presses are located at all that well; return how many lines say so."""
    places = np.array(PLACE.findall(printed), dtype=float)
    assert len(places) == len(printed.splitlines())
    pressed_mm = recording.presses_mm[places[:, 0].astype(int)]
    assert np.median(np.hypot(*(places[:, 1:] - pressed_mm).T)) < 6
    return len(places)


def test_program_prints_each_press(localizer: LocalizerModel, recording: Recording, capsys) -> None:
    localizer.save("out/example")
    recording.save("out/example/recording", {})
    exec(PROGRAMS[0], {})
    assert check_places(capsys.readouterr().out, recording) == 9


def test_program_reads_a_board(localizer: LocalizerModel, recording: Recording, monkeypatch, capsys) -> None:
    """A board that prints 106 lines a second, until it is unplugged."""
    stream = repeated(recording, 8)
    times_s, rows = iter(stream.times_s[:1500].tolist()), iter(stream.readings[:1500])

    class Board:
        def __init__(self, port: str, baud: int) -> None:
            assert (port, baud) == ("/dev/ttyACM0", 115200)

        def __enter__(self) -> "Board":
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def readline(self) -> bytes:
            return ",".join(f"{volts:.6f}" for volts in next(rows)).encode() + b"\r\n"

    localizer.save("out/pad")
    with monkeypatch.context() as patched:
        patched.setattr(serial, "Serial", Board)
        patched.setattr(time, "monotonic", lambda: next(times_s))
        with pytest.raises(StopIteration):
            exec(PROGRAMS[1], {})
    assert check_places(capsys.readouterr().out, recording) > 40


TOKEN = "a word of sixteen"
SECONDS = 1_800_000_000
INTEGERS = {"int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1)}


def node_of_the_page() -> str:
    page = (ROOT / "docs" / "howto-ros.md").read_text(encoding="utf-8")
    (code,) = [block["body"] for block in BLOCK.finditer(page) if "import rclpy" in block["body"]]
    return code


class MessageTypes:
    """Classes of messages as `rclpy` has them, by a distribution, and what it takes of their instances."""

    def __init__(self, store: Any) -> None:
        self.store, self.classes = store, dict[str, type]()

    def get(self, msgtype: str) -> type:
        if msgtype not in self.classes:
            constants, fields = self.store.fielddefs[msgtype]

            def begin(message: Any, /, **values: Any) -> None:
                vars(message).update({name: self.default(node) for name, node in fields} | values)

            parts = {name: bytes([value]) if kind == "byte" else value for name, kind, value in constants}
            self.classes[msgtype] = type(msgtype, (), {**parts, "MSGTYPE": msgtype, "__init__": begin})
        return self.classes[msgtype]

    def default(self, node: Any) -> Any:
        kind, content = node
        if kind == Nodetype.NAME:
            return self.get(content)()
        if kind == Nodetype.BASE:
            return {"string": "", "bool": False, "byte": b"\0", "float64": 0.0}.get(content[0], 0)
        return [self.default(content[0]) for _ in range(content[1] if kind == Nodetype.ARRAY else 0)]

    def to_json(self, node: Any, value: Any) -> Any:
        """Return a value as the protocol writes it: `rclpy` is strict about fields, types, ranges and lengths."""
        kind, content = node
        if kind == Nodetype.NAME:
            fields = dict(self.store.fielddefs[content][1])
            assert (type(value), vars(value).keys()) == (self.get(content), fields.keys())
            return {name: self.to_json(part, vars(value)[name]) for name, part in fields.items()}
        if kind == Nodetype.BASE:
            python = {"string": str, "bool": bool, "byte": bytes, "float64": float}.get(content[0], int)
            assert type(value) is python, f"{content[0]} is {value!r}"
            if python is int:
                low, high = INTEGERS.get(content[0], (-math.inf, math.inf))
                assert low <= value <= high
            return int.from_bytes(value) if python is bytes and len(value) == 1 else None if value != value else value
        assert isinstance(value, list)
        assert kind != Nodetype.ARRAY or len(value) == content[1]
        return [self.to_json(content[0], item) for item in value]


class Ros:
    """Modules that stand in for ROS, its one node, and what that published: topic, message as JSON."""

    def __init__(self, distribution: Stores, **parameters: Any) -> None:
        self.store, self.parameters = get_typestore(distribution), parameters
        self.types = MessageTypes(self.store)
        self.qos: dict[str, Any] = {}
        self.published: list[tuple[str, Any]] = []
        self.calls: list[str] = []

    def modules(self) -> Iterator[tuple[str, ModuleType]]:
        durability = SimpleNamespace(TRANSIENT_LOCAL="transient local", VOLATILE="volatile")
        profile = lambda *, depth, durability="volatile": SimpleNamespace(depth=depth, durability=durability)  # noqa: E731
        parts = {
            "rclpy": {"init": self.init, "shutdown": lambda: self.calls.append("shutdown")},
            "rclpy.node": {"Node": lambda name: self},
            "rclpy.qos": {"QoSProfile": profile, "DurabilityPolicy": durability},
            "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO="no", ALL="all")},
        }
        for package in ("std_msgs", "geometry_msgs", "diagnostic_msgs"):
            names = [name for name in self.store.fielddefs if name.startswith(f"{package}/msg/")]
            parts |= {package: {}, f"{package}.msg": {name.split("/")[2]: self.types.get(name) for name in names}}
        for name, content in parts.items():
            vars(module := ModuleType(name)).update(content)
            yield name, module

    def init(self, *, signal_handler_options: str = "all") -> None:
        assert signal_handler_options == "no"  # with rclpy's handlers Ctrl-C would not end the wait
        self.calls.append("init")

    def declare_parameter(self, name: str, value: Any) -> SimpleNamespace:
        chosen = self.parameters.pop(name, value)
        assert type(chosen) is type(value)
        self.calls.append("declare")
        return SimpleNamespace(value=chosen)

    def create_publisher(self, kind: Any, topic: str, qos: SimpleNamespace) -> SimpleNamespace:
        def publish(message: Any) -> None:
            self.published.append((topic, self.types.to_json((Nodetype.NAME, kind.MSGTYPE), message)))

        assert kind is self.types.get(TOPICS[topic].msgtype)
        self.qos[topic] = qos
        return SimpleNamespace(publish=publish)

    def get_clock(self) -> SimpleNamespace:
        stamp = self.types.get("builtin_interfaces/msg/Time")(sec=SECONDS, nanosec=len(self.published))
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: stamp))

    def destroy_node(self) -> None:
        self.calls.append("destroy_node")

    def of_topic(self, topic: str) -> list[Any]:
        return [message for name, message in self.published if name == topic]


@pytest.fixture(scope="module")
def messages(deep_recording: Recording, deep_localizer: LocalizerModel) -> list[Message]:
    """Of four presses on a pad that has learnt depth, one reading missing and one fibre at fault."""
    six = changed(first_presses(deep_recording, 4), "readings", (30, 1), np.nan)
    pipeline = Live(deep_localizer, rate_hz=six.rate_hz)
    fault = FibreFault(press=3, since=1, fibres=(2,), kind="stuck", score=8.0)
    builder, messages = MessageBuilder(pipeline), []
    for first in range(0, len(six.readings), 10):
        block = six.times_s[first : first + 10], six.readings[first : first + 10]
        messages += builder.build(*block, [*pipeline.update(*block), *([fault] if first == 100 else [])])
    return messages


@pytest.mark.parametrize("distribution", ["ROS2_HUMBLE", "ROS2_KILTED"])
def test_node_publishes_every_line_as_a_message_of_ros(messages: list[Message], monkeypatch, distribution: str) -> None:
    with JsonLines("127.0.0.1", 0, TOKEN) as lines:
        ros = Ros(Stores[distribution], port=lines.address[1], token=TOKEN)
        for name, module in ros.modules():
            monkeypatch.setitem(sys.modules, name, module)
        health, *later = messages
        lines.send(health)  # before the node comes
        node = threading.Thread(target=exec, args=(node_of_the_page(), {"__name__": "__main__"}))
        node.start()
        deadline_s = time.monotonic() + 20
        while not ros.published and node.is_alive() and time.monotonic() < deadline_s:
            time.sleep(0.01)
        for message in later:
            lines.send(message)
    node.join(20)
    assert ros.calls == ["init", *["declare"] * 3, "destroy_node", "shutdown"]
    assert ros.parameters == {}
    assert [topic for topic, _ in ros.published] == [message.topic for message in messages]
    assert {topic for topic, _ in ros.published} == {READINGS, PRESSED, TOUCHES, HEALTH}
    for number, ((_, message), sent) in enumerate(zip(ros.published, messages, strict=True)):
        expected = json.loads(json.dumps(sent.msg))
        if "header" in expected:
            expected["header"]["stamp"] = {"sec": SECONDS, "nanosec": number}
        assert message == expected
    assert {topic for topic, qos in ros.qos.items() if qos.durability == "transient local"} == {HEALTH}
    assert ros.qos[HEALTH].depth == 1
    assert any(None in message["data"] for message in ros.of_topic(READINGS))
    poses = [message["pose"] for message in ros.of_topic(TOUCHES)]
    assert any(pose["pose"]["position"]["z"] < 0 < pose["covariance"][14] for pose in poses)
    assert ros.of_topic(HEALTH)[-1]["status"]
