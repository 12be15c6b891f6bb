"""
Effects hidden in flights of the own simulator: ``python benchmarks/gap_own.py --seed 0``.

Of 65 cases, 41 hide one entry of the catalogue each, 16 hide two and 8 none, with the sizes of
:func:`formulas.drawn`. A drawn controller flies drawn tasks, `gap` gets the bags, and its answer
is judged as in ``gap_campaign.py``. Unlike there, simulator and model have the same laws. The same
command continues a run. A case depends on its number and the seed alone.
"""

import argparse
from collections import namedtuple
from functools import partial
from pathlib import Path

from formulas import attempted, described, hidden, OF_ONE, swept
from gap_data.campaign import read_answer
from gap_data.judge import judge
from gap_data.score import criteria, LEGEND, table
import numpy as np
from rich.console import Console
from rich.markdown import Markdown

from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.identify.flights.keys import all_keys
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.model.parameters import RobotParameters

ENTRIES = list(dict.fromkeys(key.effect for key in all_keys(RobotParameters.load()).values()))
ENTRIES += [name + OF_ONE for name in ENTRIES
            if any(parameter.of_each for parameter in CATALOGUE[name].parameters.values())]
PAIRS, NONE = 16, 8     # cases beside one of each entry
KINDS = 'singles', 'pairs', 'none'
TASKS = [['random5'] * 3, ['random5', 'lemniscate', 'random5'], ['random7'] * 2]
Case = namedtuple('Case', 'name key cost kind effects number seed')


def case_of(seed, number):
    """Case with this number."""
    size = len(ENTRIES) + PAIRS + NONE
    rng = np.random.default_rng([seed, number // size])
    sets = [[name] for name in ENTRIES] + [[]] * NONE + [
        rng.choice(ENTRIES, 2, replace=False).tolist() for _ in range(PAIRS)]
    names = sets[rng.permutation(size)[number % size]]
    kind = KINDS[len(names) - 1]
    return Case(f'{number} {kind}', '', 1, kind, names, number, seed)


def labels(truth):
    """Hidden effects as :func:`gap_data.judge.judge` expects them, one of four with its place."""
    made = []
    for name, values in truth.items():
        of, place, first = CATALOGUE[name].each, {}, next(iter(values))
        if of or CATALOGUE[name].parameters[first].of_each and np.ndim(values[first]):
            k = int(np.argmax(np.abs(values[first] - np.median(values[first]))))
            values = {key: value[k] for key, value in values.items() if np.ndim(value)}
            place = {of or 'joint': k + 1}
        made.append({'name': name, **place, 'parameters': values})
    return made


def judged(case, truth, answer, problems=()):
    """Score of an answer about flights with true effects."""
    label = {'case': {'kind': case.kind, 'number': case.number}, 'effects': labels(truth),
             'allowed': [], 'accept': ['no_gap'] * (case.kind == 'none'), 'command_age': 0.0}
    row = judge(label, {'answer': answer, 'problems': list(problems), 'traceback': False,
                        'message': '', 'wall_s': None, 'cpu_s': None})
    return row | {'ln_bayes_factors': [effect['evidence']['ln_bayes_factor']
                                       for effect in answer['effects']],
                  'partial': [effect['members'] for effect in answer['partial']]}


def examined(case, folder):
    """Fly a case, and score what `gap` finds in its flights."""
    rng = np.random.default_rng([case.seed, 1, case.number])
    base, robot = described(case.effects, folder)
    controller, tasks = ('nmpc', 'rl')[rng.integers(2)], TASKS[rng.integers(len(TASKS))]
    plant, paths, _, lost = hidden(case.effects, base, controller, tasks, rng, folder)
    gap_results(paths, [], robot, json_path=folder / 'gap.json', console=Console(quiet=True))
    return judged(case, plant.effects, *read_answer(folder / 'gap.json')) | {
        'controller': controller, 'tasks': tasks, 'lost': lost}


def line(case, row, kept=False):
    """Text about one case."""
    if 'failure' in row:
        return f"{case.name:12} {', '.join(case.effects)}: {row['failure']}"
    found = ''.join(f" {' or '.join(names)} (ln B {gain:.3g})" for names, gain in zip(
        row['answers'], row['ln_bayes_factors'], strict=True))
    marks = '' if row['right'] else ' MISSED', ' WRONG NAME' * bool(row['wrong'])
    return (f"{case.name:12} {row['controller']:4} {', '.join(case.effects) or '-'}: "
            f"{row['verdict']}{found}{''.join(marks)}, {row['cpu_s']:.0f} s")


def main():
    """Examine the cases and print their score."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--cases', type=int, default=65)
    parser.add_argument('--case', type=int, help='only the one with this number, in full')
    parser.add_argument('--jobs', type=int, help='at a time (every core)')
    parser.add_argument('--out', type=Path, default=Path('runs_out/gap_own.json'),
                        help='results; finished cases are kept in a folder beside it')
    given, console = parser.parse_args(), Console(width=140)
    if given.case is not None:
        return console.print_json(data=attempted(examined, case_of(given.seed, given.case)))
    cases = [case_of(given.seed, number) for number in range(given.cases)]
    rows = swept(partial(attempted, examined), cases, given, console, line)
    scored = [row for row in rows if 'failure' not in row]
    score = [row for row in criteria(scored, 'hard', 'exact')
             if row['count'] and row['target'] != 1.0]      # of all: failures are not scored
    console.print(Markdown('\n'.join([*table(score), '', LEGEND])))
    console.print(f'{len(rows)} cases, {len(rows) - len(scored)} failures')
    write_json(given.out, {'seed': given.seed, 'score': score, 'cases': [
        {'case': case.name, 'effects': case.effects, **row}
        for case, row in zip(cases, rows, strict=True)]})


if __name__ == '__main__':
    main()
