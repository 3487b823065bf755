"""`padforge sense`: the command line from recordings to positions."""

import click

from padforge.sense.cli import localizer, recordings, rig
from padforge.sense.cli.live import live

COMMANDS = (
    *(recordings.import_, recordings.export, localizer.calibrate, localizer.evaluate, localizer.identify),
    *(localizer.locate, localizer.health, rig.record, rig.doctor, live, localizer.recalibrate),
    *(localizer.fibre_loss, localizer.learning_curve, localizer.deploy),
)


@click.group()
def sense() -> None:
    """Record presses, train a localizer on them and localize new ones.

    \b
    padforge sense record --morphology out/pad/morphology.json
    padforge sense calibrate out/pad/recording
    padforge sense locate --model out/pad out/later/recording --out places.csv
    """


for command in COMMANDS:
    sense.add_command(command)
