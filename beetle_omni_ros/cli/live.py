"""Subcommands for a running robot or graph: check, drive, view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import DiscoveryOption, JsonOption, PublishedOption, RobotOption
from beetle_omni_ros.robot.schema import ParameterError


def check(servo_port: Annotated[Optional[str], typer.Option(
              '--servo-port', metavar='PORT', help='Serial port of the servos. Default: the port '
                                                   'in --servo-bus.')] = None,
          board_port: Annotated[Optional[str], typer.Option(
              '--board-port', metavar='PORT', help='Serial port of the motor board. Default: the '
                                                   'port in --motor-board.')] = None,
          servo_bus: Annotated[Optional[Path], typer.Option(
              '--servo-bus', metavar='FILE', help='Settings of the servo bus. Default: the '
                                                  'shipped params/servo_bus.yaml.')] = None,
          motor_board: Annotated[Optional[Path], typer.Option(
              '--motor-board', metavar='FILE', help='Settings of the motor board. Default: the '
                                                    'shipped params/motor_board.yaml.')] = None,
          robot: PublishedOption = None,
          seconds: Annotated[float, typer.Option(
              '--seconds', min=1, max=600, help='Time to receive from the motor board, and from '
                                                'ROS.')]
          = 3.0,
          skip: Annotated[Optional[list[str]], typer.Option(
              '--skip', metavar='servos|board|ros', help='Skip a part; may be '
                                                         'repeated.')] = None,
          namespace: Annotated[str, typer.Option(
              '--namespace', metavar='NAME', help="Namespace of the robot's topics.")] = '',
          discovery: DiscoveryOption = None,
          json_path: JsonOption = None):
    """
    Check the real robot before a flight: ports, servos, motor board, MoCap, IMU, clocks.

    It moves nothing and changes no setting. Exit status 0: nothing failed; 1: something failed.
    Example: beetle_omni check --servo-port /dev/ttyUSB0 --skip board
    """
    def listen(duration):
        from beetle_omni_ros.nodes.operator import listen as listen_to_ros
        return listen_to_ros(duration, namespace, discovery)

    from beetle_omni_ros.bringup.command import run_check
    raise typer.Exit(run_check(
        listen=listen, servo_port=servo_port, board_port=board_port, servo_bus=servo_bus,
        motor_board=motor_board, robot=robot, seconds=seconds, skip=tuple(skip or ()),
        json_path=json_path))


def drive(source: Annotated[str, typer.Argument(
              metavar='keyboard|joystick|terminal', help='Input: keys of this terminal, the topic '
                                                         'joy, or typed commands.')] = 'keyboard',
          parameters: Annotated[Optional[Path], typer.Option(
              '--params', metavar='FILE', help='Limits, axes, buttons and named poses. Default: '
                                               'the shipped params/drive.yaml.')] = None,
          poses: Annotated[Optional[Path], typer.Option(
              '--poses', metavar='FILE', help='More named poses (YAML).')] = None,
          robot: RobotOption = None,
          domain_id: Annotated[Optional[int], typer.Option(
              '--domain-id', min=0, max=232, help='ROS domain. Default: ROS_DOMAIN_ID, or '
                                                  '0.')] = None,
          discovery: DiscoveryOption = None):
    """
    Drive a running graph by hand: the target moves at limited speed, within all supervisor checks.

    Example: beetle_omni drive keyboard
    """
    from beetle_omni_ros.nodes.driver import run_drive
    raise typer.Exit(run_drive(source, parameters=parameters, poses=poses, robot=robot,
                               domain_id=domain_id, discovery=discovery))


def view(runs: Annotated[Optional[list[Path]], typer.Argument(
             metavar='RUN...', help='Recorded bags, shown together; without RUN: a running '
                                    'graph.')] = None,
         allow_targets: Annotated[bool, typer.Option(
             '--allow-targets', help='For a running graph: poses dragged in the page become '
                                     'targets, and controllers can be selected there.')] = False,
         namespace: Annotated[str, typer.Option(
             '--namespace', metavar='NAME', help='Namespace of the topics of a running '
                                                 'graph.')] = '',
         domain_id: Annotated[Optional[int], typer.Option(
             '--domain-id', min=0, max=101,
             help='ROS domain of a running graph. Default: ROS_DOMAIN_ID.')] = None,
         discovery: DiscoveryOption = None,
         robot: Annotated[Optional[Path], typer.Option(
             '--robot', metavar='FILE', help='For a running graph: robot file, for the '
                                             'checks of targets.')] = None,
         host: Annotated[str, typer.Option(
             '--host', metavar='ADDRESS', help='Address at which the page is served; 0.0.0.0: to '
                                               'the whole network.')] = '127.0.0.1',
         port: Annotated[int, typer.Option(
             '--port', min=1, max=65535, help='Port of the page.')] = 8080,
         dark: Annotated[bool, typer.Option('--dark', help='Begin with dark colours.')] = False):
    """
    Show a running graph, or play recorded runs, in 3D in the browser.

    Prints the address of the page, which needs no network, and runs until Ctrl-C. Example:
    beetle_omni view my_run/rl my_run/nmpc
    """
    shared = {'host': host, 'port': port, 'dark': dark}
    if runs:
        for option, given in (('--allow-targets', allow_targets), ('--namespace', namespace),
                              ('--domain-id', domain_id is not None),
                              ('--discovery', discovery), ('--robot', robot)):
            if given:
                raise ParameterError(f'{option}: expected without RUN, which is a recording')
        from beetle_omni_ros.view.recorded import run_view
        run_view(runs, **shared)
        return
    from beetle_omni_ros.nodes.operator import run_live
    run_live(namespace=namespace, domain_id=domain_id, discovery=discovery, robot=robot,
             allow_targets=allow_targets, **shared)
