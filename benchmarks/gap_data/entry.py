"""
Runs a Python workflow in a process of its own: ``python -m gap_data.entry MODULE:FUNCTION ...``.

The function is called as ``run_gap(runs, holdout, robot, apply, json_path, page, console)``.
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
import sys


def main(arguments: list[str] | None = None) -> int:
    """Call the function with paths and a console on standard error; its status is ours."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('function')
    parser.add_argument('runs', nargs='+')
    for option in ('holdout',):
        parser.add_argument(f'--{option}', nargs='*', default=[])
    for option in ('robot', 'apply', 'json', 'page'):
        parser.add_argument(f'--{option}', required=True)
    given = parser.parse_args(arguments)
    module, _, name = given.function.partition(':')
    function = getattr(importlib.import_module(module), name)
    from rich.console import Console
    status = function(runs=[Path(p) for p in given.runs],
                      holdout=[Path(p) for p in given.holdout], robot=Path(given.robot),
                      apply=Path(given.apply), json_path=Path(given.json),
                      page=Path(given.page), console=Console(stderr=True, quiet=True))
    return int(status or 0)


if __name__ == '__main__':
    sys.exit(main())
