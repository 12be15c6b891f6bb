"""What a picture of a flight shows, and the robot in a scene of viser, live or recorded."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import rich
import viser

from beetle_omni_ros.bags.log import FlightLog, geodesic_angles, hold, motion
from beetle_omni_ros.control.base import Target
from beetle_omni_ros.model.parameters import JOINT_NAMES, ROTOR_NAMES
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.model.urdf import links
from beetle_omni_ros.show.figures import COLOURS

NEWTON_PER_METRE = 40.0     # force that is drawn as one metre
THRUST, FORCE = (240, 140, 30), (210, 40, 60)
GHOST_OPACITY = 0.35
SKY = 4.0               # brightness of the ambient light, in place of slow reflections
FLOOR, HORIZON = 80.0, 30.0     # [m] width, with a line at each metre; distance where it fades
TARGET_AXES = 0.28      # [m]
# Of the camera from the robot [m], and its vertical angle [rad]: the robot fills a third.
VIEW_FROM, VIEW_ANGLE = np.array([-1.2, -1.95, 0.5]), np.radians(48)
WORLD = '/world'        # moves against the followed robot, so that the camera need not
SIDES = 24
LARGEST = 1e6           # [m, rad, N] of what is drawn; a damaged bag may have any number
Placed = tuple[np.ndarray, np.ndarray]      # position (3,) in world [m], quaternion (4,)


@dataclass
class Moment:
    """One robot at one time; its pose is the true one if it is known, else the estimate."""

    position: np.ndarray        # (3,) in world [m]
    quaternion: np.ndarray      # (4,) body to world
    tilt: np.ndarray = field(default_factory=lambda: np.zeros(4))       # measured [rad]
    thrust: np.ndarray = field(default_factory=lambda: np.zeros(4))     # commanded [N]
    force: np.ndarray = field(default_factory=lambda: np.zeros(3))      # external, in world [N]
    target: Placed | None = None
    state: str = ''             # of the supervisor

    def text(self) -> str:
        """Return state and errors as one line."""
        parts = [self.state] if self.state else []
        if self.target is not None:
            away = np.linalg.norm(self.position - self.target[0])
            angle, = geodesic_angles(self.quaternion[None], self.target[1])
            parts.append(f'{1e3 * away:.0f} mm, {np.degrees(angle):.1f}° off target')
        return ', '.join(parts)


def drawable(values: np.ndarray) -> np.ndarray:
    """Return values without NaN, within LARGEST."""
    return np.clip(np.nan_to_num(values), -LARGEST, LARGEST)


def target_at(targets: list[Target], t: float) -> Placed | None:
    """Return the pose of the latest target at ``t`` [s], or None before the first one."""
    k = bisect_right(targets, t + 1e-6, key=lambda target: target.stamp) - 1
    if k < 0:
        return None
    reference = targets[k].at(t)
    return reference.position, reference.quaternion


def moments(log: FlightLog, times: np.ndarray) -> list[Moment | None]:
    """Return what is shown at ``times`` (N,) [s] of the flight's clock; None without a pose."""
    body = motion(log)

    def held(t, values, width):
        return drawable(hold(t, values, times)) if len(t) else np.zeros((len(times), width))

    rows = zip(times, held(body.t, body.position, 3), held(body.t, body.quaternion, 4),
               held(*(log.joint.t, log.joint.position) if len(log.joint.t) else
                    (log.command.t, log.command.tilt), 4),
               held(log.command.t, log.command.thrust, 4), held(log.wrench.t, log.wrench.force, 3))
    made: list[Moment | None] = []
    for t, position, quaternion, tilt, thrust, force in rows:
        state = bisect_right(log.state_t, t) - 1
        known = body.t[0] - 1e-6 <= t <= body.t[-1] + 0.1
        made.append(Moment(position, quaternion, tilt, thrust, force, target_at(log.targets, t),
                           log.states[state] if state >= 0 else '') if known else None)
    return made


def wxyz(quaternion: np.ndarray) -> np.ndarray:
    """Return a quaternion in the order of viser."""
    return np.roll(quaternion, 1)


def serve(host: str, port: int, title: str = 'beetle_omni') -> viser.ViserServer:
    """Start a server at a port or the next free one; ParameterError: an unusable address."""
    rich.get_console().quiet = True     # of viser, which prints its addresses, also in a notebook
    try:
        server = viser.ViserServer(host, port, label=title, verbose=False)
    except (OSError, OverflowError, RuntimeError, UnicodeError) as error:
        raise ParameterError(f'--host {host} --port {port}: cannot be served there '
                             f'({error})') from None
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width='small')
    return server


def close(server: viser.ViserServer) -> None:
    """Stop a server without its message."""
    server.stop()
    rich.get_console().quiet = False


