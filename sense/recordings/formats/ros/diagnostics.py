"""The health of a pad as `diagnostic_msgs`."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.sense.recordings.formats.model_findings import ModelFindings
from padforge.sense.recordings.recording import Recording

from padforge.sense.recordings.formats.ros import topics
from padforge.sense.recordings.formats.ros.cdr import blank

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_OK, _ERROR = 0, 2


def health_messages(
    store: "Typestore", recording: Recording, findings: ModelFindings, readings: NDArray[np.int64]
) -> tuple[NDArray[np.int64], list[NDArray[np.uint8]]]:
    """A message with the state of every fibre at the first reading, and one whenever a fault is found.

    Args:
        readings: (R,) stamps, ns.

    Returns:
        (n,) stamps and the bytes of as many messages.
    """
    bad: dict[int, tuple[str, str]] = {}
    for fibre in findings.dead:
        bad[fibre] = ("dead", "was dead in the recording that health was learnt from")
    stamps, messages = [int(readings[0])], [_message(store, recording.fibres, bad, int(readings[0]))]
    ends = topics.stamps_at(readings, recording.lifted)
    for fault in findings.faults or ():
        bad |= dict.fromkeys(fault.fibres, (fault.kind, fault.text))
        stamps.append(int(ends[min(fault.press, len(ends) - 1)]))
        messages.append(_message(store, recording.fibres, bad, stamps[-1]))
    return np.array(stamps, np.int64), messages


def _message(store: "Typestore", fibres: int, bad: dict[int, tuple[str, str]], stamp: int) -> NDArray[np.uint8]:
    status = [_status(store, fibre, *bad.get(fibre, ("", "sound"))) for fibre in range(fibres)]
    message = blank(store, topics.KINDS[topics.HEALTH], status=status)
    message.header.frame_id = topics.FRAME
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return np.frombuffer(bytes(store.serialize_cdr(message, message.__msgtype__)), np.uint8)


def _status(store: "Typestore", fibre: int, kind: str, text: str) -> Any:
    values = [blank(store, "diagnostic_msgs/msg/KeyValue", key="fault", value=kind)] if kind else []
    return blank(
        store,
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=_ERROR if kind else _OK,
        name=f"pad: fibre {fibre + 1}",
        message=text,
        hardware_id="pad",
        values=values,
    )
