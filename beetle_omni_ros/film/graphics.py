"""Selection of an off-screen OpenGL back end."""

import os
import subprocess
import sys

from beetle_omni_ros.robot.schema import ParameterError

BACKENDS = ('egl', 'osmesa', 'glfw')
PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco/>')
mujoco.Renderer(model, 16, 16).render()
"""
TIMEOUT = 60.0          # [s] of one probe


def choose_backend() -> str:
    """
    Find an OpenGL back end that draws without a window, and select it by MUJOCO_GL.

    MuJoCo reads MUJOCO_GL only when it is imported, so each candidate is tried in a new process.
    A value that is already set is the only candidate.

    Raises:
        ParameterError: no back end works; the message has the packages to install.

    """
    given = os.environ.get('MUJOCO_GL')
    for backend in (given,) if given else BACKENDS:
        if _works(backend):
            os.environ['MUJOCO_GL'] = backend
            return backend
    raise ParameterError(
        (f'MUJOCO_GL={given} does not work here; unset it, or ' if given else
         'no off-screen OpenGL here: ')
        + 'install libegl1, libgl1-mesa-dri and libopengl0 (apt), or libosmesa6')


def _works(backend):
    try:
        return subprocess.run(
            [sys.executable, '-c', PROBE], env={**os.environ, 'MUJOCO_GL': backend},
            capture_output=True, timeout=TIMEOUT).returncode == 0
    except subprocess.TimeoutExpired:
        return False
