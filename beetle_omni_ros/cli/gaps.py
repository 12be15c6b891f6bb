"""Subcommand gap: where model and measurement disagree."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import JsonOption, RobotOption

HOLDOUT = '--holdout'


def gap(runs: Annotated[list[Path], typer.Argument(
            metavar='RUN...', help='Recorded flights (bags), or one joint log (CSV).')],
        holdout: Annotated[Optional[list[Path]], typer.Option(
            HOLDOUT, metavar='RUN...', help='Flights that only judge. Default: the last run, '
                                            'where there are three or more.')] = None,
        robot: RobotOption = None,
        apply: Annotated[Optional[Path], typer.Option(
            '--apply', metavar='FILE', help='Write the robot file with what was named.')] = None,
        page: Annotated[Optional[Path], typer.Option(
            '--report', metavar='FILE', help='Write an HTML page with the plots.')] = None,
        parameters: Annotated[Optional[Path], typer.Option(
            '--gap', metavar='FILE', help='Changes to params/gap.yaml.')] = None,
        fix: Annotated[bool, typer.Option(
            '--fix', help='Correct damaged recordings where the correction is certain; the bags '
                          'stay as they are.')] = False,
        tolerances: Annotated[bool, typer.Option(
            '--tolerances', help="With --apply: also write this robot's own mass, inertia, gains, "
                                 'lags and rotor positions, as fitted within tolerance.')] = False,
        json_path: JsonOption = None):
    """
    Find where model and measurement disagree, name the effect, add it, show the gap shrink.

    Example: beetle_omni gap flight1 flight2 --holdout flight3 --apply robot_new.yaml
    """
    from beetle_omni_ros.identify.gap.command import run_gap
    raise typer.Exit(run_gap(runs, holdout or [], robot, apply, json_path, page,
                             parameters=parameters, fix=fix, tolerances=tolerances))


def spread(arguments: list[str]) -> list[str]:
    """
    Let `gap RUN... --holdout RUN RUN` mean two flights that judge, not a third that is fitted.

    Without a run before it, `--holdout` takes one, and the runs follow.
    """
    spread, runs, holding = [], 0, False
    for k, argument in enumerate(arguments):
        if argument == HOLDOUT:
            holding = True
        elif argument.startswith('-'):
            holding = False
        elif arguments[k - 1].startswith('-') and k and arguments[k - 1] != HOLDOUT:
            pass            # the value of another option
        elif holding and arguments[k - 1] != HOLDOUT and runs:
            spread.append(HOLDOUT)
        elif not holding:
            runs += 1
        spread.append(argument)
    return spread
