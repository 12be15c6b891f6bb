"""
Blind campaign of `beetle_omni gap`: ``python benchmarks/gap_campaign.py --set fast --seed 0``.

``benchmarks/gap_data`` makes flights with hidden effects, with its own robot, controller and
formulas. The tool runs on each flight in a process that gets only bags and a robot file. Its
answers are compared with the labels. Flights and answers are kept; the same command continues an
interrupted campaign.
"""

import argparse
import json
import os
from pathlib import Path
import shlex
import sys

from rich.console import Console
from rich.markdown import Markdown
from rich.progress import track

HERE = Path(__file__).resolve().parent
PLACES = [str(HERE), str(HERE.parent)]
sys.path[:0] = PLACES       # this tree's package, whatever is installed

from gap_data.campaign import run_campaign  # noqa: E402
from gap_data.cases import DIFFICULTIES, KINDS, load_settings, make_cases  # noqa: E402
from gap_data.effects import CATALOGUE, OUTSIDE  # noqa: E402
from gap_data.score import markdown, score  # noqa: E402

from beetle_omni_ros.flight.campaign import digest, SOURCE, workers  # noqa: E402

# words of --only; of each sort named, one must fit
SORTS = KINDS, DIFFICULTIES, ('nominal', 'published'), (*CATALOGUE, *OUTSIDE)
TOOL = f'{sys.executable} -m beetle_omni_ros'


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--set', default='fast', choices=tuple(load_settings()['sets']))
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--cases', type=int, help='only so many, spread over the set')
    parser.add_argument('--only', default='', help='only these kinds, difficulties, conditions '
                        'and effects, separated by commas; of each sort named, one must fit')
    parser.add_argument('--tool', default=TOOL, help='command before `gap` (this tree)')
    parser.add_argument('--folder', type=Path, default=Path('runs_out/gap_campaign'))
    parser.add_argument('--jobs', type=int, help='at a time (every core)')
    given = parser.parse_args()
    if unknown := {*filter(None, given.only.split(','))}.difference(*SORTS):
        parser.error(f"--only '{given.only}': no kind, difficulty, condition or effect is called "
                     f"{', '.join(sorted(unknown))}")
    return given


def chosen(given: argparse.Namespace) -> list:
    """Cases of the command line."""
    named = [words for sort in SORTS if (words := {*given.only.split(',')} & {*sort})]
    cases = [c for c in make_cases(given.set, given.seed) if all(
        words & {c.kind, c.difficulty, c.conditions, *(name for name, _, _ in c.effects)}
        for words in named)]
    if given.cases is not None and given.cases < len(cases):
        step = (len(cases) - 1) / max(1, given.cases - 1)
        cases = [cases[round(k * step)] for k in range(given.cases)]
    return cases


def main() -> int:
    """Run a campaign and write report.json and report.md."""
    given = parse()
    os.environ['PYTHONPATH'] = os.pathsep.join(filter(None, [
        *PLACES, os.environ.get('PYTHONPATH', '')]))     # for the workers and the tool
    cases, folder = chosen(given), given.folder.resolve()
    version = digest(*(path.read_bytes() for path in sorted(SOURCE.rglob('*.py'))))[:8]
    with workers(jobs=given.jobs):
        judged = [row for row in track(run_campaign(cases, given.tool, folder, version=version),
                                       'cases', len(cases), console=Console(stderr=True)) if row]
    report = {'meta': {'cases': len(cases), 'lost': len(cases) - len(judged), 'code': version,
                       'command': shlex.join(['python', *sys.argv])},
              'criteria': score(judged), 'judged': judged}
    (folder / 'report.json').write_text(json.dumps(report, indent=1))
    (folder / 'report.md').write_text(markdown(report))
    Console().print(Markdown(markdown(report)))
    return 0


if __name__ == '__main__':
    sys.exit(main())
