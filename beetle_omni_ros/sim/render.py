"""
Pictures of the robot without a display; nothing that simulates imports this module.

Needs an off-screen OpenGL: on a machine without a display set MUJOCO_GL=egl (Debian and
Ubuntu: package libegl1 with Mesa's drivers).
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.figure import Figure
from beetle_omni_ros.sim.parameters import PlantParameters, SimulatorParameters

SAMPLES = 8             # for smooth edges


@dataclass(frozen=True)
class Pose:
    """
    One robot in a picture.

    Attributes:
        position: (3,) of base_link in world [m].
        quaternion: (4,) xyzw.
        tilt: (4,) [rad].
        thrust: (4,) [N] drawn as arrows, or None.
        opacity: 1 solid, less for a ghost.

    """

    position: np.ndarray
    quaternion: np.ndarray
    tilt: np.ndarray
    thrust: np.ndarray | None = None
    opacity: float = 1.0


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from: it looks at a point [m] from a distance [m], angles deg."""

    lookat: tuple[float, float, float] = (0.1, 0.2, 0.62)
    distance: float = 3.85
    azimuth: float = 112.0
    elevation: float = -17.0
    field_of_view: float = 30.0


def render(robot: RobotParameters, poses: list[Pose], camera: Camera | None = None,
           width: int = 1600, height: int = 900, trail: np.ndarray | None = None,
           plant: PlantParameters | None = None) -> np.ndarray:
    """
    One picture with the robot in every pose.

    Args:
        robot: its dimensions.
        poses: solid ones and ghosts, for example the samples of a flight.
        camera: the viewpoint.
        width: [pixels].
        height: [pixels].
        trail: (N, 3) points of a path to mark [m], or None.
        plant: sizes of feet and propellers; default: params/simulator.yaml.

    Returns:
        (height, width, 3) uint8.

    Raises:
        RuntimeError: there is no off-screen OpenGL here; the text says what to install.

    """
    camera = camera or Camera()
    figure = Figure(robot, plant or SimulatorParameters.load().plant)
    bodies = ''.join(figure.body(pose.position, pose.quaternion, pose.tilt, pose.thrust,
                                 pose.opacity) for pose in poses)
    if trail is not None:
        bodies += ''.join(figure.mark(point) for point in trail)
    model = mujoco.MjModel.from_xml_string(_scene(bodies, camera, width, height))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view = mujoco.MjvCamera()
    view.lookat[:] = camera.lookat
    view.distance, view.azimuth, view.elevation = camera.distance, camera.azimuth, camera.elevation
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:
        # Each OpenGL back end fails in its own way, with exceptions of its own.
        raise RuntimeError('no off-screen OpenGL: set MUJOCO_GL=egl and install libegl1 with '
                           f"Mesa's drivers ({type(error).__name__}: {error})") from error
    try:
        renderer.update_scene(data, view)
        return renderer.render()
    finally:
        renderer.close()


def _scene(bodies, camera, width, height):
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <visual>
    <global offwidth="{width}" offheight="{height}" fovy="{camera.field_of_view}"/>
    <quality offsamples="{SAMPLES}" shadowsize="8192" numslices="64" numstacks="32"/>
    <headlight ambient="0.42 0.43 0.45" diffuse="0.22 0.22 0.24" specular="0.1 0.1 0.1"/>
    <map znear="0.05" zfar="40" fogstart="5" fogend="16" haze="0.4"/>
    <rgba fog="0.90 0.93 0.96 1" haze="0.90 0.93 0.96 1"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.90 0.93 0.96" rgb2="0.62 0.74 0.88"
             width="512" height="512"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1="0.80 0.83 0.86"
             rgb2="0.74 0.77 0.81" mark="edge" markrgb="0.66 0.70 0.75" width="512" height="512"/>
    <material name="floor" texture="tiles" texrepeat="2 2" texuniform="true"
              specular="0.2" shininess="0.3"/>
    <material name="gloss" specular="0.6" shininess="0.6"/>
    <material name="glow" specular="0.1" shininess="0.1" emission="0.35"/>
  </asset>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <light pos="-0.6 -0.8 6" dir="0.1 0.12 -1" directional="true" castshadow="true"
           diffuse="0.50 0.48 0.45" specular="0.35 0.35 0.35"/>
    <light pos="3 -2 4" dir="-0.6 0.4 -0.7" directional="true" castshadow="false"
           diffuse="0.16 0.18 0.22" specular="0.1 0.1 0.1"/>
    <geom type="plane" size="0 0 1" material="floor"/>
    {bodies}
  </worldbody>
</mujoco>"""
