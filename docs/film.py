"""Films of flights for docs/make_pictures.py. They need an off-screen OpenGL (MUJOCO_GL)."""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path

from matplotlib import font_manager
from matplotlib.colors import to_rgb
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from beetle_omni_ros.bags.log import FlightLog, geodesic_angles, hold, motion
from beetle_omni_ros.control.tasks import pose_target, Segment, Task, WAYPOINTS
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.dynamics import integrator
from beetle_omni_ros.model.parameters import JOINT_NAMES, RobotParameters
from beetle_omni_ros.model.urdf import links
from beetle_omni_ros.show.figures import FAINT, INK, line_of
from beetle_omni_ros.show.scene import target_at

os.environ.setdefault('MUJOCO_GL', 'egl')
LINKS = links()
FPS = 8.0
WIDTH, HEIGHT, CAPTION, CHART = 440, 400, 76, 84    # [px] of a panel, its text, the chart below
PAPER, FLOOR, RULE = (237, 242, 247), '0.79 0.83 0.88', '#cdd3db'
FIELD = 30.0                    # [deg] vertical field of view
AZIMUTH, ELEVATION, DISTANCE = 112.0, -28.0, 3.0    # [deg], [deg], [m] of the line of sight
SLOW = 0.6                      # [s] standard deviation of the filter that moves the camera
CENTRE = 0.80                   # of the robot's height, at which the camera looks
GHOST = 0.45                    # opacity
LEAST, MOST = 1e-3, 1.0         # [m] of the chart
TICKS = {1e-3: '1 mm', 1e-2: '1 cm', 1e-1: '10 cm', 1.0: '1 m'}
RESTART = 1.0                   # [s] after which a prediction restarts from the flown state
# Pose: x, y, z [m], roll, pitch, yaw [deg], and its duration [s].
LEGS = [(WAYPOINTS[0], 1.2), *((pose, 2.7) for pose in WAYPOINTS[1:]),
        (np.array([0.0, 0.0, 1.0, 180.0, 0.0, 90.0]), 4.0), (WAYPOINTS[0], 4.0)]


def task() -> Task:
    """Twenty seconds through the waypoints, upside down and back."""
    return Task('film', 'poses', tuple(
        Segment(duration, lambda start, pose=pose: pose_target(pose, start))
        for pose, duration in LEGS), np.array([pose for pose, _ in LEGS]))


@dataclass
class Panel:
    """One flight in F frames; ghosts are the targets, or what a model expects."""

    label: str
    colour: str
    position: np.ndarray    # (F, 3) in world [m]
    quaternion: np.ndarray  # (F, 4)
    tilt: np.ndarray        # (F, 4) [rad]
    ghost_position: np.ndarray
    ghost_quaternion: np.ndarray

    def errors(self) -> np.ndarray:
        """(F, 2) distance [m] and angle [deg] between robot and ghost."""
        return np.stack([np.linalg.norm(self.ghost_position - self.position, axis=1), np.degrees(
            geodesic_angles(self.ghost_quaternion, self.quaternion))], axis=1)


def panel(log: FlightLog, label: str = '', model: RobotParameters | None = None,
          colour: str = '') -> Panel:
    """Panel of a flight from its first target on, with its targets or a model's prediction."""
    times, body = np.arange(log.begin, log.end, 1 / FPS), motion(log)
    if model is None:
        rows = [target_at(log.targets, t) for t in times]
        ghost = [np.array([row[k] for row in rows]) for k in range(2)]
    else:
        ghost = [hold(body.t, values, times) for values in predicted(log, model)]
    name, = log.controllers()
    return Panel(label or name, colour or line_of(name)[0], hold(body.t, body.position, times),
                 hold(body.t, body.quaternion, times),
                 hold(log.joint.t, log.joint.position, times), *ghost)


