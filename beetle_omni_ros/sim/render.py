"""
Pictures of robots without a display; the simulation does not use this module.

It needs an off-screen OpenGL, which the variable MUJOCO_GL selects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from beetle_omni_ros.robot.parameters import ROTOR_NAMES
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.urdf import Joint, Link, Model, Visual

SAMPLES = 4                     # samples per pixel, for smooth edges
JOINTS = 15                     # generalised positions of one robot
SPIN = 47.0, -47.0, 47.0, -47.0 # [rad/s] drawn; true propellers would flicker
THRUST = (0.02, 0.66, 0.42)
THRUST_SCALE = 0.030            # [m/N] length of an arrow
SHAFT, TRAIL_WIDTH = 0.011, 0.009
MOST_GEOMS = 4000
# MuJoCo's sizes are half edges and half lengths.
HALF = {'box': (0.5, 0.5, 0.5), 'cylinder': (1.0, 0.5), 'sphere': (1.0,)}
HAZE, FLOOR = (0.93, 0.95, 0.97), (0.73, 0.77, 0.82)


@dataclass(frozen=True)
class Look:
    """Appearance of a robot."""

    opacity: float = 1.0                                # less than 1 for a ghost
    tint: tuple[float, float, float] | None = None      # by default the colours of its parts


@dataclass(frozen=True)
class Pose:
    """One robot in a picture."""

    position: np.ndarray                # (3,) of base_link in world [m]
    quaternion: np.ndarray              # (4,) base_link to world, xyzw
    tilt: np.ndarray                    # (4,) [rad]
    thrust: np.ndarray | None = None    # (4,) drawn as arrows [N]
    time: float = 0.0                   # of the angles of the propellers [s]


@dataclass(frozen=True)
class Camera:
    """A camera that looks at a point [m] from a distance [m] along two angles [deg]."""

    lookat: tuple[float, float, float] = (0.1, 0.2, 0.62)
    distance: float = 3.85
    azimuth: float = 112.0
    elevation: float = -17.0


@dataclass(frozen=True)
class Trail:
    """A path: (N, 3) points [m] and a colour, which fades towards the start."""

    points: np.ndarray
    colour: tuple[float, float, float]


class Stage:
    """
    Draws pictures of the robot of the shipped URDF over a floor.

    Args:
        looks: appearance of each robot, in the order of the poses.
        width, height: size of a picture [pixels].
        field_of_view: vertical field of view [deg].

    Raises:
        ParameterError: no off-screen OpenGL.

    """

    def __init__(self, looks: Sequence[Look], width: int, height: int,
                 field_of_view: float = 30.0):
        self._model = mujoco.MjModel.from_xml_string(scene(looks, field_of_view, width, height))
        self._data = mujoco.MjData(self._model)
        self._rotors = [[self._model.body(f'{name}_{k}').id for name in ROTOR_NAMES]
                        for k in range(len(looks))]
        ghosts = {self._model.body(f'base_link_{k}').id for k, look in enumerate(looks)
                  if look.opacity < 1}
        self._ghostly = {geom for geom, body in enumerate(self._model.geom_bodyid)
                         if self._model.body_rootid[body] in ghosts}
        try:
            self._renderer = mujoco.Renderer(self._model, height, width, MOST_GEOMS)
        except Exception as error:
            # The OpenGL back ends raise exceptions of different types.
            raise ParameterError(f'no off-screen OpenGL ({type(error).__name__}: {error}); '
                                 'install libegl1, libgl1-mesa-dri and libopengl0 (apt)') from None

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *exception) -> None:
        self._renderer.close()

    def draw(self, poses: Sequence[Pose | None], camera: Camera,
             trails: Sequence[Trail] = ()) -> np.ndarray:
        """
        Draw one picture, (height, width, 3) uint8.

        A pose of None hides a robot.
        """
        for k, pose in enumerate(poses):
            self._data.qpos[JOINTS * k:JOINTS * (k + 1)] = self._joints(pose)
        mujoco.mj_forward(self._model, self._data)
        view = mujoco.MjvCamera()
        view.lookat[:] = camera.lookat
        view.distance, view.azimuth = camera.distance, camera.azimuth
        view.elevation = camera.elevation
        self._renderer.update_scene(self._data, view)
        for geom in self._renderer.scene.geoms[:self._renderer.scene.ngeom]:
            if geom.objid in self._ghostly and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR    # which casts no shadow
        for trail in trails:
            self._path(trail)
        for rotors, pose in zip(self._rotors, poses, strict=True):
            if pose is not None and pose.thrust is not None:
                for rotor, thrust in zip(rotors, pose.thrust, strict=True):
                    self._arrow(rotor, thrust)
        return self._renderer.render()

    def _joints(self, pose):
        if pose is None:
            return np.concatenate([[0, 0, -9, 1], np.zeros(JOINTS - 4)])
        x, y, z, w = pose.quaternion
        turns = np.array(SPIN) * pose.time
        return np.concatenate([pose.position, [w, x, y, z],
                               np.stack([pose.tilt, turns], axis=1).ravel()])

    def _arrow(self, rotor, thrust):
        turn, hub = self._data.xmat[rotor].reshape(3, 3), self._data.xpos[rotor]
        self._connect(mujoco.mjtGeom.mjGEOM_ARROW, SHAFT, hub + 0.02 * turn[:, 2],
                      hub + (0.03 + THRUST_SCALE * thrust) * turn[:, 2], (*THRUST, 0.9))

    def _path(self, trail):
        share = np.linspace(0.0, 0.9, len(trail.points))[:, None]
        colours = share * np.array(trail.colour) + (1 - share) * np.array(FLOOR)
        for start, end, colour in zip(trail.points, trail.points[1:], colours):
            self._connect(mujoco.mjtGeom.mjGEOM_CAPSULE, TRAIL_WIDTH, start, end, (*colour, 1.0))

    def _connect(self, kind, width, start, end, colour):
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom or not np.linalg.norm(end - start) > 1e-9:
            return
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9),
                            np.array(colour, dtype=np.float32))
        mujoco.mjv_connector(geom, kind, width, np.asarray(start, float), np.asarray(end, float))
        geom.emission, geom.specular = 0.1, 0.1
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        scene.ngeom += 1


def scene(looks: Sequence[Look], field_of_view: float, width: int, height: int) -> str:
    """
    MJCF of floor and robots.

    Generalised positions of each robot: pose of base_link (7), then for each arm the tilt and the
    angle of the propeller (8).
    """
    model = Model.load()
    meshes = ''.join(f'<mesh name="{path.stem}" file="{path}" inertia="shell"/>\n' for path in {
        visual.file for link in model.links.values() for visual in link.visuals if visual.file})
    bodies = ''.join(_body(model, link, k, look) for k, look in enumerate(looks)
                     for link in model.links.values() if link.joint is None)
    haze, floor = (' '.join(map(str, colour)) for colour in (HAZE, FLOOR))
    return f"""