class Robot:
    """
    A robot in the scene, with its target.

    The robot with the ``number`` 0 has the colours of the model, the others are transparent.
    """

    def __init__(self, scene, number: int, colour: str):
        tint = _rgb(colour) if number else None
        name = f'{WORLD}/robot{number}'
        self._root = scene.add_frame(name, show_axes=False, visible=False)
        self._joints, self._arrows, paths = {}, {}, {}
        for link in links():
            path = paths[link.name] = f'{paths.get(link.parent, name)}/{link.name}'
            node = scene.add_frame(path, show_axes=False, wxyz=wxyz(link.quaternion),
                                   position=link.position)
            if link.joint in JOINT_NAMES:
                self._joints[link.joint] = (link, node)
            if link.name in ROTOR_NAMES:
                self._arrows[link.name] = scene.add_arrows(
                    f'{path}/thrust', np.zeros((1, 2, 3)), THRUST, shaft_radius=0.008,
                    head_radius=0.02, head_length=0.04)
            for k, (shape, colour) in enumerate(link.shapes):
                _add(scene, f'{path}/{k}', shape, colour, tint)
        self._target = scene.add_frame(f'{WORLD}/target{number}', axes_length=TARGET_AXES,
                                       axes_radius=0.008, origin_radius=0.018, visible=False)
        self._force = scene.add_arrows(f'{WORLD}/force{number}', np.zeros((1, 2, 3)), FORCE,
                                       shaft_radius=0.012, head_radius=0.03, head_length=0.06)

    def show(self, moment: Moment | None) -> None:
        """Draw the robot at one moment, or hide it."""
        self._root.visible = moment is not None
        self._target.visible = moment is not None and moment.target is not None
        if moment is None:
            return
        self._root.position, self._root.wxyz = moment.position, wxyz(moment.quaternion)
        for name, tilt, rotor, thrust in zip(JOINT_NAMES, moment.tilt, ROTOR_NAMES, moment.thrust):
            link, node = self._joints[name]
            node.wxyz = wxyz(link.turned(tilt))
            self._arrows[rotor].points = _arrow(np.zeros(3), [0.0, 0.0, thrust])
        if moment.target is not None:
            self._target.position, self._target.wxyz = moment.target[0], wxyz(moment.target[1])
        self._force.points = _arrow(moment.position, moment.force)


def _rgb(colour):
    return tuple(bytes.fromhex(colour[1:]))


def _arrow(begin, force):
    """An arrow (1, 2, 3) of a force (3,) [N]."""
    return np.array([[begin, begin + np.asarray(force) / NEWTON_PER_METRE]])


class Room:
    """Floor, light, camera, and robots of these colours."""

    def __init__(self, server: viser.ViserServer, colours: Sequence[str] = COLOURS[:1]):
        scene, camera = server.scene, server.initial_camera
        # Shadows and reflections would dominate the rendering time without a graphics card.
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient('/sky', intensity=SKY)
        self._world = scene.add_frame(WORLD, show_axes=False)
        scene.add_grid(f'{WORLD}/floor', FLOOR, FLOOR, cell_size=1.0, section_size=FLOOR,
                       fade_distance=HORIZON, shadow_opacity=0.0, cell_color=(150, 158, 166),
                       plane_color=(128, 134, 140), plane_opacity=0.25)
        self._scene, self._colours = scene, colours
        camera.look_at, camera.position, camera.fov = np.zeros(3), VIEW_FROM, VIEW_ANGLE
        self.robots = [Robot(scene, number, colour) for number, colour in enumerate(colours)]

    def show(self, moments: Sequence[Moment | None], follow: bool = True) -> None:
        """Draw all robots at one moment; ``follow`` the first of them that has a pose."""
        for robot, moment in zip(self.robots, moments, strict=True):
            robot.show(moment)
        if follow and (first := next(filter(None, moments), None)):
            self._world.position = -first.position

    def draw_path(self, number: int, positions: np.ndarray):
        """Draw the path (N, 3) [m] of a robot; returns its handle, whose ``points`` may change."""
        return self._scene.add_line_segments(
            f'{WORLD}/path{number}', segments(positions), _rgb(self._colours[number]),
            thickness=1.5, thickness_units='screen')


def segments(positions: np.ndarray) -> np.ndarray:
    """Return the lines (N - 1, 2, 3) between positions (N, 3) [m]."""
    return np.stack([positions[:-1], positions[1:]], axis=1)


def _add(scene, name, shape, colour, tint):
    """Add a shape of a link."""
    import trimesh  # takes 0.6 s
    *own, opacity = colour
    look = {'color': tint or tuple(round(255 * part) for part in own),
            'opacity': GHOST_OPACITY * opacity if tint else opacity if opacity < 1 else None}
    if isinstance(shape, tuple):
        scene.add_cylinder(name, *shape, radial_segments=SIDES, **look)
    else:
        mesh = trimesh.load_mesh(shape)
        scene.add_mesh_simple(name, mesh.vertices, mesh.faces, flat_shading=True, **look)
