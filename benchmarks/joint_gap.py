"""
Detection of servo changes by `beetle_omni gap LOG.csv`, and false detections.

`python benchmarks/joint_gap.py --cases 48 --seed 1`. The servos of each real
log are identified. Each case is an artificial log: a simulation of the identified servos with one
change, plus the residual of the real log, rounded to encoder counts. The residual is used
unchanged, circularly shifted, or in blocks of a second drawn at random. The log is compared with
the servos before the change.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
import time
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.identify.servo import compare as servo_compare
from beetle_omni_ros.identify.servo.compare import compare, gap_of
from beetle_omni_ros.identify.servo.log import JointLog, read_joint_log
from beetle_omni_ros.identify.servo.model import INDEX, NAMES, simulate
from beetle_omni_ros.identify.servo.results import identify
from beetle_omni_ros.model.parameters import RobotParameters

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'
COUNT = 2 * np.pi / 4096    # [rad] of the encoder
BLOCK = 1.0                 # [s] of a drawn block of the residual
WAYS = ('unchanged', 'shifted', 'blocks')       # of drawing the residual
SIZE = (0.010, 0.020)       # [rad] of a change
# Kind of change -> the entry that must be named; of a single joint's zero or encoder, with it.
KINDS = {'nothing': None, 'zero': 'joint_offset', 'two zeros': 'joint_offset',
         'encoder gain': 'joint_encoder_error', 'servo gains': 'joint_bandwidth',
         'delay': 'joint_command_latency', 'friction': 'joint_friction',
         'play': 'joint_backlash'}


def changed(sets: np.ndarray, log: JointLog, kind: str, rng: np.random.Generator):
    """Changed sets (J, P), and (name, joint or None) of what must be named."""
    sets, count = sets.copy(), len(sets)
    name, joints = KINDS[kind], rng.permutation(count)

    def sized(low, high):
        return float(rng.uniform(low, high) * rng.choice([-1, 1]))

    if kind == 'nothing':
        return sets, set()
    if kind in ('zero', 'two zeros', 'encoder gain'):
        joints = joints[:2 if kind == 'two zeros' else 1]
        for j in joints:
            by = sized(*SIZE)
            if kind == 'encoder gain':
                by /= np.abs(log.measured[j]).max()
            sets[j, INDEX['encoder_gain' if kind == 'encoder gain' else 'offset']] += by
        return sets, {(name, log.joints[j]) for j in joints}
    which = slice(None) if kind == 'delay' or rng.random() < 0.5 else joints[:1]
    if kind == 'servo gains':
        kp, kd = ((1 + sized(0.2, 0.4)) if used else 1.0
                  for used in ((True, False), (False, True), (True, True))[rng.integers(3)])
        sets[which, INDEX['natural_frequency']] *= np.sqrt(kp)
        sets[which, INDEX['damping_ratio']] *= kd / np.sqrt(kp)
    elif kind == 'delay':
        by = sized(0.008, 0.020)
        by = by if sets[:, INDEX['delay']].min() + by >= 0 else -by
        sets[which, INDEX['delay']] += by
    else:
        term = 'coulomb_friction' if kind == 'friction' else 'backlash'
        by = float(rng.uniform(*SIZE))
        if rng.random() < 0.5 and sets[which, INDEX[term]].min() > by:
            by = -by
        sets[which, INDEX[term]] += by
    return sets, {(name, None)}


def drawn(residual: np.ndarray, size: int, way: str, rng: np.random.Generator) -> np.ndarray:
    """Noise (J, N) from a residual (J, N): unchanged, circularly shifted, or in blocks of size."""
    if way == 'unchanged':
        return residual
    if way == 'shifted':
        return np.array([np.roll(row, rng.integers(len(row))) for row in residual])
    count = residual.shape[1]
    starts = rng.integers(count - size, size=(len(residual), -(-count // size)))
    return np.array([np.concatenate([row[s:s + size] for s in own])[:count]
                     for row, own in zip(residual, starts, strict=True)])


def made_log(log: JointLog, before: np.ndarray, after: np.ndarray, way: str, rng) -> JointLog:
    """Log of servos ``after`` with commands, rows and residual to ``before`` of a real log."""
    joints, fresh = np.arange(len(log.joints)), np.flatnonzero(log.fresh)
    residual = (log.measured - simulate(log, joints, before))[:, fresh]
    size = round(BLOCK / float(np.median(np.diff(log.read_t[fresh]))))
    read = simulate(log, joints, after)[:, fresh] + drawn(residual, size, way, rng)
    last = np.maximum(np.cumsum(log.fresh) - 1, 0)      # rows between readings repeat the last
    return JointLog('made.csv', log.t, log.joints, (np.round(read / COUNT) * COUNT)[:, last],
                    log.command)


def judged(log: JointLog, sets: np.ndarray, robot: RobotParameters) -> dict:
    """Verdict and effects of a log against parameter sets of gimbal1 to gimbal4."""
    apart = identify([log], robot)
    with patch.object(servo_compare, 'file_sets', return_value=sets), \
            patch.object(servo_compare, 'own_delay', return_value=0.0):
        return gap_of(compare(log, robot), apart, robot)


def scored(made: dict, wanted: set) -> dict:
    """Named entries of the expected ones (alone or in a set), and other named entries."""
    named = [{(name, effect.get('joint')) for name in effect['names']}
             for effect in [*made['effects'], *made['partial']]]
    found = {w for w in wanted if any(w in names for names in named)}
    return {'named': found == wanted and not made['partial'],
            'alone': all({w} in named for w in wanted) and not made['partial'],
            'wrong': [sorted(map(str, names)) for names in named if not names & wanted],
            'verdict': made['verdict']}


def run(logs: Sequence[JointLog], cases: int, seed: int, console: Console) -> list[dict]:
    """Results of ``cases`` artificial logs."""
    robot, rows = RobotParameters.load(), []
    sets = {log.name: identify([log], robot).values() for log in logs}
    for k in range(cases):
        rng = np.random.default_rng([seed, k])
        kind, log = list(KINDS)[k % len(KINDS)], logs[k // len(KINDS) % len(logs)]
        before = sets[log.name]
        after, wanted = changed(before, log, kind, rng)
        words = ', '.join(f'{NAMES[p]} of joint {log.joints[j]} {after[j, p] - before[j, p]:+.3g}'
                          for j, p in np.argwhere(after != before))
        begin, way = time.process_time(), WAYS[rng.integers(3)]
        made = judged(made_log(log, before, after, way, rng), before, robot)
        row = {'kind': kind, **scored(made, wanted), 'seconds': time.process_time() - begin}
        rows.append(row)
        effects = [[e['names'], e.get('joint')] for e in [*made['effects'], *made['partial']]]
        mark = '' if row['named'] and not row['wrong'] else '  <-'
        console.print(f"{k} {log.name} {kind} {words} ({way}): {row['verdict']} "
                      f'{effects}{mark}',
                      highlight=False, markup=False, soft_wrap=True)
    return rows


def table(made: list[dict], seed: int) -> Table:
    """Counts by kind of change."""
    shown = Table('change', 'logs', 'named', 'alone', 'wrong names', 'no gap', 'unknown', 'CPU s',
                  title=f'Joint logs, seed {seed}')
    for kind in [*KINDS, None]:
        rows = [row for row in made if kind in (row['kind'], None)
                and (kind or row['kind'] != 'nothing')]
        if rows:
            shown.add_row(kind or 'all changes', *(str(x) for x in (
                len(rows), sum(r['named'] for r in rows) if kind != 'nothing' else '',
                sum(r['alone'] for r in rows) if kind != 'nothing' else '',
                sum(bool(r['wrong']) for r in rows), sum(r['verdict'] == 'no_gap' for r in rows),
                sum(r['verdict'] == 'unknown' for r in rows),
                f"{np.mean([r['seconds'] for r in rows]):.1f}")))
    return shown


def main() -> None:
    """Run as a script; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--logs', type=Path, nargs='+', default=sorted(DATA.glob('joint_*.csv')),
                        help='real joint logs')
    parser.add_argument('--cases', type=int, default=24, help='made logs')
    parser.add_argument('--seed', type=int, default=0)
    given = parser.parse_args()
    if not given.logs:
        parser.error(f'{DATA}: no joint_*.csv; name logs with --logs')
    console = Console()
    made = run([read_joint_log(path) for path in given.logs], given.cases, given.seed, console)
    console.print(table(made, given.seed))


if __name__ == '__main__':
    main()
