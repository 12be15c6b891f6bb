"""Subcommands that meet a running robot or graph: check, drive, view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import DiscoveryOption, JsonOption, PublishedOption, RobotOption
from beetle_omni_ros.robot.schema import ParameterError


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


def drive(source: Annotated[str, typer.Argument(
              metavar='keyboard|joystick|terminal', help='Keys of this terminal; the topic joy; '
                                                         'or lines of words.')] = 'keyboard',
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
    Drive a running graph by hand: targets at limited speed, through the supervisor as any other.

    Example: beetle_omni drive keyboard
    """
    from beetle_omni_ros.nodes.driver import run_drive
    raise typer.Exit(run_drive(source, parameters=parameters, poses=poses, robot=robot,
                               domain_id=domain_id, discovery=discovery))


def view(runs: Annotated[Optional[list[Path]], typer.Argument(
             metavar='RUN...', help='Recorded bags to play over each other; none: a running '
                                    'graph.')] = None,
         at: Annotated[float, typer.Option(
             '--at', metavar='SECONDS', min=0.0, help='Of a RUN: where to begin.')] = 0.0,
         paused: Annotated[bool, typer.Option(
             '--paused', help='Of a RUN: do not play at once.')] = False,
         allow_targets: Annotated[bool, typer.Option(
             '--allow-targets', help='Of a running graph: poses dragged in the page become '
                                     'targets, and controllers can be selected there.')] = False,
         namespace: Annotated[str, typer.Option(
             '--namespace', metavar='NAME', help='Of the topics of a running graph.')] = '',
         domain_id: Annotated[Optional[int], typer.Option(
             '--domain-id', min=0, max=101,
             help='ROS domain of a running graph. Default: ROS_DOMAIN_ID.')] = None,
         discovery: DiscoveryOption = None,
         robot: Annotated[Optional[Path], typer.Option(
             '--robot', metavar='FILE', help='Where rotors sit and forces act. '
                                             'Default: the shipped params/robot.yaml.')] = None,
         urdf: Annotated[Optional[Path], typer.Option(
             '--urdf', metavar='FILE', help='What the robot looks like. '
                                            'Default: the shipped description.')] = None,
         host: Annotated[str, typer.Option(
             '--host', metavar='ADDRESS', help='Where the page is served; 0.0.0.0: to the whole '
                                               'network.')] = '127.0.0.1',
         port: Annotated[int, typer.Option(
             '--port', min=1, max=65535, help='Of the page; the next free one is taken.')] = 8080,
         dark: Annotated[bool, typer.Option('--dark', help='Begin with dark colours.')] = False):
    """
    Show a running graph, or play recorded runs, in 3D in the browser.

    Prints the address of the page, which needs no network, and serves it until Ctrl-C.
    Example: beetle_omni view my_run/rl my_run/nmpc
    """
    shared = {'robot': robot, 'urdf': urdf, 'host': host, 'port': port, 'dark': dark}
    if runs:
        for option, given in (('--allow-targets', allow_targets), ('--namespace', namespace),
                              ('--domain-id', domain_id is not None),
                              ('--discovery', discovery)):
            if given:
                raise ParameterError(f'{option}: expected without RUN, which is a recording')
        from beetle_omni_ros.view.command import run_view
        run_view(runs, start=at, play=not paused, **shared)
        return
    if at or paused:
        raise ParameterError(f"{'--at' if at else '--paused'}: expected with RUN")
    from beetle_omni_ros.nodes.live_view import run_live
    run_live(namespace=namespace, domain_id=domain_id, discovery=discovery,
             allow_targets=allow_targets, **shared)
