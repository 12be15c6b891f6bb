"""Pictures are optional, and correct if graphics are available."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from sim_robots import ROBOT

from beetle_omni_ros.sim.render import Look, scene

DRAW = """
import numpy as np
from beetle_omni_ros.sim.render import Camera, Look, Pose, Stage, Trail
level, tilt = np.array([0, 0, 0, 1.0]), np.zeros(4)
camera = Camera(lookat=(0, 0, 0.8), distance=2.0)
pose = Pose(np.array([0, 0, 0.8]), level, tilt, np.full(4, 7.0))
path = Trail(np.array([[-0.4, 0, 0.5], [0.4, 0, 0.5]]), (1, 0, 0))
with Stage([Look(), Look(0.3, (0, 0, 1))], 160, 90) as stage:
    empty = stage.draw([None, None], camera)
    drawn = stage.draw([pose, None], camera)
    ghost = stage.draw([None, pose], camera)
    again = stage.draw([None, None], camera, [path])
assert drawn.shape == (90, 160, 3) and drawn.dtype == np.uint8
def changed(picture, limit=40):
    return np.abs(picture.astype(int) - empty).max(axis=2) > limit
assert 0.02 < changed(drawn)[20:70, 40:120].mean() < 0.9
assert ((drawn[..., 0] > 120) & (drawn[..., 1] < 90)).sum() > 5
assert 20 < changed(ghost).sum() < changed(drawn).sum()
assert changed(ghost)[75:].sum() == 0 < changed(again).sum() < 400
"""


def test_the_drawn_rotors_have_the_positions_of_the_robot():
    model = mujoco.MjModel.from_xml_string(scene([Look()], 30.0, 160, 90))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rotors = [data.body(f'rotor{k}_0').xpos for k in (1, 2, 3, 4)]
    np.testing.assert_allclose(rotors, ROBOT.rotors.positions, atol=1e-6)


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
