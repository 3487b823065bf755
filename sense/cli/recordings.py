"""`padforge sense import` and `export`: recordings from and to other programs."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from padforge.design.common.command_line import out_option, pad_folder
from padforge.sense.cli.options import FOLDER, echo_note, read_recording, recording_argument, recording_line

if TYPE_CHECKING:
    from padforge.sense.formats.annotations import ModelFindings
    from padforge.sense.recording.recording import Recording


_PATH = click.Path(path_type=Path)


@click.command("import")
@click.argument("file", type=_PATH)
@click.option("--columns", "mapping", default="", metavar="QUANTITY=NAME,...", help="What columns or topics hold.")
@out_option(what="Folder of the recording; must be new or empty")
def import_(file: Path, mapping: str, out: Path | None) -> None:
    """Make a recording of FILE, a .csv, .tsv, .txt, .h5, .hdf5, .mat, or a bag of ROS 2: an .mcap, a .db3
    or a folder with metadata.yaml. Of NAME.csv it makes out/NAME/recording.

    \b
    padforge sense import readings.csv
    padforge sense import lab.csv --columns 'time=t_ms:ms,fibres=ch*:mV,x=px,y=py'
    padforge sense import lab.csv --columns 'time=Time [s],fibres=ch*,press=contact,x=X:cm,y=Y:cm'
    padforge sense import lab.h5 --columns 'time=/t,fibres=/data/volts,places=/xy,begun=/on:s,lifted=/off:s'
    padforge sense import lab.mcap --columns 'fibres=/skin/readings,places=/probe,force=/wrench'

    \b
    Without --columns a CSV has the columns time_s, one of volts per fibre, x_mm, y_mm; the last two
    hold the place pressed while the probe is down and are empty on all other lines. An .h5 or a bag
    is one that export wrote, a .mat one of the published study.

    \b
    With it, columns, datasets, variables or topics are named, with commas between them; * stands for
    any characters, ? for one. A unit or a factor follows a colon; without it they are s, V, mm, N.
      time, fibres    of each reading, needed
      x, y, places    of each reading, or of each press; places are both in one dataset
      depth, reached, force
                      of each reading, or of each press: how deep to go, how deep it was, how hard
      press           1 or a number while the pad is pressed, 0 or empty while not
      begun, lifted   of each press: the reading, from 0, or the time where a unit is said
    Where nothing says when the pad is pressed, presses are found in the readings.

    \b
    Of a bag, time is when messages were logged, and lengths are m where no unit is said:
      fibres          std_msgs Float64MultiArray or another one of numbers, or topics of one number
      places          geometry_msgs Point, Pose, PoseWithCovariance, with or without Stamped
      force           geometry_msgs Wrench, with or without Stamped, or a number
      press           std_msgs Bool
      x, y, depth, reached
                      std_msgs Float64 or another number
    A reading goes with what was said last before it.
    """
    from padforge.design.common.files import provenance
    from padforge.sense.formats.columns import FOUND
    from padforge.sense.formats.import_export import import_file
    from padforge.sense.recording.run_directory import refuse_existing

    folder = out or pad_folder(file) / "recording"
    refuse_existing(folder)
    recording = import_file(file, mapping)
    echo_note(recording, file)
    if FOUND.items() <= recording.source.items():
        click.echo(f"{file}: does not say when the pad was pressed; presses were found in the readings", err=True)
    recording.save(folder, provenance("padforge sense import", inputs=[file]))
    click.echo(recording_line(recording, folder))


@click.command()
@recording_argument
@click.argument("file", type=_PATH)
@click.option("--format", "kind", type=click.Choice(["lerobot"]), help="Write a folder FILE: a LeRobot dataset v3.0.")
@click.option("--model", type=FOLDER, help="Folder that calibrate wrote: add the places it finds, and health.")
def export(recording: Path, file: Path, kind: str | None, model: Path | None) -> None:
    """Write RECORDING to FILE for other programs: CSV (.csv), HDF5 (.h5) or ROS 2 (.mcap), by the end of
    its name, or a LeRobot dataset.

    \b
    padforge sense export out/pad/recording recording.h5
    padforge sense export out/pad/recording recording.mcap --model out/pad
    padforge sense export out/pad/recording dataset --format lerobot

    \b
    An .mcap has these topics, in V, m and N, with the stamps of the readings; the frame pad has its
    origin in the middle of the pad, and z points away from it (into one that lay mirrored):
      /pad/readings   Float64MultiArray, a value for each fibre
      /pad/pressed    Bool, as a press begins and ends
      /pad/place      PoseWithCovarianceStamped, where a press was commanded; z is minus its depth
      /pad/reached, /pad/force
                      PointStamped, how deep the arm was, and WrenchStamped, where they are known
      /pad/recording  String, latched: JSON of what messages round off, so that import has it again
      /pad/touches, /pad/health
                      of --model: PoseWithCovarianceStamped as a press ends, and DiagnosticArray
      /arm/pose       PoseStamped, of a recording made by an arm
    It needs rosbags (pip install 'padforge[ros]'), LeRobot needs pyarrow (padforge[lerobot]).
    """
    from padforge.sense.formats.import_export import arm_states, export_file

    opened = read_recording(recording)
    findings = _findings(model, opened) if model else None
    export_file(opened, file, kind or "", findings, arm_states(recording))
    click.echo(f"{recording} -> {file}")


def _findings(model: Path, recording: "Recording") -> "ModelFindings":
    """What a model says of a recording; a fibre at fault is left out from the press on since which it is."""
    import numpy as np

    from padforge.sense.formats.annotations import FaultFound, ModelFindings
    from padforge.sense.health.fault_detector import examined, fibre_mask_of, has_health
    from padforge.sense.localizer.model import LocalizerModel

    known, faults = examined(model, recording) if has_health(model) else (None, [])
    localizer = LocalizerModel.load(model)
    found = localizer.predict(
        recording, fibre_mask=fibre_mask_of(faults, len(recording.down_command), localizer.fibres)
    )
    depth = found.measures.get("depth_mm")
    unknown = np.full(len(found.r90_mm), np.nan)
    return ModelFindings(
        found.positions_mm,
        found.std_mm,
        found.r90_mm,
        unknown if depth is None else depth.values,
        unknown if depth is None else depth.r90,
        faults=known and [FaultFound(fault.press, fault.fibres, fault.kind, fault.text) for fault in faults],
        dead=known.dead if known else (),
    )
