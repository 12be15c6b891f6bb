"""Pictures are optional, and right where graphics exist."""

import os
import subprocess
import sys

import numpy as np
import pytest
from sim_robots import LEVEL, ROBOT, WORLD

from beetle_omni_ros.sim.figure import Figure

DRAW = """
import numpy as np
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.render import Camera, Pose, render
robot = RobotParameters.load()
level, tilt = np.array([0, 0, 0, 1.0]), np.zeros(4)
camera = Camera(lookat=(0, 0, 0.8), distance=2.0)
poses = [Pose(np.array([0, 0, 0.8]), level, tilt, np.full(4, 7.0))]
empty = render(robot, [], camera, 160, 90)
drawn = render(robot, poses, camera, 160, 90, trail=np.zeros((2, 3)))
assert drawn.shape == (90, 160, 3) and drawn.dtype == np.uint8
changed = np.abs(drawn.astype(int) - empty).max(axis=2) > 40
assert 0.02 < changed[20:70, 40:120].mean() < 0.9, changed.mean()
red = (drawn[..., 0] > 120) & (drawn[..., 1] < 90)
assert red.sum() > 5
"""


def test_figure_has_its_rotors_where_the_robot_has_them():
    mujoco = pytest.importorskip('mujoco')
    text = Figure(ROBOT, WORLD.plant).body(np.zeros(3), LEVEL, np.zeros(4))
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><asset><material name="gloss"/><material name="glow"/>'
        f'</asset><worldbody>{text}</worldbody></mujoco>')
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    discs = data.geom_xpos[(model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER)
                           & (model.geom_size[:, 0] == WORLD.plant.propeller_radius)]
    np.testing.assert_allclose(discs[:, :2], ROBOT.rotors.positions[:, :2], atol=1e-6)


def test_simulating_loads_no_graphics():
    code = ('import sys; import beetle_omni_ros.sim.simulator; '
            "assert 'beetle_omni_ros.sim.render' not in sys.modules; "
            'from beetle_omni_ros.robot.parameters import RobotParameters; '
            'beetle_omni_ros.sim.simulator.Simulator(RobotParameters.load()).step()')
    subprocess.run([sys.executable, '-c', code], check=True, timeout=60,
                   env={**os.environ, 'MUJOCO_GL': 'disabled'})


def test_robot_is_in_the_picture():
    done = subprocess.run([sys.executable, '-c', DRAW], capture_output=True, text=True,
                          timeout=120, env={**os.environ, 'MUJOCO_GL': 'egl'})
    if 'no off-screen OpenGL' in done.stderr or 'EGL' in done.stderr:
        pytest.skip('no EGL on this machine')
    assert done.returncode == 0, done.stderr
