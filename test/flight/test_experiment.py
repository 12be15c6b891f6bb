"""Manoeuvres of the next flight: composed to a task, and their margins."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_flights import targets_of

from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.experiment import Experiments, MANOEUVRES, set_points, START
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()


@pytest.mark.parametrize('name', MANOEUVRES)
def test_a_manoeuvre_moves_and_begins_and_ends_at_rest(name):
    times, poses = set_points([name], 0.005)
    rates = np.gradient(poses, times, axis=0)
    assert np.abs(poses - START).max() > 0.01
    for k in (0, -1):
        assert poses[k] == pytest.approx(START, abs=1e-6)
        assert rates[k] == pytest.approx(np.zeros(6), abs=1e-3)


def test_a_written_task_is_the_motion_of_its_manoeuvres_within_60_s(tmp_path):
    file, names = tmp_path / 'next.yaml', ['roll 180 deg', 'passes along x', 'yaw chirp'] * 2
    Experiments.write(file, names[:Experiments.most], 'A comment.')
    task = make_task(str(file))
    times, poses = set_points(names, 0.02)
    target = targets_of(task, 0.0)[-1]
    assert task.duration == pytest.approx(8.0 + 8.0 * len(names)) and task.duration <= 60.0
    assert np.abs(target.positions - poses[:, :3]).max() < 0.002
    assert file.read_text().startswith('# A comment.')


@pytest.fixture(scope='module')
def flown():
    names = ('climbs', 'roll 90 deg')
    return names, Experiments(ROBOT).flown(names)


def test_a_flight_keeps_its_margins_and_a_weaker_robot_loses_them_where_thrust_is_largest(flown):
    names, log = flown
    assert Experiments(ROBOT).why_unsafe(names, log) == {}
    begins = log.begin + 8.0 + 8.0 * np.arange(2)
    most = [log.command.thrust[log.command.window(t, t + 8.0)].max() for t in begins]
    weak = replace(ROBOT, rotors=replace(ROBOT.rotors, thrust_max=float(np.mean(most)) / 0.9))
    found = Experiments(weak).why_unsafe(names, log)
    assert found == {names[int(np.argmax(most))]: 'thrust'}


def test_a_manoeuvre_beyond_the_range_of_the_joints_or_away_from_its_target_is_found(flown):
    names, log = flown
    tight = replace(ROBOT, joints=replace(ROBOT.joints, position_limit=1.0))
    assert Experiments(tight).why_unsafe(names, log) == {'roll 90 deg': 'range of the joints'}
    others = ('passes along x', 'roll 90 deg')
    assert Experiments(ROBOT).why_unsafe(others, log) == {
        'passes along x': 'distance from the target'}
