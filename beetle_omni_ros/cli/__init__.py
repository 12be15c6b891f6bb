"""
The `beetle_omni` command.

A subcommand imports its modules when it runs, so that `--help` is fast and an analysis needs no
ROS. Unusable input gives status 2 and one line on standard error.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer
from typer.main import get_command

from beetle_omni_ros import __version__
from beetle_omni_ros.cli import commands, live
from beetle_omni_ros.cli.options import (
    fail,
    FAILED,
    INTERRUPTED,
    refuse_empty,
    UNUSABLE,
    usage_text,
)
from beetle_omni_ros.robot.resources import PACKAGE
from beetle_omni_ros.robot.schema import ParameterError, RunError

# Modules of ROS (also of the extra 'ros') and of the other extras of the package.
ROS_MODULES, ROS_ENDINGS = ('rclpy', 'ament_index_python'), ('_msgs', '_srvs', '_interfaces')
HARDWARE_MODULES = ('dynamixel_sdk', 'pymavlink', 'serial')
TRAIN_MODULES = ('onnx', 'onnxscript', 'rsl_rl', 'tensorboard', 'tensordict', 'torch')
HELP = {'help_option_names': ['-h', '--help']}

app = typer.Typer(no_args_is_help=True, context_settings=HELP,
                  help='Fly, evaluate and report on the tiltable quadrotor.')
for command in (commands.fly, commands.evaluate, commands.compare, commands.faults,
                commands.report, live.view, commands.gap, commands.train,
                live.check, live.drive, commands.controllers):
    app.command()(command)
identify = typer.Typer(no_args_is_help=True, context_settings=HELP,
                       help='Fit the actuator models from measured data.')
for command in (commands.joint, commands.rotor, commands.robot):
    identify.command()(command)
app.add_typer(identify, name='identify')


def _version(wanted: bool):
    if wanted:
        typer.echo(f'beetle_omni {__version__}')
        raise typer.Exit()


@app.callback()
def _common(version: Annotated[bool, typer.Option(
        '--version', callback=_version, is_eager=True, help='Show the version.')] = False):
    pass


def main(args: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    args = list(sys.argv[1:] if args is None else args)
    if args[:1] == ['gap']:
        args = ['gap', *commands.spread(args[1:])]
    try:
        refuse_empty(args)
        status = get_command(app).main(args=args, prog_name='beetle_omni', standalone_mode=False)
        return status if isinstance(status, int) else 0
    except ModuleNotFoundError as error:
        top = (error.name or '').partition('.')[0]
        if top == PACKAGE:
            raise
        cure = 'pip install beetle_omni_ros'
        if top in ROS_MODULES or top.endswith(ROS_ENDINGS):
            cure = "source a ROS 2 Jazzy environment or pip install 'beetle_omni_ros[ros]'"
        elif top in HARDWARE_MODULES:
            cure = "pip install 'beetle_omni_ros[hardware]'"
        elif top in TRAIN_MODULES:
            cure = "run make setup-train in a checkout, or pip install 'beetle_omni_ros[train]'"
        return fail(f"the module '{top}' is not installed; {cure}", UNUSABLE)
    except ParameterError as error:
        return fail(error, UNUSABLE)
    except RunError as error:
        return fail(error, FAILED)
    except (KeyboardInterrupt, typer.Abort):
        return fail('interrupted', INTERRUPTED)
    except Exception as error:
        # usage errors of typer's parser and bag errors; importing their types would slow --help
        if hasattr(error, 'format_message'):
            text = usage_text(error, args)  # empty after the help of `beetle_omni` alone
            return fail(text, UNUSABLE) if text else UNUSABLE
        if type(error).__name__ == 'BagError':
            return fail(error, UNUSABLE)
        raise


def run() -> None:
    """Entry point of the console script."""
    sys.exit(main())
