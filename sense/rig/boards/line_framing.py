"""The line protocol: samples as lines of text, so plain that any board can be made to speak it.

    # padforge-line 1 name=my-board rate_hz=500 bits=12 reference_v=3.3 channels=4 check=crc32*f0771b8a
    2000,2048,1991,870,2003*1503e78d
    4000,2049,1990,871,2004*fbc86327

The header comes whenever the board starts, and whenever the host sends a question mark. `rate_hz` is the number of
samples a second, `bits` how many each count has, `reference_v` the voltage of the highest count, `channels` the number
of inputs. `name`, `serial` and other words are the board's own.

A sample is the board's time in us, whole and going up, which may wrap around at 2^32, and a count of every input. A
sample that cannot be sent is left out: its time is missing, and so it is counted as lost.

With `check=crc32` all lines end in a star and eight hexadecimal digits: the CRC-32 (zlib's) of all before the star. A
line that was damaged on its way is then never taken for another one. Lines end in LF or CR LF; other lines that begin
with `#` are for people."""

from binascii import crc32
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from padforge.sense.arrays import MAX_FIBRES

ASK = b"?"
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 10_000.0

_MAGIC, _VERSION = "# padforge-line", "1"
_LIMITS = {
    "rate_hz": (MIN_RATE_HZ, MAX_RATE_HZ),
    "bits": (1, 24),
    "reference_v": (0.1, 100),
    "channels": (1, MAX_FIBRES),
}
_MAX_LINE = 8192
_MAX_TIME = 2**63
"""Of a clock that does not wrap around."""


@dataclass(frozen=True)
class LineHeader:
    """What a board says of itself; `checked` where its lines carry a check, `said` the words that are its own."""

    rate_hz: float
    bits: int
    reference_v: float
    channels: int
    checked: bool = True
    said: tuple[tuple[str, str], ...] = ()

    @property
    def full_scale(self) -> int:
        """The highest count."""
        return 2**self.bits - 1


@dataclass(frozen=True)
class Sample:
    """A sample: the board's time in us, wrapped or not, and (C,) counts."""

    time_us: int
    counts: tuple[int, ...]


def header_line(header: LineHeader) -> bytes:
    """A header as it is sent."""
    numbers = ((name, f"{getattr(header, name):g}") for name in _LIMITS)
    words = [*header.said, *numbers, *([("check", "crc32")] if header.checked else [])]
    return _line(f"{_MAGIC} {_VERSION} " + " ".join(map("=".join, words)), header.checked)


def sample_line(time_us: int, counts: Sequence[int], checked: bool) -> bytes:
    """A sample as it is sent."""
    return _line(",".join(map(str, (time_us, *counts))), checked)


def _line(text: str, checked: bool) -> bytes:
    body = text.encode("ascii")
    return body + (b"*%08x\n" % crc32(body) if checked else b"\n")


class LineDecoder:
    """Finds headers and samples in a stream of bytes that comes in any portions.

    Attributes:
        header: the latest; before the first there are no samples.
        damaged: lines since then that were neither.
    """

    def __init__(self) -> None:
        self.header: LineHeader | None = None
        self.damaged = 0
        self._complaints: Counter[str] = Counter()
        self._rest = b""

    @property
    def in_a_row(self) -> int:
        """Lines since the last sample, or so far, that should have been samples or headers and were not."""
        return self._complaints.total()

    @property
    def complaint(self) -> str:
        """What was wrong with most of them."""
        return max(self._complaints, key=lambda said: self._complaints[said], default="")

    def feed(self, data: bytes) -> list[LineHeader | Sample]:
        """The headers and samples that `data` completes, in order."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[: _MAX_LINE + 1]  # one byte too long is damaged whatever follows
        return [found for line in lines if (found := self._found(line.removesuffix(b"\r"))) is not None]

    def _found(self, line: bytes) -> LineHeader | Sample | None:
        try:
            if line.startswith(_MAGIC.encode()):
                found = self.header = _header(_verified(line).decode("ascii"))
            elif self.header is None or not line or line.startswith(b"#"):
                return None
            else:
                found = _sample(line, self.header)
        except ValueError as error:
            self._complaints[str(error)] += 1
            self.damaged += self.header is not None
            return None
        self._complaints.clear()
        return found


def _verified(line: bytes) -> bytes:
    """The line without its check, if it has one; raises ValueError where that does not fit."""
    body, star, check = line.rpartition(b"*")
    if not star:
        return line
    if check.lower() != b"%08x" % crc32(body):
        raise ValueError("the check does not fit")
    return body


def _header(text: str) -> LineHeader:
    version, *words = text.removeprefix(_MAGIC).split()
    if version != _VERSION:
        raise ValueError(f"it speaks version {version} of the line protocol, expected {_VERSION}")
    said = dict(word.split("=", 1) for word in words if "=" in word)
    if (check := said.pop("check", "none")) not in ("crc32", "none"):
        raise ValueError(f"check is {check[:20]!r}, allowed are crc32 and none")
    rate_hz, bits, reference_v, channels = (_number(name, said.pop(name, "missing")) for name in _LIMITS)
    return LineHeader(rate_hz, int(bits), reference_v, int(channels), check == "crc32", tuple(said.items()))


def _number(name: str, text: str) -> float:
    low, high = _LIMITS[name]
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high or (isinstance(low, int) and value != int(value)):
        raise ValueError(f"{name} of its header is {text[:20]!r}, allowed is {low:g} to {high:g}")
    return value


def _sample(line: bytes, header: LineHeader) -> Sample:
    if len(line) > _MAX_LINE:
        raise ValueError(f"a line of more than {_MAX_LINE} bytes")
    if header.checked and b"*" not in line:
        raise ValueError("a line has no check")
    numbers = _verified(line).split(b",")
    if len(numbers) != 1 + header.channels:
        raise ValueError(f"a line has {len(numbers)} numbers, expected {1 + header.channels}: the time and the inputs")
    if not all(map(bytes.isdigit, numbers)):
        raise ValueError(f"a line begins {line[:20].decode('ascii', 'replace')!r}, expected whole numbers only")
    time_us, *counts = map(int, numbers)
    if time_us >= _MAX_TIME:
        raise ValueError("the time of a line is beyond all clocks")
    if max(counts) > header.full_scale:
        raise ValueError(f"a count is {max(counts)}, its header allows {header.full_scale}")
    return Sample(time_us, tuple(counts))
