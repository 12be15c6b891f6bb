"""Examples run by their documented commands, and the public functions work."""

from importlib.util import find_spec
import json
from pathlib import Path
import pydoc
import re
import runpy
import subprocess
import sys

from flown_once import flight
import numpy as np
import pytest

import beetle_omni_ros
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.model.schema import ParameterError

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / 'examples'
POSES = 'x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n0.5,0,1.2,60,0,30\n'


@pytest.fixture(scope='module')
def poses(tmp_path_factory):
    """A pose file of one pose."""
    path = tmp_path_factory.mktemp('examples') / 'poses.csv'
    path.write_text(POSES)
    return path


@pytest.fixture
def run(monkeypatch, capsys):
    """Run an example in this process, which has loaded the modules; return what it prints."""
    def example(name, *arguments):
        path = str(EXAMPLES / name)
        monkeypatch.setattr(sys, 'argv', [path, *map(str, arguments)])
        runpy.run_path(path, run_name='__main__')
        return capsys.readouterr().out

    return example


def test_an_own_controller_flies_beside_the_nmpc(run, poses):
    printed = run('own_controller.py', poses)
    assert re.search(r'poses reached +1 of 1 +1 of 1', printed)
    assert 'pose_controller' in printed


def test_an_own_trajectory_is_followed_by_both_controllers(run):
    printed = run('own_trajectory.py', 2)
    errors = dict(re.findall(r'^(nmpc|rl): ([\d.]+) mm', printed, re.MULTILINE))
    assert {'nmpc', 'rl'} == set(errors) and max(map(float, errors.values())) < 100
    assert 'Trajectory tracking' in printed and 'poses reached' not in printed


def test_an_own_robot_flies_with_known_and_unknown_parameters(run, poses):
    printed = run('own_robot.py', poses)
    assert printed.startswith('3.4 kg') and 'unknown robot' in printed


def test_a_flight_can_be_stepped_by_the_caller():
    loop = beetle_omni_ros.simulation('hover')
    loop.aim(PoseTarget(np.array([0.2, 0.0, 1.2]), np.array([0, 0, 0, 1.0])))
    end = loop.simulator.time + 4.0
    while loop.simulator.time < end:
        loop.step()
    assert np.linalg.norm(loop.simulator.truth.position - [0.2, 0.0, 1.2]) < 0.05
    log = loop.recording()
    assert log.states[-1].controller == 'hover' and len(log.command.t) > 400


def test_a_bag_becomes_arrays(run):
    printed = run('read_bag.py', flight('windy_0'))
    assert 'IMU samples' in printed and 'hover asked for' in printed
    median, last, end = map(float, re.search(
        r'to the target: ([\d.]+) mm median, ([\d.]+) mm at ([\d.]+) s', printed).groups())
    assert 0 < median < 1000 and 0 < last < 100 and 1 < end < 100     # not seconds since 1970
    assert 'warning' not in printed


def test_the_cells_of_the_notebook_run_in_order_and_none_has_a_stored_output():
    cells = [cell for cell in json.loads((EXAMPLES / 'notebook.ipynb').read_text())['cells']
             if cell['cell_type'] == 'code']
    assert not any(cell['outputs'] or cell['execution_count'] for cell in cells)
    names = {}
    for cell in cells:
        code = ''.join(cell['source'])
        if find_spec('pandas') or 'to_pandas' not in code:
            exec(code, names)
    assert names['log'].metrics()['success_rate'] == 1.0
    assert names['again'].metrics()['mean'] == pytest.approx(names['log'].metrics()['mean'])


def test_the_public_names_are_there_and_import_nothing_heavy():
    assert set(beetle_omni_ros.__all__) >= {'robot', 'simulate', 'evaluate', 'read_run',
                                            'find_gap'}
    shown = pydoc.render_doc(beetle_omni_ros, renderer=pydoc.plaintext)
    assert all(f'\n    {name}(' in shown for name in beetle_omni_ros.__all__)
    assert all(getattr(beetle_omni_ros, name).__doc__ for name in beetle_omni_ros.__all__)
    code = ('import sys, beetle_omni_ros; '
            'sys.exit(any(m in sys.modules for m in ("numpy", "casadi", "mujoco", "rich")))')
    assert subprocess.run([sys.executable, '-c', code], env={'PYTHONPATH': str(ROOT)},
                          check=False).returncode == 0


class Still:
    """Constant tilts and nearly constant hover thrusts; a constant command would be refused."""

    period = 0.01

    def __init__(self, robot):
        self.thrust = robot.hover_thrust

    def reset(self):
        pass

    def step(self, state, target):
        return Command(state.stamp, np.zeros(4), np.full(4, self.thrust - state.velocity[2]))


def test_a_class_flies_under_its_own_name_and_may_be_defined_again():
    log = beetle_omni_ros.simulate(Still, [[0, 0, 1, 0, 0, 0]])
    assert log.meta['controller'] == 'still' and 'still' in log.requests
    again = type('Still', (Still,), {})
    assert beetle_omni_ros.evaluate(again, [[0, 0, 1, 0, 0, 0]], quiet=True)['still']['poses']
    assert registry.find('still').controller is again
    with pytest.raises(ParameterError, match="'nmpc' is no usable name"):
        beetle_omni_ros.simulate(type('X', (Still,), {'name': 'nmpc'}))


def test_tasks_of_wrong_shape_are_refused():
    with pytest.raises(ParameterError, match=r'\(N, 6\)'):
        beetle_omni_ros.simulate('hover', [[0, 0, 1]])
    with pytest.raises(ParameterError, match='at least 3'):
        beetle_omni_ros.trajectory([0, 1], np.zeros((2, 3)), np.ones((2, 4)))


def test_velocities_of_a_trajectory_are_those_of_its_motion():
    times = np.arange(0, 2.001, 0.01)
    angle = 0.7 * times
    task = beetle_omni_ros.trajectory(
        times, np.column_stack([np.sin(angle), np.cos(angle), 1 + 0 * angle]),
        np.column_stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)]))
    target = task.segments[1].target(5.0)
    middle = target.at(6.0)
    assert np.allclose(middle.velocity, [0.7 * np.cos(0.7), -0.7 * np.sin(0.7), 0], atol=1e-4)
    assert np.allclose(middle.angular_velocity, [0, 0, 0.7], atol=1e-6)
    assert task.duration == pytest.approx(10.0)
