"""Workflows run what was looked at: a tag of an action may be moved, a commit may not."""

import re
from pathlib import Path

WORKFLOWS = Path(__file__).parents[2] / ".github" / "workflows"


def test_workflows_name_actions_by_commit() -> None:
    """With the version beside it, which Dependabot raises with the commit."""
    used = [line for path in WORKFLOWS.glob("*.yml") for line in re.findall(r"uses: (.*)", path.read_text())]
    actions = [action for action in used if not action.startswith("./")]
    assert len(actions) > 10
    for action in actions:
        assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action), action
