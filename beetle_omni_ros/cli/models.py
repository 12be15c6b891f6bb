"""Subcommands that use data: gap, identify joint, identify rotor, train."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import JsonOption, PublishedOption

PageOption = Annotated[Optional[Path], typer.Option(
    '--report', metavar='FILE', help='Write a self-contained HTML page with plots.')]
ParamsOption = Annotated[Optional[Path], typer.Option(
    '--params', metavar='FILE', help='Write a robot file with the result.')]
RateOption = Annotated[Optional[float], typer.Option(
    '--rate', min=1, metavar='HZ', help='Rows a second of time series without a column of times.')]
HOLDOUT = '--holdout'


def gap(runs: Annotated[list[Path], typer.Argument(
            metavar='RUN...', help='Recorded flights (bags), or logs of the joints (CSV, or bags '
                                     'with only joint_states and command).')],
        holdout: Annotated[Optional[list[Path]], typer.Option(
            HOLDOUT, metavar='RUN...', help='Flights for validation only. Default: the last run '
                                            'of three or more.')] = None,
        robot: Annotated[Optional[Path], typer.Option(
            '--robot', metavar='FILE', help='Robot file with which the flights are compared. '
                                            'Default: the shipped params/robot.yaml.')] = None,
        apply: Annotated[Optional[Path], typer.Option(
            '--apply', metavar='FILE', help='Write a robot file with the named effects.')] = None,
        page: PageOption = None,
        parameters: Annotated[Optional[Path], typer.Option(
            '--gap', metavar='FILE', help='File with changes to params/gap.yaml.')] = None,
        fix: Annotated[bool, typer.Option(
            '--fix', help='Correct damaged recordings if the correction is certain; the bags stay '
                          'unchanged.')] = False,
        tolerances: Annotated[bool, typer.Option(
            '--tolerances', help="With --apply: also write this robot's own mass, inertia, gains, "
                                 'lags and rotor positions, as fitted within tolerance.')] = False,
        json_path: JsonOption = None):
    """
    Compare flights with the robot model, identify the missing effect and add it to the model.

    Example: beetle_omni gap flight1 flight2 --holdout flight3 --apply robot_new.yaml
    """
    from beetle_omni_ros.identify.gap.command import run_gap
    raise typer.Exit(run_gap(runs, holdout or [], robot, apply, json_path, page,
                             parameters=parameters, fix=fix, tolerances=tolerances))


def spread(arguments: list[str]) -> list[str]:
    """
    Interpret `gap RUN... --holdout RUN RUN` as two held-out flights.

    If no run precedes `--holdout`, only the first run after it is held out.
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


def joint(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG...', help='Response logs (CSV) or recorded run (bag), see '
                                  'docs/how-to/identification.md.')],
          validate: Annotated[Optional[list[Path]], typer.Option(
              '--validate', metavar='LOG.csv...', help='Further logs for validation.')] = None,
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Fit one servo model to the first 60 % of response logs; the rest is for validation.

    Several logs of the same servos are fitted together. With --validate, one log is fitted.

    Example: beetle_omni identify joint slow.csv --validate fast.csv --report servos.html
    """
    from beetle_omni_ros.runs.bag_files import runs_in
    logs = runs_in(logs)
    more = logs[1:] if validate else []     # `--validate a.csv b.csv` puts b.csv here
    from beetle_omni_ros.identify.command import run_identify_joint
    run_identify_joint(logs[:len(logs) - len(more)], validate=[*(validate or []), *more],
                       robot=robot, report=report, params=params, json_path=json_path)


def rotor(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG.csv...', help='Logs of a force-torque stand, see '
                                         'docs/how-to/identification.md.')],
          columns: Annotated[Optional[list[str]], typer.Option(
              '--column', metavar='QUANTITY=[-]COLUMN[*FACTOR]',
              help='Column of a quantity with sign and factor to SI units, e.g. thrust=-fz or '
                   'thrust=load_g*0.00981; may be repeated.')] = None,
          rate: RateOption = None,
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Fit thrust, torque and lag of a rotor to logs of a force-torque stand.

    Ends with status 3 for the verdict bad_data.

    Example: beetle_omni identify rotor bench.csv --params my_robot.yaml --report rotor.html
    """
    from beetle_omni_ros.identify.command import run_identify_rotor
    results = run_identify_rotor(logs, columns=columns or (), rate=rate, robot=robot,
                                 report=report, params=params, json_path=json_path)
    raise typer.Exit(3 if results['verdict'] == 'bad_data' else 0)


def robot(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG...', help='Response logs of the joints (CSV or bag) and logs of a '
                                     'force-torque stand, recognised by their header.')],
          params: Annotated[Path, typer.Option(
              '--params', metavar='FILE', help='The robot file to write.')],
          rate: RateOption = None, robot: PublishedOption = None,
          picture: Annotated[Optional[Path], typer.Option(
              '--picture', metavar='FILE', help='Draw the logs with both robots (.png or .svg).')]
          = None, json_path: JsonOption = None):
    """
    Write a robot file with intervals and origins from all logs of servos and rotors.

    Example: beetle_omni identify robot slow.csv fast.csv bench.csv --params my_robot.yaml
    """
    from beetle_omni_ros.identify.command import run_identify_robot
    run_identify_robot(logs, params, rate=rate, robot=robot, picture=picture,
                       json_path=json_path)


def train(output: Annotated[Path, typer.Option(
              '--output', metavar='DIR', help='Folder for checkpoints, TensorBoard log and '
                                              'policy.onnx. Default: that of --resume.')] = None,
          config: Annotated[Optional[Path], typer.Option(
              '--config', metavar='FILE', help='Training parameters. Default: the shipped '
                                               'params/train.yaml.')] = None,
          changes: Annotated[Optional[list[str]], typer.Option(
              '--set', metavar='KEY=VALUE', help='Replace a parameter, e.g. iterations=5000 or '
                                                 'ppo.robots=8192; may be repeated.')] = None,
          seed: Annotated[Optional[int], typer.Option(
              '--seed', min=0, max=2**31 - 1, help='Seed of all random numbers.')] = None,
          memory: Annotated[Optional[bool], typer.Option(
              '--memory', help='Add the estimated disturbance to the inputs of the '
                               'policy.')] = None,
          device: Annotated[str, typer.Option('--device', help='auto, cpu, cuda[:N].')] = 'auto',
          resume: Annotated[Optional[Path], typer.Option(
              '--resume', metavar='DIR', help='Continue from the last checkpoint of a run, or '
                                              'from a model_N.pt.')] = None,
          smoke: Annotated[bool, typer.Option(
              '--smoke', help='Test all parts with tiny sizes.')] = False,
          stop_after: Annotated[Optional[float], typer.Option(
              '--stop-after', min=0, metavar='SECONDS',
              help='End the training after this time.')] = None,
          robot: Annotated[Optional[Path], typer.Option(
              '--robot', metavar='FILE', help='Robot file for the training, with its effects. '
                                              'Default: the shipped params/robot.yaml.')] = None,
          json_path: JsonOption = None):
    """
    Train a policy and export it to ONNX; needs the extra 'train' and a GPU.

    Several GPUs: torchrun --nproc-per-node N -m beetle_omni_ros.cli train --output DIR
    """
    from beetle_omni_ros.train.command import run_train
    from beetle_omni_ros.train.run_folder import parse_changes
    run_train(output=output, config=config, robot=robot, device=device, resume=resume,
              changes=parse_changes(changes or [], seed=seed, memory=memory),
              smoke=smoke, stop_after=stop_after, json_path=json_path)
