"""Texts that packages ship beside their code."""

from importlib import resources


def resource(package: str, name: str) -> str:
    """The text of a file that a package ships."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")
