"""Subcommands of `beetle_omni identify`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from beetle_omni_ros.options import (
    Commands,
    JsonOption,
    PageOption,
    ParamsOption,
    RateOption,
    TheRobotOption,
    writable,
)

identify = Commands(help='Fit the actuator models from measured data.')


def _run(what, **options):
    from beetle_omni_ros.identify.command import run_identify
    return run_identify(what, **options)


@identify.command()
def joint(paths: Annotated[list[Path], Argument(metavar='LOG...', help=(
              'Response logs (CSV) or recorded run (bag), see docs/how-to/identification.md.'))],
          validate: Annotated[list[Path], Option(metavar='LOG.csv...', help=(
              'Further logs for validation.'))] = (),
          robot: TheRobotOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Fit one servo model to response logs; the last 40 % validate it.

    Several logs of the same servos are fitted together.

    Example: beetle_omni identify joint slow.csv --validate fast.csv --report servos.html
    """
    _run('joint', **locals())


@identify.command()
def rotor(paths: Annotated[list[Path], Argument(metavar='LOG.csv...', help=(
              'Logs of a force-torque stand, see docs/how-to/identification.md.'))],
          columns: Annotated[list[str], Option('--column', metavar='QUANTITY=[-]COLUMN[*FACTOR]',
                                               help=(
              'Column of a quantity with sign and factor to SI units, e.g. thrust=-fz or '
              'thrust=load_g*0.00981; may be repeated.'))] = (),
          rate: RateOption = None,
          robot: TheRobotOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Fit thrust, torque and lag of a rotor to logs of a stand.

    Ends with status 3 for the verdict bad_data.

    Example: beetle_omni identify rotor bench.csv --params my_robot.yaml --report rotor.html
    """
    return 3 if _run('rotor', **locals())['verdict'] == 'bad_data' else 0


@identify.command()
def robot(paths: Annotated[list[Path], Argument(metavar='LOG...', help=(
              'Response logs of the joints (CSV or bag) and logs of a force-torque stand, '
              'recognised by their header.'))],
          params: Annotated[Path, Option(
              callback=writable, metavar='FILE', help='The robot file to write.')],
          rate: RateOption = None, robot: TheRobotOption = None, report: PageOption = None,
          json_path: JsonOption = None):
    """
    Write a robot file with intervals from logs of servos and rotors.

    Example: beetle_omni identify robot slow.csv fast.csv bench.csv --params my_robot.yaml
    """
    _run('robot', **locals())