def predicted(log: FlightLog, model: RobotParameters) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) and quaternions (N, 4) that a model expects at the true poses' times."""
    body, advance = motion(log), integrator(model)
    commands = np.hstack([hold(log.command.t, values, body.t)
                          for values in (log.command.tilt, log.command.thrust)])
    state, begin = np.zeros(25), body.t[0]
    state[21:] = commands[0, 4:]
    made = np.zeros((len(body.t), 7))
    for k, t in enumerate(body.t):
        if k == 0 or (t - log.begin) % RESTART < (begin - log.begin) % RESTART:
            state[:13] = np.concatenate([body.position[k], body.velocity[k], body.quaternion[k],
                                         body.angular_velocity[k]])
        begin, made[k] = t, state[[0, 1, 2, 6, 7, 8, 9]]
        if k + 1 < len(body.t):
            state = advance(state, commands[k], 0, body.t[k + 1] - t).full().ravel()
    return made[:, :3], made[:, 3:]


def write(file: Path, panels: list[Panel]) -> None:
    """Draw panels side by side as a GIF with one palette, so that the background is still."""
    frames = list(_frames(panels))
    palette = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames[::10]])
                              ).quantize(48, kmeans=1)
    first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE)
                    for frame in frames)
    first.save(file, save_all=True, append_images=rest, loop=0, duration=round(1000 / FPS))


def _scene(colour):
    """MJCF of floor, light, robot and ghost."""
    meshes = {shape for link in LINKS for shape, _ in link.shapes if isinstance(shape, Path)}
    assets = ''.join(f'<mesh name="{mesh.stem}" file="{mesh}" inertia="shell"/>'
                     for mesh in meshes)
    robots = _robot('', None) + _robot('ghost_', colour)
    return f"""<mujoco><compiler angle="radian"/>
<visual><global offwidth="{WIDTH}" offheight="{HEIGHT}" fovy="{FIELD}"/>
<quality offsamples="4" shadowsize="2048"/>
<headlight ambient=".45 .45 .47" diffuse=".25 .25 .27" specular=".1 .1 .1"/>
<map znear=".05" zfar="40"/></visual><statistic extent="4"/>
<asset><texture type="skybox" builtin="flat" rgb1=".93 .95 .97" rgb2=".93 .95 .97" width="64"
height="64"/><texture name="tiles" type="2d" builtin="flat" rgb1="{FLOOR}" rgb2="{FLOOR}"
mark="edge" markrgb=".58 .63 .7" width="512" height="512"/>
<material name="floor" texture="tiles" texrepeat="2 2" texuniform="true"
specular="0"/>{assets}</asset>
<default><geom contype="0" conaffinity="0" mass=".01"/></default>
<worldbody><light pos="0 0 6" dir="0 .45 -1" type="directional" diffuse=".5 .48 .45"/>
<geom type="plane" size="0 0 1" material="floor"/>{robots}</worldbody></mujoco>"""


def _robot(prefix, tint):
    """MJCF of a robot; its bodies follow from poses that `_pose` sets."""
    made = ''
    for link in LINKS:
        shapes = ''
        for shape, colour in link.shapes:
            rgba = (*to_rgb(tint), GHOST * colour[3]) if tint else colour
            form = f'type="mesh" mesh="{shape.stem}"' if isinstance(shape, Path) else \
                f'type="cylinder" size="{shape[0]} {shape[1] / 2}"'
            shapes += f'<geom {form} rgba="{" ".join(map(str, rgba))}"/>'
        made += f'<body name="{prefix}{link.name}" mocap="true">{shapes}</body>'
    return made


def _pose(model, data, prefix, position, quaternion, tilt):
    """Place all bodies of a robot."""
    placed = {'': (position, quaternion)}
    for link in LINKS:
        at, turn = placed[link.parent] if link.parent else (position, quaternion)
        own = link.turned(tilt[JOINT_NAMES.index(link.joint)]) if link.joint in JOINT_NAMES \
            else link.quaternion
        placed[link.name] = (at + rotations.matrix(turn) @ link.position,
                             rotations.multiply(turn, own))
        index = model.body(prefix + link.name).mocapid[0]
        data.mocap_pos[index] = placed[link.name][0]
        data.mocap_quat[index] = np.roll(placed[link.name][1], 1)



