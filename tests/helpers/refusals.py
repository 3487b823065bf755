from collections.abc import Callable, Mapping

from padforge.common.validation import InputError
from padforge.sense.rig.devices import RigFault


def refusal_table(rows: Mapping[str, Callable[[], object]]) -> str:
    """Return what each call raises: its name, its cause or kind, and its words, one line."""
    lines = []
    for name, call in rows.items():
        said = "nothing is raised"
        try:
            call()
        except (InputError, RigFault, ValueError) as error:
            kind = error.cause if isinstance(error, RigFault) else type(error).__name__
            said = f"[{kind}] {error}"
            assert "\n" not in said, name
        lines.append(f"{name}:\n    {said}")
    return "\n".join(lines)


def require_one_line(error: InputError) -> None:
    assert "\n" not in str(error)
    assert len(str(error)) < 5000
