"""One robot in the 3D scene: links, joints, rotors, and arrows of forces and torques."""

from functools import lru_cache

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters, ROTOR_NAMES
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.urdf import Model, Visual
from beetle_omni_ros.view.frames import COLUMNS, known, pose

NEWTON_PER_METRE = 40.0         # thrust that is drawn as one metre
TORQUE_RADIUS = 0.07            # [m] of the arcs of torques
TORQUE_HEIGHT = 0.03            # [m] of an arc above its rotor
RADIAN_PER_NEWTON_METRE = 12.0  # angle of the arc
LONGEST_ARC = 5.8               # [rad]
SEGMENTS = 16                   # lines of an arc, without the two of its tip
TIP = 0.025                     # [m]
WORLD_NEWTON_PER_METRE = 40.0   # external force that is drawn as one metre
Colour = tuple[int, int, int]
THRUST, TORQUE, FORCE = (240, 140, 30), (120, 90, 220), (210, 40, 60)
STL_HEADER = 80         # bytes of a binary STL file before the number of triangles
TRIANGLE = np.dtype([('normal', '<f4', 3), ('corners', '<f4', (3, 3)), ('attribute', '<u2')])
BLADE = (40, 40, 46)
BLADE_WIDTH, BLADE_HEIGHT = 0.14, 1.3   # of a disc's radius and height
SIDES = 24
EYE_RATE = 9.0      # [rad/s] highest drawn rotor speed; the real speed would flicker


