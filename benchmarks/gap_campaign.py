"""
Blind campaign of `beetle_omni gap`: ``python benchmarks/gap_campaign.py --set fast --seed 0``.

``benchmarks/gap_data`` makes flights with hidden effects, with its own robot, controller and
formulas. The tool runs on each flight in a process that gets only bags and a robot file. Its
answers are compared with the labels. Flights and answers are kept; the same command continues an
interrupted campaign.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from pathlib import Path
import sys

from rich.console import Console
from rich.markdown import Markdown
from rich.progress import Progress

HERE = Path(__file__).resolve().parent
PLACES = [str(HERE), str(HERE.parent)]
sys.path[:0] = PLACES       # this tree's package, whatever is installed

from gap_data.campaign import code_key, run_campaign  # noqa: E402
from gap_data.cases import DIFFICULTIES, KINDS, load_settings, make_cases  # noqa: E402
from gap_data.effects import CATALOGUE, OUTSIDE  # noqa: E402
from gap_data.make import ROBOT_FILE  # noqa: E402
from gap_data.page import markdown  # noqa: E402
from gap_data.score import score  # noqa: E402
from gap_data.truth import load_numbers  # noqa: E402

from beetle_omni_ros.evaluation.campaign import workers  # noqa: E402

TOOL = f'{sys.executable} -m beetle_omni_ros.cli'


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--set', default='fast', choices=tuple(load_settings()['sets']))
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--cases', type=int, help='only so many, spread over the set')
    parser.add_argument('--only', default='', help='only these kinds, difficulties and effects, '
                        'separated by commas: of each sort that is named, one must fit')
    parser.add_argument('--tool', default=TOOL, help='command before `gap` (this tree)')
    parser.add_argument('--flights-only', action='store_true', help='make the flights, ask nobody')
    parser.add_argument('--folder', type=Path, default=Path('runs_out/gap_campaign'))
    parser.add_argument('--sealed', type=Path, help='where labels are kept (FOLDER/sealed)')
    parser.add_argument('--output', type=Path, help='where the report goes (FOLDER)')
    parser.add_argument('--robot', type=Path, default=ROBOT_FILE, help='file for the tool')
    parser.add_argument('--command-age', type=float, default=load_numbers()['command_age'],
                        metavar='S', help="from a command's stamp until it acts (%(default)s)")
    parser.add_argument('--jobs', type=int, help='at a time (every core)')
    parser.add_argument('--timeout', type=float, default=300.0, metavar='S', help='for a case')
    parser.add_argument('--fresh', action='store_true', help='ask again where an answer is kept')
    given = parser.parse_args(arguments)
    unknown = {*filter(None, given.only.split(','))} - {*KINDS, *DIFFICULTIES, *CATALOGUE,
                                                         *OUTSIDE}
    if unknown:
        parser.error(f"--only '{given.only}': no kind, difficulty or effect is called "
                     f"{', '.join(sorted(unknown))}")
    if not given.robot.is_file():
        parser.error(f"--robot '{given.robot}': no such file")
    return given


def chosen(given: argparse.Namespace) -> list:
    """Cases of the command line."""
    names = {*filter(None, given.only.split(','))}
    kinds, difficulties = names & set(KINDS), names & set(DIFFICULTIES)
    effects = names - kinds - difficulties
    cases = [c for c in make_cases(load_settings(), given.set, given.seed, given.command_age)
             if c.kind in (kinds or KINDS) and c.difficulty in (difficulties or DIFFICULTIES)
             and (not effects or effects & {e[0] for e in c.effects})]
    if given.cases is not None and given.cases < len(cases):
        step = (len(cases) - 1) / max(1, given.cases - 1)
        cases = [cases[round(k * step)] for k in range(given.cases)]
    return cases


def main(arguments: list[str] | None = None) -> int:
    """Run a campaign and write report.json and report.md."""
    given = parse(arguments)
    os.environ['PYTHONPATH'] = os.pathsep.join(filter(None, [
        *PLACES, os.environ.get('PYTHONPATH', '')]))     # for the workers and the tool
    cases, folder = chosen(given), given.folder.resolve()
    version = code_key([HERE.parent / 'beetle_omni_ros']) + hashlib.sha256(
        given.robot.read_bytes()).hexdigest()
    with Progress(console=Console(stderr=True)) as bars, workers(jobs=given.jobs):
        bar = bars.add_task('cases', total=len(cases))
        judged = run_campaign(
            cases, '' if given.flights_only else given.tool, folder, version=version,
            sealed=given.sealed, robot_file=given.robot.resolve(), fresh=given.fresh,
            timeout=given.timeout, done=lambda *_: bars.advance(bar))
    if given.flights_only:
        print(f'{len(cases)} cases in {folder}')
        return 0
    words = [f'--{name} {value}' for name in ('set', 'seed', 'cases', 'only')
             if (value := getattr(given, name)) not in (None, '')]
    report = {'meta': {'cases': len(cases), 'lost': len(cases) - len(judged), 'code': version[:8],
                       'command': ' '.join(['python benchmarks/gap_campaign.py', *words])},
              **score(judged), 'judged': judged}
    output = (given.output or folder).resolve()
    output.mkdir(parents=True, exist_ok=True)
    (output / 'report.json').write_text(json.dumps(report, indent=1))
    (output / 'report.md').write_text(markdown(report))
    Console().print(Markdown(markdown(report)))
    return 0


if __name__ == '__main__':
    sys.exit(main())
