"""`padforge sense`: the group of its commands, and the commands `import` and `export`."""

from pathlib import Path

import click

from padforge.common.command_line import SectionedGroup, echo, out_option, pad_folder
from padforge.sense.cli import localizer, rig
from padforge.sense.cli.live import live
from padforge.sense.cli.options import (
    FILE,
    FOLDER,
    echo_note,
    predict_despite_faults,
    read_recording,
    recording_argument,
    recording_line,
)

_PATH = click.Path(path_type=Path)


@click.command("import")
@click.argument("file", type=_PATH)
@click.option("--show", is_flag=True, help="Print what FILE holds, to write --columns by, and import nothing.")
@click.option("--columns", default="", metavar="QUANTITY=NAME,...", help="Content of columns, datasets or topics.")
@click.option("--presses", type=FILE, help="Table of presses, a line each, beside readings without any.")
@click.option("--press-columns", default="", metavar="QUANTITY=NAME,...", help="Content of the columns of --presses.")
@click.option("--encoding", default="", help="Of a table's text, such as cp1252 (default: by its first bytes).")
@out_option(what="Folder of the recording; must be new or empty")
def import_(
    file: Path, show: bool, columns: str, presses: Path | None, press_columns: str, encoding: str, out: Path | None
) -> None:
    """Import a recording of another program from FILE. FILE is a table (.csv, .tsv, .txt, .log, .dat), an .h5,
    .hdf5, .mat, or a bag of ROS (.mcap, .db3, .bag or a folder with metadata.yaml). The default folder for NAME.csv
    is out/NAME/recording.

    \b
    padforge sense import --show lab.csv
    padforge sense import readings.csv
    padforge sense import lab.csv --columns 'time=t_ms:ms,fibres=ch*:mV,x=px,y=py'
    padforge sense import lab.csv --columns 'time=Time [s],fibres=ch*,press=contact,x=X:cm,y=Y:cm'
    padforge sense import plain.txt --columns 'rate=100,fibres=2-5'
    padforge sense import lab.h5 --columns 'time=/t,fibres=/volts,positions=/xy,down_command=/on:s,up_command=/off:s'
    padforge sense import lab.h5 --columns 'time=/log/t,fibres=/log/c*,press=/log/contact'
    padforge sense import lab.mat --columns 'time=data.t,fibres=data.volts[0:8]'
    padforge sense import lab.mcap --columns 'fibres=/skin/readings,positions=/probe,force=/wrench'
    padforge sense import lab.mcap --columns 'fibres=/synced.measurements.data'
    padforge sense import lab.csv --columns 'time=t,fibres=ch*' --presses presses.csv

    \b
    Without --columns a CSV has the columns time_s, fibre_0_v, fibre_1_v, ..., x_mm, y_mm, and optionally
    depth_mm, reached_mm, force_n; positions are filled while the probe is down and empty elsewhere. An .h5
    or a bag must be one that export wrote, a .mat one of the published study.

    \b
    --columns lists columns, datasets, variables or topics, separated by commas; * stands for any
    characters, ? for one, NAME[1:5] for columns 1 to 4 of an array, from 0, and 2-5 for columns of a table
    without header, from 1. A unit or a factor follows a colon; without it they are s, V, mm, N. Fields of
    a structure follow a point in MATLAB, columns of a table a slash in HDF5, fields of messages a point.
      time, fibres    of each reading, needed; rate=HZ in place of time
      x, y, positions of each reading, or of each press; positions are both in one dataset
      depth, reached, force
                      of each reading, or of each press: depth commanded and measured, and force
      press           1 or a number while the pad is pressed, 0 or empty while not
      down_command, up_command
                      of each press: the reading, from 0, or the time where a unit is given
    Where nothing says when the pad is pressed, presses are detected in the readings. Fibres whose names
    differ by a number are in the order of that number.

    \b
    --presses has the columns down_s and up_s or duration_s, by the clock of the readings, and optionally
    x_mm, y_mm, depth_mm, reached_mm, force_n; or --press-columns names them:
      down, up or duration, x, y, depth, reached, force

    \b
    In a bag, time is when messages were logged, and lengths are m where no unit is given:
      fibres          std_msgs Float64MultiArray or another one of numbers, or topics of one number
      positions       geometry_msgs Point, Pose, PoseWithCovariance, with or without Stamped
      force           geometry_msgs Wrench, with or without Stamped, or a number
      press           std_msgs Bool
      x, y, depth, reached
                      std_msgs Float64 or another number
    A value holds until the next message.
    """
    from padforge.common.files import provenance
    from padforge.common.validation import join_names
    from padforge.sense.formats.import_export import describe_file, find_reader, import_file
    from padforge.sense.recording.doubts import find_doubts
    from padforge.sense.recording.recording import PRESSES_DETECTED
    from padforge.sense.recording.run_directory import check_new_folder

    if show:
        for line in describe_file(file, encoding):
            echo(line)
        return
    find_reader(file)  # checks the kind of file before the folder
    folder = out or pad_folder(file) / "recording"
    check_new_folder(folder)
    recording = import_file(file, columns, encoding, presses, press_columns)
    echo_note(recording, file)
    if PRESSES_DETECTED.items() <= recording.source.items():
        echo(f"{file}: does not say when the pad was pressed; presses were detected in the readings", err=True)
    for doubt in find_doubts(recording):
        echo(f"doubtful: {doubt}", err=True)
    recording.save(folder, provenance("padforge sense import", inputs=[file, *([presses] if presses else [])]))
    if recording.fibre_names:
        echo(f"fibres from 1 on: {join_names(recording.fibre_names)}")
    echo(recording_line(recording, folder))