def rotor_frames(robot: RobotParameters, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Compute the frames of the rotors at tilt angles (4,) [rad].

    Returns:
        (4, 3) centres [m] and (4, 3, 3) axes as columns, x outward along the arm, z along the
        thrust.

    """
    axes = np.empty((4, 3, 3))
    for k, outward in enumerate(robot.tilt_axes):
        turned = rotations.matrix(rotations.exp(outward * tilt[k]))
        axes[k] = turned @ np.column_stack([outward, np.cross([0, 0, 1], outward), [0, 0, 1]])
    return robot.rotors.positions, axes


def thrust_arrows(robot: RobotParameters, tilt: np.ndarray, thrust: np.ndarray) -> np.ndarray:
    """
    Return begin and end of each rotor's thrust arrow, (4, 2, 3) in base_link [m].

    ``tilt`` (4,) is in rad, ``thrust`` (4,) in N; NaN: no arrow.
    """
    centres, axes = rotor_frames(robot, tilt)
    length = np.nan_to_num(thrust) / NEWTON_PER_METRE
    return np.stack([centres, centres + length[:, None] * axes[:, :, 2]], axis=1)


def torque_arcs(robot: RobotParameters, tilt: np.ndarray, thrust: np.ndarray) -> np.ndarray:
    """
    Compute arcs for the reaction torque of each rotor on the body, -spin ratio f about its axis.

    The angle of an arc is proportional to the torque and has its direction. ``tilt`` (4,) is in
    rad, ``thrust`` (4,) in N; NaN: no arc.

    Returns:
        (4 * (SEGMENTS + 2), 2, 3) lines in base_link [m].

    """
    centres, axes = rotor_frames(robot, tilt)
    rotors = robot.rotors
    torque = -rotors.spin * rotors.torque_to_thrust_ratio * np.nan_to_num(thrust)
    swept = np.clip(torque * RADIAN_PER_NEWTON_METRE, -LONGEST_ARC, LONGEST_ARC)
    lines = [_arc(angle) @ frame.T + centre
             for angle, frame, centre in zip(swept, axes, centres, strict=True)]
    return np.concatenate(lines)


def _arc(swept):
    """Lines of an arc with a tip about z, in a rotor's frame."""
    angle = np.linspace(0, swept, SEGMENTS + 1)
    points = np.stack([TORQUE_RADIUS * np.cos(angle), TORQUE_RADIUS * np.sin(angle),
                       np.full_like(angle, TORQUE_HEIGHT)], axis=1)
    end, along = points[-1], np.array([-np.sin(swept), np.cos(swept), 0.0]) * np.sign(swept)
    outward = np.array([np.cos(swept), np.sin(swept), 0.0])
    size = min(TIP, TORQUE_RADIUS * abs(swept))
    wings = [end - size * along + side * 0.6 * size * outward for side in (1, -1)]
    return np.concatenate([np.stack([points[:-1], points[1:]], axis=1),
                           [[end, wing] for wing in wings]])


def wxyz(quaternion: np.ndarray) -> np.ndarray:
    """Return a quaternion in the order of the viewer."""
    return np.roll(quaternion, 1)


class RobotDrawing:
    """
    A robot in the scene.

    Args:
        scene: scene of the viser server.
        name: name of its node in the scene.
        model: links and shapes.
        robot: robot parameters, for the positions of forces.
        tint: colour and opacity of a transparent robot; None: colours of the model, with arrows.

    """

    def __init__(self, scene, name: str, model: Model, robot: RobotParameters,
                 tint: tuple[Colour, float] | None = None):
        self._robot, self._model = robot, model
        self._root = scene.add_frame(name, show_axes=False, visible=False)
        self._joints, self._rotors, paths = [], {}, {}
        for link in model.links.values():
            above, position = (name, np.zeros(3)) if link.joint is None else (
                paths[link.joint.parent], link.joint.position)
            path = paths[link.name] = f'{above}/{link.name}'
            node = scene.add_frame(path, show_axes=False, wxyz=wxyz(link.turned()),
                                   position=position)
            if link.moves:
                self._joints.append((link, node))
            if link.name in ROTOR_NAMES:
                self._rotors[ROTOR_NAMES.index(link.name)] = (link, node)
            for k, visual in enumerate(link.visuals):
                _add(scene, f'{path}/visual{k}', visual, tint)
                if link.name in ROTOR_NAMES and visual.shape == 'cylinder':
                    _add_blades(scene, f'{path}/blades{k}', visual, tint)
        self._turned = np.zeros(len(ROTOR_NAMES))
        self._arrows = self._arcs = None
        if tint is None:
            self._arrows = scene.add_arrows(
                f'{name}/thrust', np.zeros((4, 2, 3)), THRUST, shaft_radius=0.008,
                head_radius=0.02, head_length=0.04)
            self._arcs = scene.add_line_segments(
                f'{name}/torque', torque_arcs(robot, np.zeros(4), np.zeros(4)), TORQUE,
                thickness=0.007)
        self._forces = True

    def show_forces(self, wanted: bool) -> None:
        """Show or hide the arrows."""
        self._forces = wanted
        for drawn in (self._arrows, self._arcs):
            if drawn is not None:
                drawn.visible = wanted

    def hide(self) -> None:
        """Hide the robot."""
        self._root.visible = False

    def show(self, row: np.ndarray, prefix: str = '', passed: float = 0.0) -> None:
        """
        Draw the robot at a pose of the row, see :func:`~beetle_omni_ros.view.frames.pose`.

        ``passed`` is the time since the previous row, for the rotation of the rotors [s].
        """
        placed = pose(row, prefix)
        self._root.visible = placed is not None
        if placed is None:
            return
        self._root.position, self._root.wxyz = placed[0], wxyz(placed[1])
        tilt = np.nan_to_num(row[COLUMNS['tilt']])
        angles = dict(zip(JOINT_NAMES, tilt, strict=True))
        for link, node in self._joints:
            node.wxyz = wxyz(link.turned(angles.get(link.moves, 0.0)))
        thrust = known(row, 'thrust')
        if thrust is None:
            thrust = np.zeros(len(ROTOR_NAMES))
        if passed:
            self._spin(thrust, passed)
        if self._arrows is not None and self._forces:
            self._points = thrust_arrows(self._robot, tilt, thrust)
            self._arcs.points = torque_arcs(self._robot, tilt, thrust)

    def _spin(self, thrust, passed):
        """Turn the rotors at a speed proportional to the square root of their thrust."""
        rotors = self._robot.rotors
        self._turned += rotors.spin * EYE_RATE * passed * np.sqrt(
            np.clip(thrust / rotors.thrust_max, 0, 1))
        for k, (link, node) in self._rotors.items():
            half = self._turned[k] / 2
            turn = np.array([0, 0, np.sin(half), np.cos(half)])
            node.wxyz = wxyz(rotations.multiply(link.turned(), turn))


def _add(scene, name, visual, tint):
    place = {'position': visual.position, 'wxyz': wxyz(visual.quaternion)}
    *colour, opacity = visual.colour
    look = {'color': tuple(round(255 * part) for part in colour),
            'opacity': opacity if opacity < 1 else None}
    if tint is not None:
        look = {'color': tint[0], 'opacity': tint[1] * opacity}
    # Transparent shapes cast no shadow.
    look['cast_shadow'] = look['opacity'] is None
    if visual.shape == 'box':
        scene.add_box(name, dimensions=visual.size, **look, **place)
    elif visual.shape == 'cylinder':
        radius, height = visual.size
        scene.add_cylinder(name, radius, height, radial_segments=SIDES, **look, **place)
    elif visual.shape == 'sphere':
        scene.add_icosphere(name, visual.size[0], subdivisions=2, **look, **place)
    else:
        vertices, faces = _mesh(visual.file)
        scene.add_mesh_simple(name, vertices, faces, scale=visual.size, flat_shading=True, **look,
                              **place)


def _add_blades(scene, name, disc: Visual, tint):
    """Add a propeller to a rotor disc, so that its rotation is visible."""
    radius, height = disc.size
    colour, opacity = tint or (BLADE, None)
    scene.add_box(name, dimensions=(1.96 * radius, BLADE_WIDTH * radius, BLADE_HEIGHT * height),
                  color=colour, opacity=opacity, position=disc.position,
                  wxyz=wxyz(disc.quaternion), cast_shadow=tint is None)


@lru_cache
def _mesh(file):
    """(N, 3) vertices and (M, 3) indices of triangles."""
    try:
        data = file.read_bytes()
        count = int.from_bytes(data[STL_HEADER:STL_HEADER + 4], 'little')
        if len(data) == STL_HEADER + 4 + count * TRIANGLE.itemsize:
            corners = np.frombuffer(data, TRIANGLE, offset=STL_HEADER + 4)['corners']
            vertices, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
            return vertices, faces.reshape(-1, 3)
        import trimesh  # for all but binary STL: its import alone takes 0.6 s
        mesh = trimesh.load_mesh(file)
        if not len(mesh.faces):
            raise ValueError('no triangles')
        return mesh.vertices, mesh.faces
    except Exception as error:      # a missing or broken file raises anything in the library
        raise ParameterError(f'{file}: not a usable mesh: {error}') from None
