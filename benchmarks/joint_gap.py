"""
Detection of servo changes by `beetle_omni gap LOG.csv`, and false detections.

`python benchmarks/joint_gap.py --cases 60 --seed 1 --json joint_gap.json`. The real log is
compared with the shipped robot file, which is then corrected. Each case is an artificial log: a
simulation of the corrected servos with one change, plus the residual of the real log, rounded to
encoder counts. The residual is used unchanged, circularly shifted, or in blocks of a second drawn
at random. The log is compared with the corrected file.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
import json
from pathlib import Path
import sys
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.identify.gap.apply import effects_with
from beetle_omni_ros.identify.gap.joint_gap import gap_of
from beetle_omni_ros.identify.gap.joint_search import Search
from beetle_omni_ros.identify.joint import identify_joints
from beetle_omni_ros.identify.servo.log import JointLog, read_joint_log
from beetle_omni_ros.identify.joint_results import joint_results
from beetle_omni_ros.identify.joint_servos import file_sets
from beetle_omni_ros.identify.servo.model import simulate
from beetle_omni_ros.robot.parameters import RobotParameters

LOG = Path(__file__).resolve().parents[2] / 'shared' / 'data' / 'joint_response_100Hz.csv'
COUNT = 2 * np.pi / 4096    # [rad] of the encoder
BLOCK = 1.0                 # [s] of a drawn block of the residual
KINDS = ('nothing', 'one zero', 'two zeros', 'gains', 'delay', 'friction')


def judged(log: JointLog, robot: RobotParameters) -> dict:
    """Verdict and effects of a log, without the page."""
    apart = joint_results(log, [], identify_joints(log, robot.joints), robot.joints)['joints']
    return gap_of(Search(log, robot).run(), log, apart)


def corrected(robot: RobotParameters, made: dict) -> RobotParameters:
    """Robot as written by `--apply`."""
    return replace(robot, effects={
        name: {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
        for name, values in effects_with(robot, made['effects']).items()})


def changed(robot: RobotParameters, kind: str, rng: np.random.Generator):
    """(robot with a change, set of (name, joint or None) that must be named, description)."""
    effects = {name: dict(values) for name, values in robot.effects.items()}

    def sized(low, high):
        return float(rng.uniform(low, high) * rng.choice([-1, 1]))

    if kind == 'nothing':
        return robot, set(), ''
    if kind in ('one zero', 'two zeros'):
        joints = rng.permutation(4)[:1 if kind == 'one zero' else 2]
        zeros = [0.0] * 4
        for j in joints:
            zeros[j] = sized(0.010, 0.020)
        effects['joint_offset'] = {'offset': tuple(zeros)}
        words = ', '.join(f'{1e3 * z:+.1f}' for z in zeros) + ' mrad'
        return replace(robot, effects=effects), {('joint_offset', int(j) + 1)
                                                 for j in joints}, words
    if kind == 'gains':
        which = ['kp', 'kd', 'both', 'both with friction'][rng.integers(4)]
        factor = 1 + sized(0.2, 0.4)
        for gain in ('kp', 'kd'):
            if which.startswith('both') or which == gain:
                effects['joint_bandwidth'][gain] *= factor
        if which.endswith('friction'):      # constant dead band instead of constant torque
            _scale(effects, np.full(4, factor))
        return replace(robot, effects=effects), {('joint_bandwidth', None)}, \
            f'{which} x {factor:.2f}'
    if kind == 'delay':
        delay = effects['joint_command_latency']
        change = sized(0.008, 0.020)
        change = change if delay['delay'] + change >= 0 else -change
        delay['delay'] += change
        return replace(robot, effects=effects), {('joint_command_latency', None)}, \
            f'{1e3 * change:+.1f} ms'
    factor = float(rng.choice([rng.uniform(1.5, 2.5), rng.uniform(0.3, 0.6)]))
    mine = np.ones(4)
    mine[slice(None) if rng.random() < 0.7 else rng.integers(4)] = factor
    _scale(effects, mine)
    return replace(robot, effects=effects), {('joint_friction', None)}, \
        f'x {np.array2string(mine, precision=2)}'


def _scale(effects, factors):
    effects['joint_friction'] = {key: tuple(float(v) for v in np.broadcast_to(value, 4) * factors)
                                 for key, value in effects['joint_friction'].items()}


def drawn(residual: np.ndarray, period: float, rng: np.random.Generator) -> np.ndarray:
    """Noise (J, N) from a residual (J, N) [rad]: unchanged, circularly shifted, or in blocks."""
    way, size = rng.integers(3), round(BLOCK / period)
    if way == 0:
        return residual
    if way == 1:
        return np.array([np.roll(row, rng.integers(len(row))) for row in residual])
    count = residual.shape[1]
    starts = rng.integers(count - size, size=(len(residual), -(-count // size)))
    return np.array([np.concatenate([row[s:s + size] for s in own])[:count]
                     for row, own in zip(residual, starts, strict=True)])


def made_log(log: JointLog, robot: RobotParameters, residual, rng) -> JointLog:
    """Log of a robot's servos with the commands of a real one."""
    joints = np.arange(len(log.joints))
    positions = simulate(log, joints, file_sets(robot, log.joints)) \
        + drawn(residual, log.period, rng)
    return JointLog('made.csv', log.t, log.joints, np.round(positions / COUNT) * COUNT,
                    log.command)


