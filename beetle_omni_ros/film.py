"""`beetle_omni film`: recorded flights as a GIF, with their targets or a model's prediction."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

from matplotlib import font_manager
from matplotlib.colors import to_rgb
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import track

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.pages.figures import COLOURS
from beetle_omni_ros.pages.page import Terminal
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.bag import no_pose, read_bag, runs_in
from beetle_omni_ros.runs.log import FlightLog, geodesic_angles, hold, Motion, motion
from beetle_omni_ros.sim.render import Camera, HAZE, Look, Pose, Stage, Trail
from beetle_omni_ros.sim.simulator import Simulator

FPS = 12.5
WIDTH, HEIGHT, CAPTION, CHART = 440, 382, 80, 80    # pixels; the caption covers the panel's top
INK, FAINT, LINE, PAPER = '#22272e', '#707984', '#cdd3db', tuple(round(255 * c) for c in HAZE)
TARGET_LOOK, MODEL_LOOK = Look(0.24, (0.20, 0.50, 0.90)), Look(0.40, (0.90, 0.25, 0.15))
MODEL_COLOURS = (COLOURS[1], COLOURS[2], COLOURS[0], COLOURS[3])
FIELD_OF_VIEW = 30.0            # [deg]
AZIMUTH, ELEVATION = 112.0, -17.0   # [deg] of the line of sight
ROBOT_RADIUS = 0.36             # [m] radius around base_link that the picture contains
TRAIL_TIME = 3.0                # [s]
LEAST, MOST = 1e-3, 1.0         # [m] range of the chart
TICKS = ((1e-3, '1 mm'), (1e-2, '1 cm'), (1e-1, '10 cm'), (1.0, '1 m'))
RESTART = 1.0                   # [s] between two restarts of a prediction from the flown state
HALF = 5e-7                     # [s] half the resolution of rounded stamps
PALETTE_FRAMES = 24


@dataclass(frozen=True)
class Panel:
    """One flight in F frames: poses (F,) of robot and ghost, the latter None without a target."""

    label: str
    colour: str
    poses: list[Pose]
    ghosts: list[Pose | None]
    look: Look

    def errors(self) -> np.ndarray:
        """(F, 2) distance [m] and angle [deg] between robot and ghost, NaN without a ghost."""
        return np.array([(np.nan, np.nan) if ghost is None else (
            np.linalg.norm(ghost.position - pose.position),
            np.degrees(geodesic_angles(ghost.quaternion[None], pose.quaternion)[0]))
            for pose, ghost in zip(self.poses, self.ghosts, strict=True)])


def run_film(paths: list[Path], output: Path, *, models: list[Path] = (),
             console: Console | None = None) -> None:
    """
    Draw flights side by side, from the first target on.

    The arguments are those of `beetle_omni film`.

    Raises:
        BagError: a run cannot be read.
        ParameterError: unusable arguments or files, or no OpenGL.

    """
    console, paths = console or Terminal(), runs_in(paths)
    if output.suffix != '.gif':
        raise ParameterError(f'{output}: expected a name that ends with .gif')
    if models and len(paths) > 1:
        raise ParameterError(f'--model: expected one RUN with it, found {len(paths)}')
    if max(len(paths), len(models)) > len(MODEL_COLOURS):
        raise ParameterError(f'a film has at most {len(MODEL_COLOURS)} panels')
    logs = [_read(path) for path in paths]
    starts = [log.targets[0].stamp if log.targets else log.start for log in logs]
    times = np.arange(0.0, max(log.end - start for log, start in zip(logs, starts)), 1 / FPS)
    if models:
        panels = [_panel(logs[0], file.stem.replace('_', ' '), colour, starts[0] + times,
                         free_run(logs[0], RobotParameters.load(file)))
                  for file, colour in zip(models, MODEL_COLOURS)]
    else:
        panels = [_panel(log, Path(path).absolute().name, colour, start + times)
                  for log, path, colour, start in zip(logs, paths, COLOURS, starts)]
    frames = list(track(_frames(panels, times), output.name, total=len(times),
                        console=console, transient=True))
    # One palette for all frames: else the background flickers.
    sample = np.concatenate(frames[::max(1, len(frames) // PALETTE_FRAMES)])
    palette = Image.fromarray(sample).quantize(255, kmeans=1)
    first, *rest = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
                    for frame in frames)
    first.save(output, save_all=True, append_images=rest, loop=0, duration=round(1000 / FPS))
    console.print(f'{output}: {len(times) / FPS:.0f} s, {output.stat().st_size / 1e6:.1f} MB',
                  highlight=False)


def _read(path):
    log = read_bag(path)
    if not len(log.truth_t) and not len(log.odom_t):
        raise no_pose(path, log.warnings)
    return log


def free_run(log: FlightLog, robot: RobotParameters) -> Motion:
    """
    Simulate ``robot`` with the commands of a flight.

    Servos and rotors follow the commands from the first to the last one. The body starts from the
    flown state, and is reset to it after every ``RESTART``.

    Returns:
        the simulated motion at the ticks of the simulator, on the clock of the flight.

    Raises:
        ParameterError: the simulator lacks an effect of the robot.

    """
    simulator, flown = Simulator(robot), motion(log)
    if not len(log.command_t):
        return Motion(*(series[:0] for series in vars(flown).values()))
    start = log.command_t[0]
    # Unix times of today have a resolution of 0.2 us as float; ticks are compared exactly.
    stamps, flown_at = np.round(log.command_t - start, 6), np.round(flown.t - start, 6)
    first_target = round(log.targets[0].stamp - start, 6) if log.targets else 0.0
    due, row, states = 0.0, 0, []
    while simulator.time < stamps[-1]:
        while row < len(stamps) and stamps[row] <= simulator.time + HALF:
            simulator.command(SimpleNamespace(stamp=stamps[row], tilt=log.command_tilt[row],
                                              thrust=log.command_thrust[row]))
            row += 1
        if simulator.time >= due - 1e-6:
            # One reset coincides with the first target, at which films start.
            due = simulator.time + RESTART - (simulator.time - first_target) % RESTART
            k = min(np.searchsorted(flown_at, simulator.time - HALF), len(flown.t) - 1)
            simulator.set_body(flown.position[k], flown.quaternion[k], flown.velocity[k],
                               flown.angular_velocity[k])
        truth = simulator.truth
        states.append((start + simulator.time, truth.position, truth.quaternion, truth.velocity,
                       truth.angular_velocity))
        simulator.step()
    return Motion(*map(np.array, zip(*states, strict=True)))


def _panel(log, label, colour, times, expected=None):
    """Panel at ``times`` (F,) [s] of the flight; the ghost is ``expected``, else the targets."""
    position, quaternion = _at(motion(log), times)
    still = np.zeros((1, 4))
    commands = log.command_t, log.command_tilt
    tilt = hold(*next(((t, x) for t, x in ((log.joint_t, log.joint_position), commands)
                       if len(t)), (times[:1], still)), times)
    thrust = hold(log.command_t, log.command_thrust, times) if len(log.command_t) else \
        [None] * len(times)
    poses = [Pose(*row) for row in zip(position, quaternion, tilt, thrust, times, strict=True)]
    if expected is not None:
        ghosts = [Pose(*row, time=t) for *row, t in zip(*_at(expected, times), tilt, times)]
    else:
        ghosts = _targets(log, times)
    return Panel(label, colour, poses, ghosts, TARGET_LOOK if expected is None else MODEL_LOOK)


def _at(body, times):
    index = np.clip(np.searchsorted(body.t, times - 1e-6), 0, len(body.t) - 1)
    return body.position[index], body.quaternion[index]


def _targets(log, times):
    """Poses of the targets in force, with the tilts of hovering there; None before the first."""
    stamps, tilts, found = [target.stamp for target in log.targets], {}, []
    robot = RobotParameters.load()
    for t, k in zip(times, np.searchsorted(stamps, times + 1e-6, side='right') - 1):
        if k < 0:
            found.append(None)
            continue
        target = log.targets[k]
        pose = target if isinstance(target, PoseTarget) else target.at(float(t))
        key = np.round(pose.quaternion, 4).tobytes()
        if key not in tilts:
            tilts[key] = Allocator(robot).hover(pose.quaternion, np.zeros(4)).tilt
        found.append(Pose(pose.position, pose.quaternion, tilts[key], time=t))
    return found


def camera(points: np.ndarray) -> Camera:
    """Place a fixed camera with robots at all ``points`` (N, 3) [m] below the caption."""
    azimuth, elevation = np.radians([AZIMUTH, ELEVATION])
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                        np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    axes = np.array([right, np.cross(right, forward), forward])
    half = np.tan(np.radians(FIELD_OF_VIEW / 2))
    free = 1 - CAPTION / HEIGHT         # of the height of the picture
    seen = points @ axes.T
    centre = (seen.min(axis=0) + seen.max(axis=0)) / 2
    seen -= centre
    distance = ((np.abs(seen[:, :2]) + ROBOT_RADIUS) / (half * WIDTH / HEIGHT, half * free)
                - seen[:, 2:]).max()
    centre[1] += (1 - free) * half * (distance + seen[:, 2].min())
    return Camera(tuple(map(float, centre @ axes)), float(distance), AZIMUTH, ELEVATION)


def _frames(panels, times):
    """Yield pictures (height, width, 3), uint8."""
    view = camera(np.array([pose.position for panel in panels
                            for pose in (*panel.poses, *panel.ghosts) if pose is not None]))
    errors, fonts = [panel.errors() for panel in panels], _fonts()
    chart = _chart(len(panels), fonts)
    curves = [_curve(error[:, 0], len(panels)) for error in errors]
    with ExitStack() as stack:
        stages = [stack.enter_context(Stage([Look(), panel.look], WIDTH, HEIGHT,
                                            FIELD_OF_VIEW)) for panel in panels]
        for k, time in enumerate(times):
            frame = Image.new('RGB', (WIDTH * len(panels), HEIGHT + CHART), PAPER)
            frame.paste(chart, (0, HEIGHT))
            draw = ImageDraw.Draw(frame)
            for column, (panel, stage) in enumerate(zip(panels, stages)):
                trail = np.array([pose.position for pose in
                                  panel.poses[max(0, k - round(TRAIL_TIME * FPS)):k + 1]])
                frame.paste(Image.fromarray(stage.draw(
                    [panel.poses[k], panel.ghosts[k]], view,
                    [Trail(trail, to_rgb(panel.colour))])), (WIDTH * column, 0))
                _caption(draw, WIDTH * column, panel, time, errors[column][k], fonts)
                known = [point for point in curves[column][:k + 1] if point[1] == point[1]]
                if len(known) > 1:
                    draw.line(known, panel.colour, 2, joint='curve')
            yield np.asarray(frame)


def _fonts():
    return [ImageFont.truetype(font_manager.findfont(font_manager.FontProperties(
        family='DejaVu Sans', weight=weight)), size)
        for weight, size in (('bold', 22), ('bold', 19), ('normal', 13))]


def _caption(draw, left, panel, time, errors, fonts):
    title, number, small = fonts
    draw.text((left + 15, 12), panel.label, panel.colour, title)
    draw.text((left + WIDTH - 15, 12), f'{time:.1f} s', INK, title, anchor='ra')
    if np.isfinite(errors).all():
        for x, text, name in ((15, f'{1e3 * errors[0]:.0f} mm', 'position error'),
                              (132, f'{errors[1]:.1f}°', 'attitude error')):
            draw.text((left + x, 42), text, INK, number)
            draw.text((left + x, 66), name, FAINT, small)


def _row(error):
    """Height of errors [m] in the chart, on a logarithmic scale."""
    share = np.log(np.clip(error, LEAST, MOST) / LEAST) / np.log(MOST / LEAST)
    return CHART * (0.88 - 0.74 * share)


def _curve(error, panels):
    """Points of one curve in the frame; NaN where there is no error."""
    return list(zip(np.linspace(75, WIDTH * panels - 15, len(error)), HEIGHT + _row(error)))


def _chart(panels, fonts):
    """Axes of the position errors."""
    base = Image.new('RGB', (WIDTH * panels, CHART), PAPER)
    draw, right = ImageDraw.Draw(base), WIDTH * panels - 15
    for value, text in TICKS:
        draw.line((75, _row(value), right, _row(value)), LINE, 1)
        draw.text((69, _row(value)), text, FAINT, fonts[2], anchor='rm')
    draw.text((right, 0), 'position error', FAINT, fonts[2], anchor='ra')
    return base
