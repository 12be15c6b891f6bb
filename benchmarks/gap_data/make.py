"""One case on disk: bags and the robot file that the workflow is told; its label elsewhere."""

from __future__ import annotations

from dataclasses import asdict
import json
import os
from pathlib import Path
import shutil
import tempfile

import numpy as np
import yaml

from gap_data.bags import DAMAGES, write_bag
from gap_data.cases import Case
from gap_data.courses import Course
from gap_data.effects import CATALOGUE, inject
from gap_data.flight import COLUMNS, fly, Truth
from gap_data.hidden import Hidden
from gap_data.sensors import measure
from gap_data.truth import load_numbers, Robot

ROBOT_FILE = Path(__file__).parents[2] / 'params' / 'robot.yaml'
EPOCH = 1.78e9  # [s] a wall clock


def build(case: Case, numbers: dict | None = None) -> tuple[Robot, Hidden, list[dict]]:
    """The true robot of a case, its hidden effects, and the label of each; always the same."""
    rng = np.random.default_rng([case.seed, 1])
    robot, hidden = Robot.nominal(numbers or load_numbers()), Hidden()
    if case.tolerance:
        robot.within_tolerance(rng)
    labels = []
    for name, size, shape in case.effects:
        found = inject(name, robot, hidden, size, shape, rng)
        place = {key: found.pop(key) for key in ('rotor', 'joint') if key in found}
        labels.append({'name': name, 'size': size, 'shape': shape, **place,
                       'in_catalogue': name in CATALOGUE, 'parameters': found})
    return robot, hidden, labels


def make_case(case: Case, folder: Path, sealed: Path, robot_file: Path = ROBOT_FILE) -> Path:
    """
    Make a case's flights if they are not there yet.

    Args:
        case: which.
        folder: parent of all cases' folders; this one's is named by the case's key.
        sealed: folder of the labels.
        robot_file: what the workflow is told.

    Returns:
        The case's folder: ``fit_1``, ``fit_2``, ``holdout_1`` and ``robot.yaml``.

    """
    target, label = folder / case.key(), sealed / f'{case.key()}.json'
    if target.is_dir() and label.is_file():
        if (target / 'robot.yaml').read_text() != _told(robot_file, case):
            (target / 'robot.yaml').write_text(_told(robot_file, case))
        return target
    for place in (folder, sealed):
        place.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix='.', dir=folder))
    try:
        _, _, effects = build(case)
        names = [f'fit_{k + 1}' for k in range(case.fit)]
        names += [f'holdout_{k + 1}' for k in range(case.holdout)]
        for k, name in enumerate(names):
            _make_flight(case, k, work / name)
        (work / 'robot.yaml').write_text(_told(robot_file, case))
        _write(label, {'case': asdict(case), 'effects': effects})
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(work, target)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return target


def _make_flight(case, k, path):
    numbers = load_numbers()
    robot, hidden, _ = build(case, numbers)
    rng = np.random.default_rng([case.seed, 2, k])
    if case.course == 'rest':
        truth = _resting(case.duration, numbers)
    else:
        truth = fly(robot, hidden, kind=case.course, duration=case.duration,
                    seed=int(rng.integers(2 ** 31)), multibody=case.multibody, gust=case.gust,
                    conditions=case.conditions, command_age=case.command_age)
    noise = {key: case.noise * value
             for key, value in numbers['sensors'][case.conditions].items()}
    shape = next((s for name, _, s in case.effects if name == 'imu_filter_lag'), 'plain')
    recording = measure(truth, hidden, numbers, rng, noise=noise, shape=shape)
    damage = case.damage if case.damage in DAMAGES else None
    write_bag(path, recording, epoch=EPOCH + 1000.0 * k + float(rng.uniform(0, 900)),
              damage=damage, rng=rng)


def _resting(duration, numbers):
    """A robot on a stand, rotors off."""
    t = np.arange(int(round(duration / numbers['step']))) * numbers['step']
    columns = {name: np.zeros((len(t), size)) for name, size in COLUMNS.items()}
    columns['quaternion'][:, 0] = 1.0
    columns['position'][:, 2] = 0.16
    columns['specific_force'][:, 2] = numbers['robot']['gravity']
    columns['voltage'][:] = 24.8
    stamps = np.arange(0, duration, 0.01)
    zeros = np.zeros((len(stamps), 4))
    still = np.zeros((1, 3))
    course = Course(still, still, still, np.eye(3)[None], still, [])
    return Truth(t, columns, stamps, zeros, zeros, course)


def _told(robot_file, case):
    text = Path(robot_file).read_text()
    if case.damage == 'broken_robot':
        return '\n'.join(line for line in text.splitlines() if not line.startswith('mass:')) + '\n'
    if any(name == 'module_reaction' for name, _, _ in case.effects):
        content = yaml.safe_load(text)
        content.pop('multibody', None)      # described, it would hide nothing
        return yaml.safe_dump(content, sort_keys=False)
    return text


def _write(path, content):
    partial = path.with_name(path.name + '.part')
    partial.write_text(json.dumps(content, indent=1))
    os.replace(partial, path)
