"""
Blind campaign of the gap workflow: ``python benchmarks/gap_campaign.py --set fast --seed 0``.

``benchmarks/gap_data`` makes flights with hidden effects, with its own robot, controller and
formulas. The workflow runs on each flight in a process that gets only bags and a robot file. Its
answers are compared with the labels. Flights and answers are kept; the same command continues an
interrupted campaign.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
import hashlib
import importlib.util
import json
import os
from pathlib import Path
import shlex
import sys

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

HERE = Path(__file__).resolve().parent
PLACES = [str(HERE), str(HERE.parent)]
if __name__ == '__main__':
    sys.path[:0] = PLACES  # this tree's package, whatever is installed
else:
    sys.path.extend(place for place in PLACES if place not in sys.path)

from gap_data.campaign import code_key, make_report, run_campaign  # noqa: E402
from gap_data.cases import DIFFICULTIES, KINDS, load_settings, make_cases  # noqa: E402
from gap_data.effects import CATALOGUE, OUTSIDE  # noqa: E402
from gap_data.make import ROBOT_FILE  # noqa: E402
from gap_data.page import markdown, number, target  # noqa: E402
from gap_data.truth import load_numbers  # noqa: E402
from gap_data.workflow import Workflow, WorkflowError  # noqa: E402

WORKFLOW = 'gap=beetle_omni_ros.identify.gap.command:run_gap'
PACKAGE = HERE.parent / 'beetle_omni_ros'


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0],
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--set', default='fast', help='fast, full or smoke')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--cases', type=int, help='only so many, spread over the set')
    parser.add_argument('--only', help='only these kinds, difficulties and effects, separated by '
                                       'commas: of each sort that is named, one must fit')
    parser.add_argument('--workflow', action='append', metavar='[NAME=]TEXT',
                        help='MODULE:FUNCTION, or a command with {runs} {holdout} {robot} '
                             f'{{apply}} {{json}} {{page}}; again for more (default {WORKFLOW})')
    parser.add_argument('--flights-only', action='store_true', help='make the flights, ask nobody')
    parser.add_argument('--folder', type=Path, default=Path('runs_out/gap_campaign'))
    parser.add_argument('--sealed', type=Path, help='where labels are kept (FOLDER/sealed)')
    parser.add_argument('--output', type=Path, help='where the report goes (FOLDER)')
    parser.add_argument('--robot', type=Path, default=ROBOT_FILE, help='file for the workflows')
    parser.add_argument('--command-age', type=float, default=load_numbers()['command_age'],
                        metavar='S', help="from a command's stamp until it acts (%(default)s)")
    parser.add_argument('--backend', default='processes', choices=('processes', 'ray'))
    parser.add_argument('--jobs', type=int, help='at a time (every core)')
    parser.add_argument('--address', help='of a running Ray cluster')
    parser.add_argument('--timeout', type=float, default=300.0, metavar='S', help='for a case')
    parser.add_argument('--fresh', action='store_true', help='ask again where an answer is kept')
    return parser.parse_args(arguments)


def choose_workflows(given: argparse.Namespace) -> list[Workflow]:
    """Workflows of the command line."""
    if given.flights_only:
        return []
    # kept answers depend on the present code of the package
    version = code_key([PACKAGE]) + hashlib.sha256(given.robot.read_bytes()).hexdigest()
    workflows = [Workflow.parse(text, given.timeout) for text in given.workflow or [WORKFLOW]]
    for workflow in workflows:
        check_exists(workflow)
    return [replace(workflow, version=version) for workflow in workflows]


def check_exists(workflow: Workflow) -> None:
    """Refuse a missing Python workflow before any flight is made."""
    module = workflow.text.partition(':')[0]
    if '{' in workflow.text:
        return
    try:
        found = importlib.util.find_spec(module)
    except ModuleNotFoundError:
        found = None
    if found is None:
        raise WorkflowError(f"--workflow '{workflow.text}': no module {module}")


def select(cases, only: str | None):
    """
    Cases of the listed kinds, difficulties and effects.

    Raises:
        WorkflowError: unknown name.

    """
    if only is None:
        return cases
    names = set(only.split(','))
    unknown = names - {*KINDS, *DIFFICULTIES, *CATALOGUE, *OUTSIDE}
    if unknown:
        raise WorkflowError(f"--only '{only}': no kind, difficulty or effect is called "
                            f"{', '.join(sorted(unknown))}")
    kinds, difficulties = names & set(KINDS), names & set(DIFFICULTIES)
    effects = names - kinds - difficulties
    return [c for c in cases if c.kind in (kinds or KINDS)
            and c.difficulty in (difficulties or DIFFICULTIES)
            and (not effects or effects & {e[0] for e in c.effects})]


def main(arguments: list[str] | None = None) -> int:
    """Run a campaign and write report.json and report.md."""
    given = parse(arguments)
    console = Console(stderr=True)
    # for the workers and for the workflow's process
    before = os.environ.get('PYTHONPATH', '').split(os.pathsep)
    os.environ['PYTHONPATH'] = os.pathsep.join(
        filter(None, [*before, *(place for place in PLACES if place not in before)]))
    try:
        settings = load_settings()
        if given.set not in settings['sets']:
            raise WorkflowError(f"--set '{given.set}': expected one of "
                                f"{', '.join(settings['sets'])}")
        if not given.robot.is_file():
            raise WorkflowError(f"--robot '{given.robot}': no such file")
        cases = select(make_cases(settings, given.set, given.seed, given.command_age),
                       given.only)
        workflows = choose_workflows(given)
        from beetle_omni_ros.evaluation.campaign import workers
    except ValueError as error:
        console.print(str(error), style='red', markup=False)
        return 2
    if given.cases is not None and given.cases < len(cases):
        step = (len(cases) - 1) / max(1, given.cases - 1)
        cases = [cases[round(k * step)] for k in range(given.cases)]
    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
               TimeRemainingColumn(), TextColumn('{task.fields[now]}'))
    tally: Counter = Counter()
    total = len(cases) * max(1, len(workflows))
    folder = given.folder.resolve()
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task('cases', total=total, now='')

        def done(case, name, judged, kept):
            if judged is None:
                tally['lost' if workflows else 'flights'] += 1
                progress.advance(bar, max(1, len(workflows)))
            else:
                tally[name] += bool(judged['right'])
                tally[f'{name} of'] += 1
                progress.advance(bar)
            progress.update(bar, now=' '.join(
                f'{w.name} {tally[w.name]}/{tally[w.name + " of"]}' for w in workflows))

        with workers(given.backend, given.jobs, given.address):
            judged = run_campaign(cases, workflows, folder, sealed=given.sealed,
                                  robot_file=given.robot.resolve(), fresh=given.fresh, done=done)
    if not workflows:
        console.print(f'{tally["flights"]} cases in {folder}', markup=False)
        return 0
    meta = {'set': given.set, 'seed': given.seed, 'cases': len(cases), 'lost': tally['lost'],
            'command_age': given.command_age, 'code': code_key([PACKAGE]),
            'command': command_of(given)}
    write(make_report(judged, meta), (given.output or folder).resolve())
    return 0


def command_of(given: argparse.Namespace) -> str:
    """Command that reproduces the numbers, without local folders."""
    words = ['python', 'benchmarks/gap_campaign.py', '--set', given.set, '--seed',
             str(given.seed)]
    for option in ('cases', 'only', 'command_age'):
        value = getattr(given, option)
        if value is not None and value != load_numbers().get(option):
            words += ['--' + option.replace('_', '-'), str(value)]
    for text in given.workflow or []:
        words += ['--workflow', text]
    return shlex.join(words)


def write(report: dict, output: Path) -> None:
    """Write the two files of a report, and print the table."""
    output.mkdir(parents=True, exist_ok=True)
    (output / 'report.json').write_text(json.dumps(report, indent=1))
    (output / 'report.md').write_text(markdown(report))
    names = list(report['workflows'])
    for difficulty in ('clean', 'hard'):
        table = Table('', 'target', *names, title=f'{difficulty} flights')
        for rows in zip(*(report['workflows'][n]['criteria'][difficulty] for n in names)):
            if rows[0]['count'] or any(r['count'] for r in rows):
                table.add_row(escape(rows[0]['name']), target(rows[0]), *(
                    f'[{ {True: "green", False: "red", None: "white"}[r["reached"]]}]'
                    f'{escape(number(r))}[/]' for r in rows))
        if table.row_count:
            Console().print(table)
    print(f'{output}/report.md, report.json')


if __name__ == '__main__':
    sys.exit(main())
