import json
import tomllib
from contextlib import nullcontext
from pathlib import Path
from pkgutil import resolve_name

import jsonschema
import pytest

from padforge import InputError, Spec
from padforge.cli import PRESETS
from padforge.settings import SECTIONS, check_settings, section_models
from tests.docs.pages import BLOCK, PAGES, relative
from tests.helpers.door import called
from tests.helpers.golden import Golden, json_text

MODELS = section_models()


@pytest.fixture(scope="module")
def validator(tmp_path_factory: pytest.TempPathFactory) -> jsonschema.Draft7Validator:
    ended = called("schema", cwd=tmp_path_factory.mktemp("schema"))
    assert (ended.code, ended.err) == (0, "")
    return jsonschema.Draft7Validator(json.loads(ended.out))


def test_schema_is_valid(validator: jsonschema.Draft7Validator, golden: Golden) -> None:
    validator.check_schema(validator.schema)
    assert "null" not in json.dumps(validator.schema)  # which TOML does not have
    golden("padforge/schema.json", json_text(validator.schema))


def test_written_settings(validator: jsonschema.Draft7Validator, tmp_path: Path, golden: Golden) -> None:
    """They validate and agree, and let the rig follow the contact; of presets those lines are kept that differ."""
    lines, defaults = [], ""
    for preset in ("", *PRESETS):
        ended = called("init", f"{preset or 'pad'}.toml", *(["--preset", preset] if preset else []), cwd=tmp_path)
        assert (ended.code, ended.out) == (0, f"settings -> {preset or 'pad'}.toml\n")
        text = (tmp_path / f"{preset or 'pad'}.toml").read_text(encoding="utf-8")
        validator.validate(tomllib.loads(text))
        (tmp_path / f"{preset or 'pad'}.toml").write_text(text, encoding="utf-8-sig")  # as editors on Windows do
        check_settings(spec := Spec.load(tmp_path / f"{preset or 'pad'}.toml"))
        stated = resolve_name(PRESETS[preset]) if preset else {}
        for name, model in MODELS.items():
            assert spec.section(model) == stated.get(name, model())
        assert '\ndepth_mm = "contact" ' in text
        defaults = defaults or text
        section, known = "", set(defaults.splitlines())
        lines += [f"preset {preset}"] if preset else []
        for line in text.splitlines():
            section = line if line.startswith("[") else section
            lines += [f"  {section} {line}"] if line not in known else []
    golden("padforge/pad.toml", defaults)
    golden("padforge/presets.txt", "\n".join(lines))


def test_documented_settings_validate(validator: jsonschema.Draft7Validator) -> None:
    blocks = [(relative(page), block) for page in PAGES for block in BLOCK.finditer(page.read_text(encoding="utf-8"))]
    tables = [(page, tomllib.loads(block["body"])) for page, block in blocks if block["language"] == "toml"]
    settings = [(page, table) for page, table in tables if table.keys() & SECTIONS.keys()]
    pages = {page for page, _ in settings}
    assert pages >= {"docs/tutorial-design.md", "docs/tutorial-sense.md", "docs/howto-boards.md"}
    for page, table in settings:
        assert not list(validator.iter_errors(table)), page
        Spec(table, page, SECTIONS)


VALID = """\
pad pitch_mm 8
pad pitch_mm [5, 8]
pad horizontals "grid"
contact sensitivity_profile [[0, 1], [5, 0.5], [9, 0]]
search max_failures [0, 1]
rig max_force_n "unwatched"
"""
INVALID = """\
pad pitch_mm "5 mm"
pad pitch_mm [8, 8, 8]
pad bent_radius_mm "round"
pad gird 4
search contacts [{"depth_mm": "2 mm"}]
rig channels [0, 600]
dispenser origin_mm [0, 0, 0]
localizer method "forest"
"""


def test_schema_judges_keys_as_the_settings_do(validator: jsonschema.Draft7Validator) -> None:
    for line in [*VALID.splitlines(), *INVALID.splitlines(), f"contact sensitivity_profile {[[0, 1]] * 65}"]:
        section, key, value = line.split(maxsplit=2)
        tables, is_valid = {section: {key: json.loads(value)}}, line in VALID
        assert validator.is_valid(tables) == is_valid, line
        with nullcontext() if is_valid else pytest.raises(InputError):
            Spec(tables).section(MODELS[section])
