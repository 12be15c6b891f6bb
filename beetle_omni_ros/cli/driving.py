"""Subcommand drive: fly by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import DiscoveryOption, RobotOption


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
