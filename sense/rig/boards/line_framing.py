"""The line protocol: samples as lines of text, so plain that any board can be programmed to speak it.

docs/devices.md describes it.
"""

from binascii import crc32
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from padforge.sense.arrays import MAX_FIBRES

HEADER_REQUEST = b"?"
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 10_000.0

_MAGIC, _VERSION = "# padforge-line", "1"
_LIMITS = {
    "rate_hz": (MIN_RATE_HZ, MAX_RATE_HZ),
    "bits": (1, 24),
    "reference_v": (0.1, 100),
    "channels": (1, MAX_FIBRES),
}
_MAX_LINE = 8192
_MAX_TIME = 2**63  # of a clock that does not wrap around


@dataclass(frozen=True)
class LineHeader:
    """The header of a board."""

    rate_hz: float  # samples a second
    bits: int  # of a count
    reference_v: float  # voltage of the highest count
    channels: int  # number of inputs
    checked: bool = True  # whether its lines have a check
    extra: tuple[tuple[str, str], ...] = ()  # the board's own words and their values

    @property
    def full_scale(self) -> int:
        """The highest count."""
        return 2**self.bits - 1


@dataclass(frozen=True)
class LineSample:
    """A sample: the board's time in us, wrapped or not, and (C,) counts."""

    time_us: int
    counts: tuple[int, ...]


def format_header(header: LineHeader) -> bytes:
    """Return a header as it is sent."""
    numbers = ((name, f"{getattr(header, name):g}") for name in _LIMITS)
    words = [*header.extra, *numbers, *([("check", "crc32")] if header.checked else [])]
    return _format_line(f"{_MAGIC} {_VERSION} " + " ".join(map("=".join, words)), header.checked)


def format_sample(time_us: int, counts: Sequence[int], checked: bool) -> bytes:
    """Return a sample as it is sent."""
    return _format_line(",".join(map(str, (time_us, *counts))), checked)


def _format_line(text: str, checked: bool) -> bytes:
    body = text.encode("ascii")
    return body + (b"*%08x\n" % crc32(body) if checked else b"\n")


class LineDecoder:
    """Decodes headers and samples from a stream of bytes that comes in any portions."""

    def __init__(self) -> None:
        self.header: LineHeader | None = None  # the latest; before the first there are no samples
        self._errors: Counter[str] = Counter()
        self._tail = b""

    @property
    def n_errors(self) -> int:
        """Number of damaged lines since the last sample or header."""
        return self._errors.total()

    @property
    def error(self) -> str:
        """What was wrong with most of them."""
        return max(self._errors, key=lambda text: self._errors[text], default="")

    def decode(self, data: bytes) -> list[LineHeader | LineSample]:
        """Return the headers and samples that `data` completes, in order."""
        *lines, tail = (self._tail + data).split(b"\n")
        self._tail = tail[: _MAX_LINE + 1]  # one byte too long is damaged whatever follows
        return [item for line in lines if (item := self._decode_line(line.removesuffix(b"\r"))) is not None]

    def _decode_line(self, line: bytes) -> LineHeader | LineSample | None:
        try:
            if line.startswith(_MAGIC.encode()):
                item = self.header = _parse_header(_verify(line).decode("ascii"))
            elif self.header is None or not line or line.startswith(b"#"):
                return None
            else:
                item = _parse_sample(line, self.header)
        except ValueError as error:
            self._errors[str(error)] += 1
            return None
        self._errors.clear()
        return item


def _verify(line: bytes) -> bytes:
    """Return the line without its check, if it has one; ValueError if that does not fit."""
    body, star, check = line.rpartition(b"*")
    if not star:
        return line
    if check.lower() != b"%08x" % crc32(body):
        raise ValueError("the check does not fit")
    return body


def _parse_header(text: str) -> LineHeader:
    version, *words = text.removeprefix(_MAGIC).split()
    if version != _VERSION:
        raise ValueError(f"it speaks version {version} of the line protocol, expected {_VERSION}")
    values = dict(word.split("=", 1) for word in words if "=" in word)
    if (check := values.pop("check", "none")) not in ("crc32", "none"):
        raise ValueError(f"check is {check[:20]!r}, allowed are crc32 and none")
    rate_hz, bits, reference_v, channels = (_parse_number(name, values.pop(name, "missing")) for name in _LIMITS)
    return LineHeader(rate_hz, int(bits), reference_v, int(channels), check == "crc32", tuple(values.items()))


def _parse_number(name: str, text: str) -> float:
    low, high = _LIMITS[name]
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high or (isinstance(low, int) and value != int(value)):
        raise ValueError(f"{name} of its header is {text[:20]!r}, allowed is {low:g} to {high:g}")
    return value


def _parse_sample(line: bytes, header: LineHeader) -> LineSample:
    if len(line) > _MAX_LINE:
        raise ValueError(f"a line of more than {_MAX_LINE} bytes")
    if header.checked and b"*" not in line:
        raise ValueError("a line has no check")
    numbers = _verify(line).split(b",")
    if len(numbers) != 1 + header.channels:
        raise ValueError(f"a line has {len(numbers)} numbers, expected {1 + header.channels}: the time and the inputs")
    if not all(map(bytes.isdigit, numbers)):
        raise ValueError(f"a line begins {line[:20].decode('ascii', 'replace')!r}, expected whole numbers only")
    time_us, *counts = map(int, numbers)
    if time_us >= _MAX_TIME:
        raise ValueError("the time of a line is beyond all clocks")
    if max(counts) > header.full_scale:
        raise ValueError(f"a count is {max(counts)}, its header allows {header.full_scale}")
    return LineSample(time_us, tuple(counts))
