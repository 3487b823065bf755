import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"(?:^<!-- (?P<kind>run|file)(?:: (?P<how>[^\n]*))? -->\n+)?"
    r"^```(?P<language>\w*)(?: title=\"(?P<title>[^\"\n]+)\")?\n(?P<body>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


def command_lines(body: str) -> list[str]:
    return body.replace("\\\n", " ").splitlines()


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))
