"""Subcommands about the real robot: identify joint, identify rotor, check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import DiscoveryOption, JsonOption
from beetle_omni_ros.robot.schema import ParameterError

PublishedOption = Annotated[Optional[Path], typer.Option(
    '--robot', metavar='FILE', help='The robot as believed so far. '
                                    'Default: the shipped params/robot.yaml.')]
PageOption = Annotated[Optional[Path], typer.Option(
    '--report', metavar='FILE', help='Write a self-contained HTML page with plots there.')]
ParamsOption = Annotated[Optional[Path], typer.Option(
    '--params', metavar='FILE', help='Write a robot file with the result there.')]


def joint(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG', help='Response log (CSV) or recorded run (bag), see '
                                  'docs/how-to/identification.md.')],
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
        raise ParameterError(f'{more[0]}: one log is identified from; expected further ones after '
                             '--validate')
    from beetle_omni_ros.identify.command import run_identify_joint
    run_identify_joint(log, validate=[*(validate or []), *more], robot=robot, report=report,
                       params=params, json_path=json_path)


def rotor(log: Annotated[Path, typer.Argument(
              metavar='LOG.csv', help='Bench log, see docs/how-to/identification.md.')],
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Identify thrust map and torque ratio of a rotor from a force-torque log.

    Example: beetle_omni identify rotor bench.csv --params my_robot.yaml --report rotor.html
    """
    from beetle_omni_ros.identify.command import run_identify_rotor
    run_identify_rotor(log, robot=robot, report=report, params=params, json_path=json_path)


def check(servo_port: Annotated[Optional[str], typer.Option(
              '--servo-port', metavar='PORT', help='Default: that of --servo-bus.')] = None,
          board_port: Annotated[Optional[str], typer.Option(
              '--board-port', metavar='PORT', help='Default: that of --motor-board.')] = None,
          servo_bus: Annotated[Optional[Path], typer.Option(
              '--servo-bus', metavar='FILE', help='Default: the shipped '
                                                  'params/servo_bus.yaml.')] = None,
          motor_board: Annotated[Optional[Path], typer.Option(
              '--motor-board', metavar='FILE', help='Default: the shipped '
                                                    'params/motor_board.yaml.')] = None,
          robot: PublishedOption = None,
          seconds: Annotated[float, typer.Option(
              '--seconds', min=1, max=600, help='To listen to the motor board, and to ROS.')]
          = 3.0,
          skip: Annotated[Optional[list[str]], typer.Option(
              '--skip', metavar='servos|board|ros', help='Leave a part out; may be '
                                                         'repeated.')] = None,
          namespace: Annotated[str, typer.Option(
              '--namespace', metavar='NAME', help="Of the robot's topics.")] = '',
          discovery: DiscoveryOption = None,
          json_path: JsonOption = None):
    """
    Look at the real robot before a flight: ports, servos, motor board, MoCap, IMU, clocks.

    Nothing moves and nothing is set. Exit status 0: nothing failed; 1: something did.
    Example: beetle_omni check --servo-port /dev/ttyUSB0 --skip board
    """
    def listen(duration):
        from beetle_omni_ros.nodes.listener import listen as listen_to_ros
        return listen_to_ros(duration, namespace, discovery)

    from beetle_omni_ros.bringup.command import run_check
    raise typer.Exit(run_check(
        listen=listen, servo_port=servo_port, board_port=board_port, servo_bus=servo_bus,
        motor_board=motor_board, robot=robot, seconds=seconds, skip=tuple(skip or ()),
        json_path=json_path))
