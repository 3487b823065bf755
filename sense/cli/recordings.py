"""`padforge sense import` and `export`: recordings from and to other programs."""

from pathlib import Path

import click

from design.common.command_line import out_option, pad_folder

from .options import FILE, read_recording, recording_argument, recording_line, say_note


@click.command("import")
@click.argument("file", type=FILE)
@click.option("--map", "mapping", default="", metavar="QUANTITY=NAME,...", help="What columns or datasets hold.")
@out_option(what="Folder of the recording; must be new or empty")
def import_(file: Path, mapping: str, out: Path | None) -> None:
    """Make a recording of FILE, a .csv, .tsv, .txt, .h5, .hdf5 or .mat: of NAME.csv out/NAME/recording.

    \b
    padforge sense import readings.csv
    padforge sense import lab.csv --map 'time=t_ms:ms,fibres=ch*:mV,x=px,y=py'
    padforge sense import lab.csv --map 'time=Time [s],fibres=ch*,press=contact,x=X:cm,y=Y:cm'
    padforge sense import lab.h5 --map 'time=/t,fibres=/data/volts,places=/xy,begun=/on:s,lifted=/off:s'

    \b
    Without --map a CSV has the columns time_s, one of volts per fibre, x_mm, y_mm; the last two
    hold the place pressed while the probe is down and are empty on all other lines. An .h5 is one
    that export wrote, a .mat one of the published study.

    \b
    With it, columns, datasets or variables are named, with commas between them; * stands for any
    characters, ? for one. A unit or a factor follows a colon; without it they are s, V, mm, N.
      time, fibres    of each reading, needed
      x, y, places    of each reading, or of each press; places are both in one dataset
      depth, reached, force
                      of each reading, or of each press: how deep to go, how deep it was, how hard
      press           1 or a number while the pad is pressed, 0 or empty while not
      begun, lifted   of each press: the reading, from 0, or the time where a unit is said
    Where nothing says when the pad is pressed, presses are found in the readings.
    """
    from design.common.files import provenance
    from sense.recordings.formats.assembly import FOUND
    from sense.recordings.import_export import import_file
    from sense.recordings.recorder import refuse_existing

    folder = out or pad_folder(file) / "recording"
    refuse_existing(folder)
    recording = import_file(file, mapping)
    say_note(recording, file)
    if FOUND.items() <= recording.source.items():
        click.echo(f"{file}: does not say when the pad was pressed; presses were found in the readings", err=True)
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
