"""What the documentation site has beside the pages of this folder: pages of the house, and pages made from the code."""

import ast
import json
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from padforge.settings import section_models

ROOT = Path(__file__).resolve().parents[1]
HOUSE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "sense/rig/boards/firmware/padforge_line/README.md": "firmware-line.md",
}
"""Pages of the site by the files that they are."""
API = ("design", "fabricate", "sense")
_LINK = re.compile(r"(!?\[[^\]]*\]\()(?!\w+:|#)([^)#\s]+)((?:#[^)\s]*)?\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages of the house, pictures, and pages that are made from the code."""
    for source, page in HOUSE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for picture in sorted((ROOT / "out" / "gallery").iterdir()):
        files.append(File.generated(config, f"gallery/{picture.name}", abs_src_path=str(picture)))
    files.append(File.generated(config, "commands.md", content=commands()))
    files.append(File.generated(config, "settings.md", content=settings()))
    for package in API:
        files.append(File.generated(config, f"api-{package}.md", content=reference(package)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the house into links between pages of the site."""
    sources = {site: source for source, site in HOUSE.items()}
    here = sources.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def turned(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(here), link[2]))
        if not (ROOT / target).is_file():
            return link[0]
        site = HOUSE.get(target) or re.sub(r"^(docs|out)/", "", target)
        if files.get_file_from_path(site) is None:  # a file of the code, which is no page: its name stands for it
            return re.sub(r"^!?\[([^\]]*)\].*", r"\1", link[0], flags=re.DOTALL)
        return f"{link[1]}{site}{link[3]}"

    return _LINK.sub(turned, markdown)


def commands() -> str:
    """The page of all commands, which mkdocs-click fills in."""
    options = {"module": "padforge.cli", "command": "cli", "prog_name": "padforge", "depth": 1, "style": "table"}
    return "# Commands\n\n::: mkdocs-click\n" + "".join(f"    :{name}: {value}\n" for name, value in options.items())


def settings() -> str:
    """Write the page of all settings with defaults and units."""
    lines = ["# Settings", "", "Keys of `pad.toml`; every key is optional. `padforge init` writes them all."]
    lines += ["Numbers are in the stated units."]
    for name, model in section_models().items():
        lines += ["", f"## [{name}]", "", "| key | default | meaning |", "|---|---|---|"]
        values = model().model_dump()
        for key, field in model.model_fields.items():
            value = json.dumps(values[key], ensure_ascii=False).replace("|", "\\|")
            lines.append(f"| `{key}` | `{value}` | {(field.description or '').replace('|', chr(92) + '|')} |")
    return "\n".join(lines) + "\n"


def reference(package: str) -> str:
    """Write the page of what a package exports, which mkdocstrings fills in."""
    return f"# padforge.{package}\n\n" + "".join(f"::: {name}\n\n" for name in names(package))


def names(package: str) -> Iterator[str]:
    """Full names of what a package hands out, by the file that says so."""
    for node in ast.parse((ROOT / package / "__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            yield from (f"padforge.{package}.{node.module}.{alias.name}" for alias in node.names)
