"""One case on disk: bags and the robot file that the workflow is told; its label elsewhere."""

from dataclasses import asdict
import json
import os
from pathlib import Path
import shutil
import tempfile

import numpy as np
import yaml

from gap_data.bags import write_bag
from gap_data.cases import Case
from gap_data.effects import CATALOGUE, inject
from gap_data.flight import fly
from gap_data.hidden import Hidden
from gap_data.sensors import measure
from gap_data.truth import Robot

ROBOT_FILE = Path(__file__).parents[2] / 'params' / 'robot.yaml'
EPOCH = 1_780_000_000  # [s] a wall clock


def build(case: Case) -> tuple[Robot, Hidden, list[dict]]:
    """The true robot of a case, its hidden effects, and the label of each; always the same."""
    rng = np.random.default_rng([case.seed, 1])
    robot, hidden = Robot(), Hidden()
    if case.tolerance:
        robot.within_tolerance(rng)
    labels = []
    for name, size, shape in case.effects:
        found = inject(name, robot, hidden, size, shape, rng)
        place = {key: found.pop(key) for key in ('rotor', 'joint') if key in found}
        labels.append({'name': name, 'size': size, 'shape': shape, **place,
                       'in_catalogue': name in CATALOGUE, 'parameters': found})
    return robot, hidden, labels


def make_case(case: Case, folder: Path, sealed: Path) -> Path:
    """
    Make a case's flights if they are not there yet.

    Args:
        case: which.
        folder: parent of all cases' folders; this one's is named by the case's key.
        sealed: folder of the labels.

    Returns:
        The case's folder: ``fit_1``, ``fit_2``, ``holdout_1`` and ``robot.yaml``.

    """
    target, label = folder / case.key(), sealed / f'{case.key()}.json'
    if target.is_dir() and label.is_file():
        (target / 'robot.yaml').write_text(_told(case))
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
        (work / 'robot.yaml').write_text(_told(case))
        write_json(label, {'case': asdict(case), 'effects': effects})
        shutil.rmtree(target, ignore_errors=True)
        os.replace(work, target)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return target


def _make_flight(case, k, path):
    robot, hidden, _ = build(case)
    rng = np.random.default_rng([case.seed, 2, k])
    truth = fly(robot, hidden, kind=case.course, duration=case.duration,
                seed=int(rng.integers(2 ** 31)), multibody=case.multibody, gust=case.gust,
                conditions=case.conditions)
    noise = {key: case.noise * value
             for key, value in robot.numbers['sensors'][case.conditions].items()}
    shape = next((s for name, _, s in case.effects if name == 'imu_filter_lag'), 'plain')
    recording = measure(truth, hidden, robot.numbers, rng, noise=noise, shape=shape)
    write_bag(path, recording, epoch=EPOCH + 1000 * k + int(rng.uniform(0, 900)))


def _told(case):
    text = ROBOT_FILE.read_text()
    if any(name == 'module_reaction' for name, _, _ in case.effects):
        content = yaml.safe_load(text)
        content.pop('multibody', None)      # described, it would hide nothing
        return yaml.safe_dump(content, sort_keys=False)
    return text


def write_json(path: Path, content: dict) -> None:
    """Write a file that is there as a whole or not at all."""
    partial = path.with_name(f'{path.name}.{os.getpid()}')
    partial.write_text(json.dumps(content, indent=1))
    os.replace(partial, path)
