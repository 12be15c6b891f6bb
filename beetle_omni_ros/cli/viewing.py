"""The subcommand that shows flights in the browser: view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import DiscoveryOption
from beetle_omni_ros.robot.schema import ParameterError


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
