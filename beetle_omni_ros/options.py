"""Options that several subcommands share, with the checks of their values."""

from functools import partial
import os
from pathlib import Path
from typing import Annotated

from typer import CallbackParam, Option, Typer

from beetle_omni_ros.control import registry
from beetle_omni_ros.model.schema import ParameterError

UNUSABLE, FAILED, INTERRUPTED = 2, 1, 130
CONDITIONS = ('nominal', 'published')
# Without controllers of other packages, because --help does not search installed packages.
KNOWN = f"{', '.join(registry.SHIPPED)}, any registered one, {registry.CLASS}"
DEFAULT_ROBOT = 'Default: the shipped params/robot.yaml.'
# The panels of rich show a flag as <bool> and leave out the other name of --standby/--alone.
Commands = partial(Typer, no_args_is_help=True, rich_markup_mode=None,
                   context_settings={'help_option_names': ['-h', '--help']})


def one_of(param: CallbackParam, value: str | None) -> str | None:
    """Refuse another value than those of the option's metavar."""
    known = param.metavar.split('|')
    if value is not None and value not in known:
        raise ParameterError(f"--{param.name} '{value}': expected {' or '.join(known)}")
    return value


def writable(file: Path | None) -> Path | None:
    """Refuse a file that cannot be written, before its content is computed."""
    if file is None:
        return None
    folder = file.absolute().parent
    if file.is_dir():
        reason = 'it is a folder'
    elif not folder.is_dir():
        reason = f'there is no folder {folder}'
    elif not os.access(file if file.exists() else folder, os.W_OK):
        reason = 'no permission'
    else:
        return file
    raise ParameterError(f'{file}: cannot write there ({reason})')


def several(param: CallbackParam, text: str | None) -> list[str] | None:
    """Split a list of different entries."""
    if text is None:
        return None
    found = [part.strip() for part in text.split(',') if part.strip()]
    if not found or len(set(found)) != len(found):
        raise ParameterError(f"{param.opts[0]} '{text}': expected different entries, separated by "
                             'commas')
    return found


def whole(param: CallbackParam, text: str | None) -> list[int] | None:
    """Split a list of whole numbers from 0."""
    found = several(param, text)
    for part in found or ():
        if not part.isdecimal() or int(part) >= 2**31:
            raise ParameterError(f"{param.opts[0]} '{text}': expected whole numbers from 0, "
                                 f"separated by commas, found '{part}'")
    return None if found is None else list(map(int, found))


ControllerOption = Annotated[str, Option(
    '--controller', '--controllers', metavar='NAME', help=f'The active controller: {KNOWN}.')]
TaskOption = Annotated[str, Option(metavar='TASK', help=(
    'CSV or YAML file of poses, YAML file of set points, or waypoints, randomN (random100), '
    'lemniscate, lemniscate_large, hover, force, force_down, force_up, torque, torque_pulses, '
    'wind, pushes, payload or steps.'))]
ConditionsOption = Annotated[str, Option(
    callback=one_of, metavar='|'.join(CONDITIONS), help=(
        "nominal: the simulator with the measured parameters; published: with the publication's "
        'randomisation, drawn from --seed.'))]
SeedOption = Annotated[int, Option(
    metavar='N', min=0, max=2**31 - 1, help='Seed of random poses and of the simulation.')]
RobotOption = Annotated[Path | None, Option(
    metavar='FILE', help=f'Robot file of estimator and controller. {DEFAULT_ROBOT}')]
TheRobotOption = Annotated[Path | None, Option(
    metavar='FILE', help=f'Robot file. {DEFAULT_ROBOT}')]
PlantOption = Annotated[Path | None, Option(metavar='FILE', help=(
    'Robot file of the simulated plant; measured: the shipped one of the measured robot. '
    'Default: as --robot.'))]
NmpcOption = Annotated[Path | None, Option(
    exists=True, dir_okay=False, metavar='FILE', help=(
        f"Parameters of the controller '{registry.OWNER['parameters']}'. Default: the shipped "
        'params/nmpc.yaml.'))]
PolicyOption = Annotated[Path | None, Option(
    exists=True, dir_okay=False, metavar='FILE', help=(
        f"Policy (ONNX) for the controller '{registry.OWNER['policy']}'. Default: the shipped "
        'one.'))]
DomainOption = Annotated[int | None, Option(
    metavar='N', min=0, max=101, help='ROS domain. Default: ROS_DOMAIN_ID; of fly, a free one.')]
NamespaceOption = Annotated[str, Option(
    metavar='NAME', help="Namespace of the robot's topics in a running graph.")]
FaultsOption = Annotated[Path | None, Option(
    exists=True, dir_okay=False, metavar='FILE', help=(
        'Faults, all in one flight; their times count from the start of the task (YAML, see '
        'docs/faults.md).'))]
ComponentOption = Annotated[str | None, Option(
    '--component', callback=several, metavar='FILE.py:Class,...', help=(
        'Further components beside the flight, see docs/how-to/own_component.md.'))]
JobsOption = Annotated[int | None, Option(
    '--jobs', '-j', metavar='N', min=1, help='Parallel flights. Default: one on each core.')]
OutputOption = Annotated[Path | None, Option(
    '--output', '-o', metavar='DIR', help='Folder for page, pictures or Markdown, and JSON.')]
JsonOption = Annotated[Path | None, Option(
    '--json', callback=writable, metavar='FILE', help='Write the results as JSON.')]
FullOption = Annotated[bool, Option('--full', help=(
    'Print the whole table: largest errors, effort, CPU times, parts of the task, every pose.'))]
PageOption = Annotated[Path | None, Option(
    '--report', callback=writable, metavar='FILE', help=(
        'Write a self-contained HTML page with plots.'))]
ParamsOption = Annotated[Path | None, Option(
    callback=writable, metavar='FILE', help='Write a robot file with the result.')]
RateOption = Annotated[float | None, Option(
    min=1, metavar='HZ', help='Rows a second of time series without a column of times.')]
