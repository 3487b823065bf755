"""Robotics viewers as outputs of a live pad: Foxglove, which connects to a server of this process, and Rerun.

Both show the readings, the state of the pad and its fibres, and in 3D the latest touch: a disc with its radius of 90 %
on the sensed area.
"""

import contextlib
import math
from pathlib import Path
from typing import Any

from padforge.common.files import atomic_file
from padforge.common.server import HOST
from padforge.common.validation import InputError, short_repr
from padforge.sense.formats.ros_messages import FRAME, HEALTH, PRESSED, READINGS, TOPICS, TOUCHES
from padforge.sense.live.outputs import Message
from padforge.sense.localizer.single_press import OTHER_PAD

SCENE = "/pad/scene"
THICKNESS_MM = 1.0  # thickness of the disc
BLUE = (0.13, 0.47, 0.71, 0.8)  # red, green, blue and alpha of the disc
GREY = (0.5, 0.5, 0.5, 0.3)  # the same of the sensed area


class FoxgloveOutput(contextlib.AbstractContextManager["FoxgloveOutput"]):
    """A WebSocket server of this machine for Foxglove: all messages as JSON, and the scene in m, frame `pad`.

    No web page can read it, except the Foxglove app. The sensed area has a centre (x, y), and half a width and height.
    Raises InputError if the port (0 for any free one) cannot be used.
    """

    def __init__(self, port: int, centre_mm: list[float], half_mm: list[float]) -> None:
        import foxglove
        from foxglove.channels import SceneUpdateChannel

        from padforge.sense.live.foxglove_gate import FoxgloveGate, hidden_host

        channels: dict[str, foxglove.Channel] = {}
        latest: dict[str, dict[str, Any]] = {}

        class Listener(foxglove.websocket.ServerListener):
            """Repeats the state of the fibres, which is sent only when it changes, to clients that connect later."""

            def on_subscribe(self, client: Any, channel: Any) -> None:
                if channel.topic == HEALTH and HEALTH in latest:
                    channels[HEALTH].log(latest[HEALTH])

        self._channels, self._latest = channels, latest
        self._context = foxglove.Context()  # not the global one, since a process may show two pads
        options = {"context": self._context, "server_listener": Listener()}
        host = hidden_host()
        with contextlib.ExitStack() as stack:
            server = foxglove.start_server(name="padforge", host=host, port=0, **options)
            stack.callback(server.stop)
            gate = stack.enter_context(FoxgloveGate(port, (host, server.port)))
            self._stack = stack.pop_all()
        self.url = f"ws://{HOST}:{gate.server_address[1]}"
        self._scene = SceneUpdateChannel(SCENE, context=self._context)
        self._centre_mm, self._half_mm = centre_mm, half_mm

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def send(self, message: Message) -> None:
        import foxglove

        if message.topic not in self._channels:
            schema = _json_schema(message.msg) | {"title": TOPICS[message.topic].msgtype}
            self._channels[message.topic] = foxglove.Channel(message.topic, schema=schema, context=self._context)
        self._channels[message.topic].log(message.msg)
        self._latest[message.topic] = message.msg
        if message.topic == TOUCHES:
            self._scene.log(self._scene_update(message))

    def _scene_update(self, touch: Message) -> Any:
        from foxglove import messages

        def solid(position: dict[str, float], *size_mm: float, color: tuple[float, ...]) -> dict[str, Any]:
            pose = messages.Pose(position=messages.Vector3(**position), orientation=messages.Quaternion(w=1.0))
            size = messages.Vector3(**{axis: mm / 1000 for axis, mm in zip("xyz", size_mm, strict=True)})
            return {"pose": pose, "size": size, "color": messages.Color(**dict(zip("rgba", color, strict=True)))}

        x, y = self._centre_mm
        centre = {"x": x / 1000, "y": y / 1000, "z": 0.0}
        width, height = 2 * self._half_mm[0], 2 * self._half_mm[1]
        area = messages.CubePrimitive(**solid(centre, width, height, THICKNESS_MM / 2, color=GREY))
        diameter = 2 * touch.pad["r90_mm"]
        disc = solid(touch.msg["pose"]["pose"]["position"], diameter, diameter, THICKNESS_MM, color=BLUE)
        discs = [messages.CylinderPrimitive(**disc, bottom_scale=1.0, top_scale=1.0)]
        touch_entity = messages.SceneEntity(frame_id=FRAME, id="touch", cubes=[area], cylinders=discs)
        return messages.SceneUpdate(entities=[touch_entity])


