"""The node of the docs publishes what `live --tcp` sends, as messages that ROS 2 takes.

There is no ROS here. `rclpy` and the packages of messages are stood in for by modules whose types come from the
definitions of a distribution, and which take no value that the real ones refuse.
"""

import json
import math
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from padforge.sense import Live, Recording
from padforge.sense.formats.ros_messages import HEALTH, PRESSED, READINGS, TOPICS, TOUCHES
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live.outputs import JsonLines, Message, MessageBuilder
from padforge.sense.localizer.model import LocalizerModel
from tests.docs.pages import BLOCK, ROOT
from tests.sense.conftest import first_presses

TOKEN = "a word of sixteen"
SECONDS = 1_800_000_000
INTEGERS = {"int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1)}


def node_of_the_page() -> str:
    page = (ROOT / "docs" / "howto-ros.md").read_text(encoding="utf-8")
    (code,) = [block["body"] for block in BLOCK.finditer(page) if "import rclpy" in block["body"]]
    return code


class MessageTypes:
    """Classes of messages as `rclpy` has them, by a distribution: strict about fields, types, ranges and lengths."""

    def __init__(self, store: Any) -> None:
        self.store, self.classes = store, dict[str, type]()

    def get(self, msgtype: str) -> type:
        if msgtype not in self.classes:
            constants, fields = self.store.fielddefs[msgtype]
            self.classes[msgtype] = self.make(msgtype, constants, dict(fields))
        return self.classes[msgtype]

    def make(self, msgtype: str, constants: Any, fields: dict[str, Any]) -> type:
        types = self

        class RosMessage:
            MSGTYPE = msgtype

            def __init__(self, **values: Any) -> None:
                for name, node in fields.items():
                    setattr(self, name, values.pop(name) if name in values else types.default(node))
                assert not values, f"{msgtype} has no {values}"

            def __setattr__(self, name: str, value: Any) -> None:
                assert name in fields, f"{msgtype} has no {name}"
                types.check(f"{msgtype}.{name}", fields[name], value)
                super().__setattr__(name, value)

        for name, kind, value in constants:
            setattr(RosMessage, name, bytes([value]) if kind == "byte" else value)
        return RosMessage

    def default(self, node: Any) -> Any:
        kind, content = node
        if kind == Nodetype.NAME:
            return self.get(content)()
        if kind == Nodetype.BASE:
            return {"string": "", "bool": False, "byte": b"\0", "float64": 0.0}.get(content[0], 0)
        return [self.default(content[0]) for _ in range(content[1] if kind == Nodetype.ARRAY else 0)]

    def check(self, what: str, node: Any, value: Any) -> None:
        kind, content = node
        if kind == Nodetype.NAME:
            assert type(value) is self.get(content), what
        elif kind == Nodetype.BASE:
            name = content[0]
            python = {"string": str, "bool": bool, "byte": bytes, "float64": float}.get(name, int)
            assert type(value) is python, f"{what} is {value!r}"
            low, high = INTEGERS.get(name, (-math.inf, math.inf))
            assert name in ("string", "bool", "byte", "float64") or low <= value <= high, what
            assert name != "byte" or len(value) == 1, what
        else:
            assert isinstance(value, list), what
            assert kind != Nodetype.ARRAY or len(value) == content[1], what
            for item in value:
                self.check(what, content[0], item)

    def to_json(self, node: Any, value: Any) -> Any:
        """Return a value as the protocol writes it, checked again, since lists may have grown."""
        self.check(str(node), node, value)
        kind, content = node
        if kind == Nodetype.NAME:
            fields = self.store.fielddefs[content][1]
            return {name: self.to_json(part, getattr(value, name)) for name, part in fields}
        if kind == Nodetype.BASE:
            return value[0] if content[0] == "byte" else None if value != value else value
        return [self.to_json(content[0], item) for item in value]


class Ros:
    """Modules that stand in for ROS, the parameters of the node, and what it published: topic, message as JSON."""

    def __init__(self, distribution: Stores, **parameters: Any) -> None:
        self.store, self.parameters = get_typestore(distribution), parameters
        self.types = MessageTypes(self.store)
        self.qos: dict[str, Any] = {}
        self.published: list[tuple[str, Any]] = []
        self.calls: list[str] = []

    def modules(self) -> Iterator[tuple[str, ModuleType]]:
        durability = SimpleNamespace(TRANSIENT_LOCAL="transient local", VOLATILE="volatile")
        parts = {
            "rclpy": {"init": self.init, "shutdown": lambda: self.calls.append("shutdown")},
            "rclpy.node": {"Node": lambda name: StandInNode(self, name)},
            "rclpy.qos": {"QoSProfile": make_qos, "DurabilityPolicy": durability},
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

    def of_topic(self, topic: str) -> list[Any]:
        return [message for name, message in self.published if name == topic]


def make_qos(*, depth: int, durability: str = "volatile") -> SimpleNamespace:
    return SimpleNamespace(depth=depth, durability=durability)


class StandInNode:
    def __init__(self, ros: Ros, name: str) -> None:
        assert "init" in ros.calls
        self.ros, self.name = ros, name

    def declare_parameter(self, name: str, value: Any) -> SimpleNamespace:
        chosen = self.ros.parameters.pop(name, value)
        assert type(chosen) is type(value)
        return SimpleNamespace(value=chosen)

    def create_publisher(self, kind: Any, topic: str, qos: SimpleNamespace) -> SimpleNamespace:
        assert kind is self.ros.types.get(kind.MSGTYPE)
        self.ros.qos[topic] = qos
        return SimpleNamespace(publish=lambda message: self.publish(topic, kind, message))

    def publish(self, topic: str, kind: Any, message: Any) -> None:
        assert type(message) is kind
        assert TOPICS[topic].msgtype == kind.MSGTYPE
        self.ros.published.append((topic, self.ros.types.to_json((Nodetype.NAME, kind.MSGTYPE), message)))

    def get_clock(self) -> SimpleNamespace:
        stamp = self.ros.types.get("builtin_interfaces/msg/Time")(sec=SECONDS, nanosec=len(self.ros.published))
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: stamp))

    def destroy_node(self) -> None:
        self.ros.calls.append("destroy_node")


@pytest.fixture(scope="module")
def messages(deep_recording: Recording, deep_localizer: LocalizerModel) -> list[Message]:
    """Of four presses on a pad that has learnt depth, one reading missing and one fibre at fault."""
    six = first_presses(deep_recording, 4)
    readings = six.readings.copy()
    readings[30, 1] = np.nan
    six = replace(six, readings=readings)
    pipeline = Live(deep_localizer, rate_hz=six.rate_hz)
    fault = FibreFault(press=3, since=1, fibres=(2,), kind="stuck", score=8.0)
    builder, messages = MessageBuilder(pipeline), []
    for first in range(0, len(six.readings), 10):
        block = six.times_s[first : first + 10], six.readings[first : first + 10]
        messages += builder.build(*block, [*pipeline.update(*block), *([fault] if first == 100 else [])])
    return messages


@pytest.mark.parametrize("distribution", ["ROS2_HUMBLE", "ROS2_KILTED"])
def test_node_publishes_every_line_as_a_message_of_ros(
    messages: list[Message], monkeypatch: pytest.MonkeyPatch, distribution: str
) -> None:
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
    assert ros.calls == ["init", "destroy_node", "shutdown"]
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
