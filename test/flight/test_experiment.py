"""Random poses of the next flight: as tasks in files, and their margins."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_flights import targets_of

from beetle_omni_ros.control.tasks import make_task, poses_task
from beetle_omni_ros.flight import experiment
from beetle_omni_ros.flight.experiment import Experiments
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
POSES = np.array([[0.5, -0.5, 1.2, 90.0, 0.0, 30.0], [-0.5, 0.5, 0.8, 0.0, 0.0, -60.0]])


def test_a_written_task_of_poses_is_flown_for_56_s(tmp_path):
    file, poses = tmp_path / 'next.yaml', Experiments.poses(3, level=False)
    Experiments.write(file, poses, False, 'A comment.\nAnother one.')
    task = make_task(str(file))
    assert (task.kind, task.duration) == ('poses', 56.0)
    assert np.array_equal(task.poses, poses)
    assert (np.abs(poses[:, 3:]).max(axis=0) > 45).all()
    assert not np.array_equal(poses, Experiments.poses(4, level=False))
    assert file.read_text().startswith('# A comment.\n# Another one.\n')


def test_a_written_task_of_level_poses_is_the_expected_motion_from_rest_to_rest(tmp_path):
    file, poses = tmp_path / 'next.yaml', Experiments.poses(3, level=True)
    Experiments.write(file, poses, True, 'A comment.')
    task = make_task(str(file))
    position, yaw = Experiments.level_motion(poses, 0.02)
    target = targets_of(task, 0.0)[-1]
    assert task.duration == pytest.approx(56.0)
    assert np.abs(target.positions - position[400:]).max() < 0.002      # after 8 s
    assert position[0, 2] == 0 and np.ptp(position[200:401], axis=0) == pytest.approx(0)
    for values in (position, yaw):
        assert np.abs(np.diff(values, axis=0)[[0, 400, 480, -1]]).max() < 1e-4


@pytest.fixture(scope='module')
def log():
    return Experiments(ROBOT).flown(POSES, ROBOT)


def test_a_flight_keeps_its_margins_unless_the_robot_is_too_weak_to_hold_a_pose(log):
    task = poses_task('own', POSES)
    assert Experiments(ROBOT).is_safe(log, task)
    held = max(log.command.thrust[log.command.window(t, t + 1.0)].max()
               for t in log.begin + np.array([7.0, 15.0]))
    for share, safe in ((0.88, True), (0.92, False)):
        weak = replace(ROBOT, rotors=replace(ROBOT.rotors, thrust_max=float(held) / share))
        assert Experiments(weak).is_safe(log, task) is safe


def test_a_missed_pose_and_a_low_flight_are_found(log, monkeypatch):
    own, other = Experiments(ROBOT), poses_task('own', POSES + [0.3, 0, 0, 0, 0, 0])
    assert not own.is_safe(replace(log, targets=targets_of(other, log.begin)), other)
    monkeypatch.setattr(experiment, 'LEAST_HEIGHT', 0.9)
    assert not own.is_safe(log, poses_task('own', POSES))


def test_a_plant_that_cannot_hold_a_pose_has_no_flight():
    heavy = replace(ROBOT, mass=2.2 * ROBOT.mass)
    assert Experiments(ROBOT).flown(POSES[:1], heavy) is None