def _json_schema(value: Any) -> dict[str, Any]:
    """Return the JSON Schema of values like this one, in which None is a missing number."""
    if isinstance(value, dict):
        return {"type": "object", "properties": {name: _json_schema(item) for name, item in value.items()}}
    if isinstance(value, list):
        return {"type": "array", "items": _json_schema(value[0] if value else None)}
    return {"type": {bool: "boolean", str: "string"}.get(type(value), "number")}


class RerunOutput(contextlib.AbstractContextManager["RerunOutput"]):
    """A stream for Rerun, in V and mm by the clock of the readings, to a viewer or into a file.

    The target is the address of a viewer, rerun+http://HOST:PORT/proxy, or a file that ends in .rrd, which appears,
    complete, at the end of the `with` block. Raises InputError if it is neither, or the file cannot be written.
    """

    def __init__(self, target: str, fibres: int, centre_mm: list[float], half_mm: list[float]) -> None:
        import rerun
        from rerun import blueprint

        x, y, height = *centre_mm, 3 * max(half_mm)
        eye = blueprint.EyeControls3D(position=[x, y, height], look_target=[x, y, 0.0], eye_up=[0.0, 1.0, 0.0])
        scene = blueprint.Spatial3DView(origin="pad", eye_controls=eye)
        plots = [blueprint.TimeSeriesView(origin=name) for name in ("readings", "pressed")]
        data = blueprint.Vertical(*plots, blueprint.TextLogView(origin="health"))
        self._stream = rerun.RecordingStream("padforge")
        self._pressed = False
        with contextlib.ExitStack() as stack:
            try:
                if Path(target).suffix == ".rrd":
                    self._stream.save(stack.enter_context(atomic_file(Path(target))))
                else:
                    self._stream.connect_grpc(target)
            except (RuntimeError, UnicodeError) as error:
                expected = "an address like rerun+http://HOST:PORT/proxy, or a file that ends in .rrd"
                raise InputError(f"--rerun is {short_repr(target)}, expected {expected}") from error
            stack.callback(self._stream.disconnect)  # flushes the file before it is renamed
            self._stream.send_blueprint(blueprint.Blueprint(blueprint.Horizontal(scene, data)))
            area = rerun.Boxes3D(centers=[[*centre_mm, 0.0]], half_sizes=[[*half_mm, 0.0]], colors=[GREY])
            self._stream.log("pad", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            self._stream.log("pad/area", area, static=True)
            names = [f"fibre {fibre}" for fibre in range(1, fibres + 1)]
            self._stream.log("readings", rerun.SeriesLines(names=names), static=True)
            self._stack = stack.pop_all()

    def __exit__(self, *error: object) -> None:
        self._stack.close()  # completes the file also after Ctrl-C, the usual end of a live pad

    def send(self, message: Message) -> None:
        import rerun

        pad = message.pad
        self._stream.set_time("pad_time", duration=pad["now_s"] if message.topic == TOUCHES else pad["time_s"])
        if message.topic in (READINGS, PRESSED):
            if message.topic == READINGS:
                volts = [math.nan if value is None else value for value in pad["volts"]]
                self._stream.log("readings", rerun.Scalars(volts))
            self._pressed = pad.get("pressed", self._pressed)
            # Sent at every reading and at every change, since Rerun joins points by lines, and an edge must be steep.
            self._stream.log("pressed", rerun.Scalars([float(self._pressed)]))
        elif message.topic == TOUCHES:
            z_mm = 1000 * message.msg["pose"]["pose"]["position"]["z"]
            half_mm = [pad["r90_mm"], pad["r90_mm"], THICKNESS_MM / 2]
            disc = rerun.Ellipsoids3D(
                centers=[[pad["x_mm"], pad["y_mm"], z_mm]], half_sizes=[half_mm], colors=[BLUE], fill_mode="solid"
            )
            self._stream.log("pad/touch", disc)
        elif message.topic == HEALTH:
            text = ", ".join(f"fibre {fibre}: {state}" for fibre, state in enumerate(pad["states"], 1))
            text += f"; {OTHER_PAD}" if pad["other_pad"] else ""
            is_warning = "fault" in pad or pad["other_pad"]
            self._stream.log("health", rerun.TextLog(text, level="WARN" if is_warning else "INFO"))
