"""Compiled kernels are kept on disk, but only as long as no kernel of their package has changed.

Numba looks at the file of a kernel alone: where another file holds what it calls, it would go on with the old code.
"""

from contextlib import suppress
from hashlib import sha256
from pathlib import Path


def forget_outdated(package: Path) -> None:
    """Delete the compiled kernels of a package folder if its sources are not those of the last call.

    Does nothing where the folder cannot be written: what is compiled then is not kept in it either.
    """
    kept = package / "__pycache__"
    with suppress(OSError):
        kept.mkdir(exist_ok=True)
        now = sha256(b"\0".join(source.read_bytes() for source in sorted(package.glob("*.py")))).digest()
        stamp = kept / "kernels.sha256"
        if stamp.exists() and stamp.read_bytes() == now:
            return
        for compiled in kept.glob("*.nb[ic]"):
            compiled.unlink(missing_ok=True)
        stamp.write_bytes(now)
