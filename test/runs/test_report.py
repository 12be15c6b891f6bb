"""The page about flights that nobody gave a target, or that broke off early."""

import io

import numpy as np
import pytest
from rich.console import Console

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.runs.bag import BagWriter
from beetle_omni_ros.runs.report import run_report

LEVEL = np.array([0, 0, 0, 1.0])


def record(folder, *, task, body='truth', targets=0):
    """An intact bag of 4 s at rest, with ``targets`` poses in it."""
    with BagWriter(folder, {'task': task, 'seed': 0}) as writer:
        for k in range(80):
            t = 10 + 0.05 * k
            write = writer.write_truth if body == 'truth' else writer.write_odom
            write(t, np.zeros(3), LEVEL, np.zeros(3), np.zeros(3))
            writer.write_state(t, 'flying:nmpc')
        for k in range(targets):
            writer.write_target(PoseTarget(position=np.array([0, 0, 1.0]), quaternion=LEVEL,
                                           stamp=10.5 + k))
    return folder


@pytest.mark.parametrize('targets', [0, 1])
@pytest.mark.parametrize('task', ['waypoints', 'lemniscate', 'payload', 'force', 'hover', ''])
def test_a_bag_without_targets_gives_a_page(tmp_path, task, targets):
    bag = record(tmp_path / 'bag', task=task, targets=targets)
    page = tmp_path / 'page.html'
    results = run_report([bag], page, console=Console(file=io.StringIO()))
    assert results['meta']['seed'] == 0
    text = page.read_text()
    assert str(bag) in text and '>Pose<' in text and ('>Errors<' in text) == bool(targets)


def test_flights_with_and_without_targets_stand_on_one_page(tmp_path):
    bags = [record(tmp_path / 'none', task='hover', body='odom'),
            record(tmp_path / 'one', task='hover', targets=2)]
    run_report(bags, tmp_path / 'page.html', console=Console(file=io.StringIO()))
    assert (tmp_path / 'page.html').stat().st_size > 10_000