@click.command()
@recording_argument
@click.argument("file", type=_PATH)
@click.option("--format", "kind", type=click.Choice(["lerobot"]), help="Write a folder FILE: a LeRobot dataset v3.0.")
@click.option("--model", type=FOLDER, help="Folder that calibrate wrote: adds predicted positions and health.")
def export(recording: Path, file: Path, kind: str | None, model: Path | None) -> None:
    """Export RECORDING to FILE for other programs. FILE is CSV (.csv), HDF5 (.h5) or ROS 2 (.mcap), by its
    extension, or a LeRobot dataset.

    \b
    padforge sense export out/pad/recording recording.h5
    padforge sense export out/pad/recording recording.mcap --model out/pad
    padforge sense export out/pad/recording dataset --format lerobot

    \b
    An .mcap has these topics, in V, m and N, with the stamps of the readings; the origin of the frame pad
    is the centre of the pad, and z points out of its surface (into it if the tracks were up):
      /pad/readings   Float64MultiArray, a value per fibre
      /pad/pressed    Bool, at the start and end of a press
      /pad/place      PoseWithCovarianceStamped, commanded position; z is minus the depth
      /pad/reached, /pad/force
                      PointStamped, measured depth, and WrenchStamped, if they are known
      /pad/recording  String, latched: JSON of values that messages round, for an exact import
      /pad/touches, /pad/health
                      with --model: PoseWithCovarianceStamped at the end of a press, and DiagnosticArray
      /arm/pose       PoseStamped, of a recording made by an arm
    An .mcap or a LeRobot dataset needs the extra formats (pip install '.[formats]').
    """
    from padforge.sense.formats.import_export import arm_states, export_file

    opened = read_recording(recording)
    localization, faults, dead = None, None, ()
    if model:
        prediction = predict_despite_faults(model, opened)
        localization = prediction.localization
        if prediction.detector:  # otherwise nothing is known of the fibres
            faults, dead = prediction.faults, prediction.detector.model_.dead
    export_file(opened, file, kind or "", localization, faults, dead, arm_states(recording))
    echo(f"{recording} -> {file}")


@click.group(cls=SectionedGroup)
def sense() -> None:
    """Record presses, train a localizer on them, localize new ones.

    \b
    padforge sense record --morphology out/pad/morphology.json
    padforge sense calibrate out/pad/recording
    padforge sense locate --model out/pad out/later/recording --out places.csv
    """


for _heading, _commands in {
    "Record": (rig.doctor, rig.record, import_, export),
    "Calibrate": (localizer.calibrate, localizer.evaluate, localizer.recalibrate, localizer.identify),
    "Use": (live, localizer.locate, localizer.health, localizer.deploy),
    "Study": (localizer.fibre_loss, localizer.learning_curve),
}.items():
    for _command in _commands:
        sense.add_command(_command, heading=_heading)
