"""Which off-screen OpenGL this computer has."""

from __future__ import annotations

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
    Find an OpenGL that draws without a window, and select it for MuJoCo.

    MuJoCo reads MUJOCO_GL once, when it is imported, so each candidate is tried in a process of
    its own. A value that is set already is the only candidate.

    Returns:
        the back end.

    Raises:
        ParameterError: none works; the text says what to install.

    """
    given = os.environ.get('MUJOCO_GL')
    for backend in (given,) if given else BACKENDS:
        if _works(backend):
            os.environ['MUJOCO_GL'] = backend
            return backend
    raise ParameterError(
        (f'MUJOCO_GL={given} draws nothing here; unset it, or ' if given else
         'no off-screen OpenGL here: ')
        + 'install libegl1, libgl1-mesa-dri and libopengl0 (apt), or libosmesa6')


def _works(backend):
    try:
        return subprocess.run(
            [sys.executable, '-c', PROBE], env={**os.environ, 'MUJOCO_GL': backend},
            capture_output=True, timeout=TIMEOUT).returncode == 0
    except subprocess.TimeoutExpired:
        return False
