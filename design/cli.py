"""`padforge design`: the edge where files come in and results go out."""

import click


@click.group()
def design() -> None:
    """Optimise the course of the fibres."""