<mujoco>
  <statistic center="0 0 0.5" extent="4"/>
  <compiler angle="radian" inertiafromgeom="false"/>
  <visual>
    <global offwidth="{width}" offheight="{height}" fovy="{field_of_view}"/>
    <quality offsamples="{SAMPLES}" shadowsize="2048" numslices="20" numstacks="10"/>
    <headlight ambient="0.42 0.43 0.45" diffuse="0.22 0.22 0.24" specular="0.1 0.1 0.1"/>
    <map znear="0.05" zfar="40" fogstart="6" fogend="13" haze="0.4"/>
    <rgba fog="{haze} 1" haze="{haze} 1"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="flat" rgb1="{haze}" rgb2="{haze}"
             width="512" height="512"/>
    <texture name="tiles" type="2d" builtin="flat" rgb1="{floor}" rgb2="{floor}"
             mark="edge" markrgb="0.50 0.56 0.63" width="512" height="512"/>
    <material name="floor" texture="tiles" texrepeat="2 2" texuniform="true"
              specular="0.1" shininess="0.1"/>
    <material name="gloss" specular="0.6" shininess="0.6"/>
    {meshes}
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


def _body(model: Model, link: Link, k: int, look: Look) -> str:
    """MJCF of a link of robot ``k`` with all links that it carries."""
    joint = link.joint
    if joint is None:
        place, hinge = '', '<freejoint/>'
    else:
        place = _place(joint)
        axis = (0, 0, 1) if link.name in ROTOR_NAMES else joint.axis
        hinge = '' if axis is None else f'<joint axis="{_numbers(axis)}"/>'
    shapes = ''.join(_geom(visual, look) for visual in link.visuals)
    carried = ''.join(_body(model, other, k, look) for other in model.links.values()
                      if other.joint is not None and other.joint.parent == link.name)
    # MuJoCo requires mass of a moving body.
    return (f'<body name="{link.name}_{k}" {place}>{hinge}<inertial pos="0 0 0" mass="0.01" '
            f'diaginertia="1e-5 1e-5 1e-5"/>{shapes}{carried}</body>\n')


def _place(placed: Joint | Visual) -> str:
    return (f'pos="{_numbers(placed.position)}" '
            f'quat="{_numbers(placed.quaternion[[3, 0, 1, 2]])}"')


def _geom(visual: Visual, look: Look) -> str:
    shape = f'mesh="{visual.file.stem}"' if visual.file else \
        f'size="{_numbers(visual.size * np.array(HALF[visual.shape]))}"'
    *colour, opacity = visual.colour
    return (f'<geom type="{visual.shape}" {shape} {_place(visual)} material="gloss" '
            f'rgba="{_numbers((*(look.tint or colour), opacity * look.opacity))}"/>')


def _numbers(values):
    return ' '.join(f'{x:.6g}' for x in np.ravel(values))
