"""Subcommands about the actuators: identify joint, identify rotor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import JsonOption
from beetle_omni_ros.robot.schema import ParameterError

PublishedOption = Annotated[Optional[Path], typer.Option(
    '--robot', metavar='FILE', help='The robot as believed so far. '
                                    'Default: the shipped params/robot.yaml.')]
PageOption = Annotated[Optional[Path], typer.Option(
    '--report', metavar='FILE', help='Write a self-contained HTML page with plots there.')]
ParamsOption = Annotated[Optional[Path], typer.Option(
    '--params', metavar='FILE', help='Write a robot file with the result there.')]


def joint(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG.csv', help='Response log, see docs/identification.md.')],
          validate: Annotated[Optional[list[Path]], typer.Option(
              '--validate', metavar='LOG.csv...', help='Further logs, which only judge.')] = None,
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Identify the tilt servos from the first 60 % of a response log; the rest judges.

    Example: beetle_omni identify joint slow.csv --validate fast.csv --report servos.html
    """
    log, *more = logs      # `--validate a.csv b.csv` leaves b.csv here
    if more and not validate:
        raise ParameterError(f'{more[0]}: one log is identified from; further ones follow '
                             '--validate')
    from beetle_omni_ros.identify.command import run_identify_joint
    run_identify_joint(log, validate=[*(validate or []), *more], robot=robot, report=report,
                       params=params, json_path=json_path)


def rotor(log: Annotated[Path, typer.Argument(
              metavar='LOG.csv', help='Bench log, see docs/identification.md.')],
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Identify thrust map and torque ratio of a rotor from a force-torque log.

    Example: beetle_omni identify rotor bench.csv --params my_robot.yaml --report rotor.html
    """
    from beetle_omni_ros.identify.command import run_identify_rotor
    run_identify_rotor(log, robot=robot, report=report, params=params, json_path=json_path)
