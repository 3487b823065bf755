"""`padforge sense import` and `export`: recordings from and to other programs."""

from pathlib import Path

import click

from design.common.command_line import out_option, pad_folder

from .options import FILE, read_recording, recording_argument, recording_line


@click.command("import")
@click.argument("file", type=FILE)
@out_option(what="Folder of the recording; must be new or empty")
def import_(file: Path, out: Path | None) -> None:
    """Make a recording of FILE, a published .mat, a .csv or a .h5 that export wrote: of NAME.csv out/NAME/recording.

    \b
    padforge sense import readings.csv --out out/lab/recording

    \b
    The CSV has the columns time_s, one of volts per fibre, x_mm, y_mm; the last two hold
    the place pressed while the probe is down and are empty on all other lines.
    """
    from design.common.files import provenance
    from sense.recordings.import_export import import_file
    from sense.recordings.recorder import refuse_existing

    folder = out or pad_folder(file) / "recording"
    refuse_existing(folder)
    recording = import_file(file)
    recording.save(folder, provenance("padforge sense import", inputs=[file]))
    click.echo(recording_line(recording, folder))


@click.command()
@recording_argument
@click.argument("file", type=FILE)
def export(recording: Path, file: Path) -> None:
    """Write RECORDING to FILE, as HDF5 (.h5) or CSV (.csv), for other programs.

    \b
    padforge sense export out/pad/recording recording.h5
    """
    from sense.recordings.import_export import export_file

    export_file(read_recording(recording), file)
    click.echo(f"{recording} -> {file}")
