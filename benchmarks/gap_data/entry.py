"""
Runs a Python workflow in a process of its own: ``python -m gap_data.entry MODULE:FUNCTION ...``.

The function is called as ``run_gap(runs, holdout, robot, apply, json_path, page, console)``. An
exception of a class of its own package is a refusal, as the command line prints it: one line on
standard error and status 2. Python's own exceptions are bugs and leave a traceback.
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
import sys

from rich.console import Console


def main(arguments: list[str] | None = None) -> int:
    """Call the function with paths and a console on standard output; its status is ours."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('function')
    parser.add_argument('runs', nargs='+')
    parser.add_argument('--holdout', nargs='*', default=[])
    for option in ('robot', 'apply', 'json', 'page'):
        parser.add_argument(f'--{option}', required=True)
    given = parser.parse_args(arguments)
    module, _, name = given.function.partition(':')
    function = getattr(importlib.import_module(module), name)
    try:
        status = function(runs=[Path(p) for p in given.runs],
                          holdout=[Path(p) for p in given.holdout], robot=Path(given.robot),
                          apply=Path(given.apply), json_path=Path(given.json),
                          page=Path(given.page), console=Console(file=sys.stdout))
    except Exception as error:
        if type(error).__module__.split('.')[0] != module.split('.')[0]:
            raise
        print(error, file=sys.stderr)
        return 2
    return int(status or 0)


if __name__ == '__main__':
    sys.exit(main())