def _frames(panels):
    """Yield the pictures of all moments."""
    import mujoco  # chooses its OpenGL once
    stages = []
    for one in panels:
        model = mujoco.MjModel.from_xml_string(_scene(one.colour))
        stages.append((model, mujoco.MjData(model), mujoco.Renderer(model, HEIGHT, WIDTH)))
    view, errors, fonts = mujoco.MjvCamera(), [one.errors() for one in panels], _fonts()
    view.distance, view.azimuth, view.elevation = DISTANCE, AZIMUTH, ELEVATION
    paths = [gaussian_filter1d(one.position, SLOW * FPS, axis=0) for one in panels]
    chart, curves = _chart(len(panels), fonts), [_curve(error, len(panels)) for error in errors]
    for k in range(min(len(one.position) for one in panels)):
        frame = Image.new('RGB', (WIDTH * len(panels), HEIGHT + CHART), PAPER)
        frame.paste(chart, (0, HEIGHT))
        draw = ImageDraw.Draw(frame)
        for column, (one, (model, data, renderer)) in enumerate(zip(panels, stages)):
            _pose(model, data, '', one.position[k], one.quaternion[k], one.tilt[k])
            _pose(model, data, 'ghost_', one.ghost_position[k], one.ghost_quaternion[k],
                  one.tilt[k])
            mujoco.mj_forward(model, data)
            view.lookat[:] = paths[column][k] * (1, 1, CENTRE)
            renderer.update_scene(data, view)
            for geom in renderer.scene.geoms[:renderer.scene.ngeom]:
                if geom.rgba[3] < 1:    # casts no shadow
                    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
            frame.paste(Image.fromarray(renderer.render()), (WIDTH * column, 0))
            _caption(draw, WIDTH * column, one, k / FPS, errors[column][k], fonts)
            draw.line(curves[column][:k + 1], one.colour, 2, joint='curve')
        yield frame


def _fonts():
    return [ImageFont.truetype(font_manager.findfont(font_manager.FontProperties(
        family='DejaVu Sans', weight=weight)), size)
        for weight, size in (('bold', 22), ('bold', 19), ('normal', 13))]


def _caption(draw, left, one, time, errors, fonts):
    title, number, small = fonts
    draw.text((left + 15, 10), one.label, one.colour, title)
    draw.text((left + WIDTH - 15, 10), f'{time:.1f} s', INK, title, anchor='ra')
    for x, text, name in ((15, f'{1e3 * errors[0]:.0f} mm', 'position error'),
                          (132, f'{errors[1]:.1f}°', 'attitude error')):
        draw.text((left + x, 38), text, INK, number)
        draw.text((left + x, 61), name, FAINT, small)


def _row(error):
    """Height of errors [m] in the chart, on a logarithmic scale."""
    share = np.log(np.clip(error, LEAST, MOST) / LEAST) / np.log(MOST / LEAST)
    return HEIGHT + CHART * (0.88 - 0.74 * share)


def _curve(errors, panels):
    return list(zip(np.linspace(75, WIDTH * panels - 15, len(errors)), _row(errors[:, 0])))


def _chart(panels, fonts):
    """Axes of the position errors."""
    base = Image.new('RGB', (WIDTH * panels, CHART), PAPER)
    draw, right = ImageDraw.Draw(base), WIDTH * panels - 15
    for value, text in TICKS.items():
        y = _row(value) - HEIGHT
        draw.line((75, y, right, y), RULE, 1)
        draw.text((69, y), text, FAINT, fonts[2], anchor='rm')
    draw.text((right, 0), 'position error', FAINT, fonts[2], anchor='ra')
    return base
