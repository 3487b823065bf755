"""padforge: the front door. One command; `run` chains design, fabricate and sense."""

import sys

import click

from design.cli import design
from design.errors import InputError


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="padforge")
def cli() -> None:
    """From an idea to a calibrated soft strain-sensor pad: fibres, mould, calibration."""


cli.add_command(design)


def main() -> None:
    """Run the command line; a user's own mistake is one line on stderr and exit 2."""
    try:
        code = cli.main(standalone_mode=False)
    except click.exceptions.Abort:
        code = _fail("interrupted; what was finished is kept", 130)
    except KeyboardInterrupt:
        code = _fail("interrupted; what was finished is kept", 130)
    except click.ClickException as error:
        code = _fail(error.format_message(), 2)
    except (InputError, OSError) as error:
        code = _fail(str(error), 2)
    sys.exit(code)


def _fail(message: str, code: int) -> int:
    print(f"padforge: {' '.join(message.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
