"""Options, exit statuses and input checks that several subcommands share."""

from pathlib import Path
import sys
from typing import Annotated, Optional

import typer

from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.files import check_writable

UNUSABLE, FAILED, INTERRUPTED = 2, 1, 130
CONDITIONS = ('nominal', 'published')
COMPRESSIONS = ('none', 'zstd')

# Without controllers of other packages, because --help does not search installed packages.
KNOWN = f"{', '.join(registry.SHIPPED)}, any registered one, {registry.CLASS}"

ControllerOption = Annotated[str, typer.Option(
    '--controller', metavar='NAME', help=f'The active controller: {KNOWN}.')]
TaskOption = Annotated[str, typer.Option(
    '--task', help='CSV file of poses, or waypoints, randomN (random100), lemniscate, '
                   'lemniscate_large, hover, force, force_down, force_up, torque, torque_pulses, '
                   'wind, pushes, payload or steps.', metavar='TASK')]
ConditionsOption = Annotated[str, typer.Option(
    '--conditions', metavar='nominal|published',
    help="nominal: the simulator with the measured parameters; published: with the publication's "
         'randomisation, drawn from --seed.')]
SeedOption = Annotated[int, typer.Option(
    '--seed', min=0, max=2**31 - 1, help='Seed of random poses and of the simulation.')]
RobotOption = Annotated[Optional[Path], typer.Option(
    '--robot', metavar='FILE', help='Robot file of estimator and controller. Default: the shipped '
                                    'params/robot.yaml.')]
PublishedOption = Annotated[Optional[Path], typer.Option(
    '--robot', metavar='FILE', help='Robot file. Default: the shipped params/robot.yaml.')]
PlantOption = Annotated[Optional[Path], typer.Option(
    '--plant', metavar='FILE', help='Robot file of the simulated plant; measured: the shipped one '
                                    'of the measured robot. Default: as --robot.')]
NmpcOption = Annotated[Optional[Path], typer.Option(
    '--nmpc', metavar='FILE',
    help=f"Parameters of the controller '{registry.owner('--nmpc')}'. Default: the shipped "
         'params/nmpc.yaml.')]
PolicyOption = Annotated[Optional[Path], typer.Option(
    '--policy', metavar='FILE',
    help=f"Policy (ONNX) for the controller '{registry.owner('--policy')}'. Default: the shipped "
         'one.')]
OtherRobotOption = Annotated[bool, typer.Option(
    '--allow-other-robot', help='Fly a policy although it was trained for other robot '
                                'parameters.')]
CompressionOption = Annotated[str, typer.Option(
    '--compression', metavar='none|zstd', help='Compression of the chunks in the bag.')]
FaultsOption = Annotated[Optional[Path], typer.Option(
    '--faults', metavar='FILE', help='Faults with times and durations (YAML, see '
                                     'docs/faults.md).')]
JobsOption = Annotated[Optional[int], typer.Option(
    '--jobs', '-j', min=1, help='Parallel flights. Default: one on each core.')]
JsonOption = Annotated[Optional[Path], typer.Option(
    '--json', metavar='FILE', help='Write the results as JSON.')]


def fail(error: Exception | str, status: int) -> int:
    """Print an error as one line on standard error; returns ``status``."""
    print(f"beetle_omni: error: {' '.join(str(error).split())}", file=sys.stderr)
    return status


MAY_BE_EMPTY = ('--namespace',)


def refuse_empty(args: list[str]) -> None:
    """Refuse '' as a value: as a path it would mean the working folder."""
    for option, value in zip(['', *args], args):
        if value == '' and option not in MAY_BE_EMPTY:
            where = option if option.startswith('-') else 'argument'
            raise ParameterError(f"{where} '': expected a value")


def usage_text(error: Exception, args: list[str]) -> str:
    """
    Text of a usage error of typer's parser: the given value, its option, the expected value.

    Args:
        error: error with ``format_message()``; for a wrong value with ``param`` and ``ctx``.
        args: arguments of the command line, which contain the value.

    """
    text, context = error.format_message(), getattr(error, 'ctx', None)
    if not text:
        return ''
    names = getattr(getattr(error, 'param', None), 'opts', ())
    if type(error).__name__ == 'BadParameter' and names:
        given = [value for name, value in zip(args, args[1:]) if name in names] + [
            arg.partition('=')[2] for arg in args if arg.partition('=')[0] in names and '=' in arg]
        # remove pydantic's wording, of newer versions of typer
        wanted = str(error.message).partition(', unable')[0].replace('Input should be', 'expected')
        text = f"{names[0]} '{given[0]}': {wanted}." if given else text
    command = context.command_path if context else 'beetle_omni'
    return f'{text} See {command} --help.'


def check_files(*files: Path | None):
    """Refuse files that do not exist; None: not given."""
    for file in files:
        if file is not None and not file.is_file():
            raise ParameterError(f'{file}: no such file')


def check_flight(conditions: str, compression: str, json_path: Path | None, *files: Path | None):
    """Refuse unusable input before the flight starts."""
    for option, given, known in (('conditions', conditions, CONDITIONS),
                                 ('compression', compression, COMPRESSIONS)):
        if given not in known:
            raise ParameterError(f"--{option} '{given}': expected {' or '.join(known)}")
    check_files(*files)
    check_writable(json_path)


def names(option: str, text: str | None) -> list[str] | None:
    """Split a list of names; None stays None; no or equal entries are a ParameterError."""
    if text is None:
        return None
    found = [part.strip() for part in text.split(',') if part.strip()]
    if not found or len(set(found)) != len(found):
        raise ParameterError(f"{option} '{text}': expected different entries, separated by "
                             'commas')
    return found


def numbers(option: str, text: str | None) -> list[int] | None:
    """Split a list of whole numbers from 0; None stays None; others are a ParameterError."""
    found = names(option, text)
    if found is None:
        return None
    for part in found:
        if not part.isdecimal() or int(part) >= 2**31:
            raise ParameterError(f"{option} '{text}': expected whole numbers from 0, separated "
                                 f"by commas, found '{part}'")
    return [int(part) for part in found]
