"""`padforge sense`: the edge where recordings come in and places go out."""

import click

from padforge.sense.cli.live import live
from padforge.sense.cli.localizer import (
    calibrate,
    deploy,
    evaluate,
    fibre_loss,
    health,
    identify,
    learning_curve,
    locate,
    recalibrate,
)
from padforge.sense.cli.recordings import export, import_
from padforge.sense.cli.rig import doctor, record

COMMANDS = (
    *(import_, export, calibrate, evaluate, identify, locate, health, record, doctor, live),
    *(recalibrate, fibre_loss, learning_curve, deploy),
)


@click.group()
def sense() -> None:
    """Record presses, learn places from them and find new ones.

    \b
    padforge sense record --morphology out/pad/morphology.json
    padforge sense calibrate out/pad/recording
    padforge sense locate --model out/pad out/later/recording --out places.csv
    """


for command in COMMANDS:
    sense.add_command(command)