def scored(made: dict, wanted: set) -> dict:
    """Named entries of the expected ones (alone or in a set), and other named entries."""
    named = [({(name, effect.get('joint')) for name in effect['names']}) for effect in
             made['effects']]
    found = {w for w in wanted if any(w in names for names in named)}
    alone = {w for w in wanted if {w} in named}
    wrong = [sorted(names) for names in named if not names & wanted]
    return {'found': found == wanted, 'alone': alone == wanted, 'wrong': wrong,
            'verdict': made['verdict']}


def run(log: JointLog, cases: int, seed: int, console: Console) -> dict:
    """Results of the real log, its own correction, and ``cases`` artificial logs of each kind."""
    shipped = RobotParameters.load()
    first = judged(log, shipped)
    robot = corrected(shipped, first)
    second = judged(log, robot)
    residual = log.measured - simulate(log, np.arange(len(log.joints)),
                                       file_sets(robot, log.joints))
    rows = []
    for k in range(cases):
        rng = np.random.default_rng([seed, k])
        kind = KINDS[k % len(KINDS)]
        truth, wanted, words = changed(robot, kind, rng)
        begin = time.process_time()
        made = judged(made_log(log, truth, residual, rng), robot)
        row = {'kind': kind, 'case': k, 'change': words, **scored(made, wanted),
               'named': [[e['names'], e.get('joint')] for e in made['effects']],
               'seconds': time.process_time() - begin}
        rows.append(row)
        mark = '' if row['found'] and not row['wrong'] else '  <-'
        console.print(f"{k} {kind} {words}: {row['verdict']} {row['named']}{mark}",
                      highlight=False, markup=False, soft_wrap=True)
    return {'seed': seed, 'real': {
        'verdict': first['verdict'], 'names': [e['names'] for e in first['effects']],
        'reason': first['reason'], 'verdict_corrected': second['verdict'],
        'reason_corrected': second['reason']}, 'cases': rows}


def table(made: dict) -> Table:
    """Counts by kind of change."""
    shown = Table('change', 'logs', 'named', 'alone', 'nothing else', 'no gap', 'CPU s',
                  title=f"Joint logs, seed {made['seed']}")
    for kind in KINDS:
        rows = [row for row in made['cases'] if row['kind'] == kind]
        if rows:
            shown.add_row(kind, *(str(x) for x in (
                len(rows), sum(r['found'] for r in rows), sum(r['alone'] for r in rows),
                sum(not r['wrong'] for r in rows), sum(r['verdict'] == 'no_gap' for r in rows),
                f"{np.mean([r['seconds'] for r in rows]):.1f}")))
    return shown


def main() -> int:
    """Run as a script; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--log', type=Path, default=LOG, help='real joint log')
    parser.add_argument('--cases', type=int, default=30, help='made logs')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--json', type=Path, help='file for the results')
    given = parser.parse_args()
    if not given.log.is_file():
        print(f'{given.log}: no such log; name one with --log', file=sys.stderr)
        return 2
    console = Console()
    made = run(read_joint_log(given.log), given.cases, given.seed, console)
    console.print(f"real log: {made['real']['verdict']} {made['real']['names']}, "
                  f"{made['real']['reason']}; with its own correction "
                  f"{made['real']['verdict_corrected']}", highlight=False, markup=False)
    console.print(table(made))
    if given.json:
        given.json.write_text(json.dumps(made, indent=1))
    return 0


if __name__ == '__main__':
    sys.exit(main())
