"""
The `beetle_omni` command.

A subcommand imports its modules when it runs, so that `--help` is fast and an analysis needs no
ROS. Unusable input gives status 2 and one line on standard error.
"""

import sys

import typer
from typer.main import get_command

from beetle_omni_ros import __version__
from beetle_omni_ros.commands import app
from beetle_omni_ros.model.resources import commit, PACKAGE
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.options import FAILED, INTERRUPTED, UNUSABLE

ROS_ENDINGS = ('rclpy', 'ament_index_python', '_msgs', '_srvs', '_interfaces')     # of modules
CURES = {       # module -> how to install it
    **dict.fromkeys(('dynamixel_sdk', 'pymavlink', 'serial'),
                    "pip install 'beetle_omni_ros[hardware]'"),
    **dict.fromkeys(('onnx', 'onnxscript', 'rsl_rl', 'tensorboard', 'tensordict', 'torch'),
                    "run make setup-train in a checkout, or pip install 'beetle_omni_ros[train]'")}
SEVERAL = ('--holdout', '--validate')   # options with several values
MAY_BE_EMPTY = ('--namespace',)


def main(args: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    args = list(sys.argv[1:] if args is None else args)
    if args == ['--version']:
        print(f"beetle_omni_ros {__version__}, commit {commit() or 'unknown'}")
        return 0
    try:
        status = get_command(app).main(args=spread(args), prog_name='beetle_omni',
                                       standalone_mode=False)
        if status == INTERRUPTED:       # typer turns the exception into its status
            return _fail('interrupted', INTERRUPTED)
        return status if isinstance(status, int) else 0
    except ModuleNotFoundError as error:
        top = (error.name or '').partition('.')[0]
        if top == PACKAGE:
            raise
        cure = "source a ROS 2 Jazzy environment or pip install 'beetle_omni_ros[ros]'" \
            if top.endswith(ROS_ENDINGS) else CURES.get(top, 'pip install beetle_omni_ros')
        return _fail(f"the module '{top}' is not installed; {cure}", UNUSABLE)
    except ParameterError as error:
        return _fail(error, UNUSABLE)
    except RunError as error:
        return _fail(error, FAILED)
    except (KeyboardInterrupt, typer.Abort):
        return _fail('interrupted', INTERRUPTED)
    except Exception as error:
        # usage errors of typer's parser; importing their type would slow --help
        if hasattr(error, 'format_message'):
            text = error.format_message()
            if not text or text.startswith('Usage: '):      # the help of `beetle_omni` alone
                print(text, file=sys.stderr)
                return UNUSABLE
            context = getattr(error, 'ctx', None)
            command = context.command_path if context else 'beetle_omni'
            end = '' if text.endswith(('.', '?')) else '.'
            return _fail(f'{text}{end} See {command} --help.', UNUSABLE)
        raise


def run() -> None:
    """Entry point of the console script."""
    sys.exit(main())


def spread(arguments: list[str]) -> list[str]:
    """
    Repeat an option for each of its values: `--holdout RUN RUN`.

    Raises:
        ParameterError: '' as a value, which as a path would mean the working folder.

    """
    spread, option = [], ''
    for before, argument in zip(['', *arguments], arguments):
        if argument.startswith('-'):
            option = argument
        elif option in SEVERAL and before != option:
            spread.append(option)
        if argument == '' and before not in MAY_BE_EMPTY:
            where = before if before.startswith('-') else 'argument'
            raise ParameterError(f"{where} '': expected a value")
        spread.append(argument)
    return spread


def _fail(error: Exception | str, status: int) -> int:
    """Print an error as one line on standard error; returns ``status``."""
    print(f"beetle_omni: error: {' '.join(str(error).split())}", file=sys.stderr)
    return status
