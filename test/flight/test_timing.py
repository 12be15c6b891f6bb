"""`beetle_omni check --timing` measures cycles by the clock and fails on a computer too slow."""

import json
import time

import numpy as np
import pytest

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.tasks import Segment, Task
from beetle_omni_ros.drivers.check import run_check
from beetle_omni_ros.flight import timing


class Slow(HoverController):
    """Ends after its period."""

    def step(self, state, target):
        time.sleep(1.2 * self.period)
        return super().step(state, target)


@pytest.mark.real_time
def test_a_controller_that_ends_after_its_period_fails_the_check(tmp_path, monkeypatch):
    pose = PoseTarget(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    task = Task('short', 'poses', (Segment(1.0, lambda start: pose),), np.zeros((1, 6)))
    monkeypatch.setattr(timing, 'make_task', lambda name: task)
    names, file = ('hover', registry.add(Slow).name), tmp_path / 'timing.json'
    assert run_check(listen=None, json_path=file, measure=lambda robot: timing.check_timing(
        robot, names)) == 1
    found = {row['item']: row for row in json.loads(file.read_text())['findings']}
    hover, slow = (found[f'{name}, 100 Hz']['values'] for name in names)
    assert hover['cycles'] == slow['cycles'] > 90 and hover['median_s'] < 0.01
    assert found['slow, 100 Hz']['level'] == 'fail' and slow['missed'] == slow['cycles']
    assert 0.012 <= slow['median_s'] <= slow['p99_s'] and 'estimator beside hover, 200 Hz' in found
