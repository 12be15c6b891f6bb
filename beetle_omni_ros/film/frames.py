"""Frames of a film: panels side by side, captions, and a chart of the position error."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack

from matplotlib import font_manager
from matplotlib.colors import to_rgb
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from beetle_omni_ros.film.scenes import Scene
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.figure import Look
from beetle_omni_ros.sim.render import Camera, HAZE, Stage, Trail

INK, FAINT, LINE = (34, 39, 46), (112, 121, 132), (205, 211, 219)
PAPER = tuple(round(255 * c) for c in HAZE)
TARGET_LOOK, MODEL_LOOK = Look(0.24, (0.20, 0.50, 0.90)), Look(0.40, (0.90, 0.25, 0.15))
FIELD_OF_VIEW = 30.0            # [deg]
AZIMUTHS, ELEVATION = np.arange(95.0, 176.0, 10.0), -18.0   # [deg]
ROBOT_RADIUS = 0.36             # [m] radius around base_link that the picture contains
ASPECT = 1.15                   # width over height of a panel
CAPTION, CHART = 0.20, 0.18     # heights relative to the height and to the width of a panel
TRAIL_FRAMES, TRAIL_TIME = 60, 3.0  # points, [s]
LEAST, MOST = 1e-3, 1.0         # [m] range of the chart
TICKS = ((1e-3, '1 mm'), (1e-2, '1 cm'), (1e-1, '10 cm'), (1.0, '1 m'))


def framing(points: np.ndarray) -> Camera:
    """Place a fixed camera as near as possible with all positions (N, 3) [m] in its view."""
    return min((_framing(points, azimuth) for azimuth in AZIMUTHS), key=lambda c: c.distance)


def _framing(points, degrees):
    azimuth, elevation = np.radians(degrees), np.radians(ELEVATION)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                        np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    up = np.cross(right, forward)
    whole = np.tan(np.radians(FIELD_OF_VIEW / 2))
    tangents = (right, whole * ASPECT), (up, whole * (1 - CAPTION))
    lookat, distance = points.mean(axis=0), 3.0
    for _ in range(8):
        depth = distance + (points - lookat) @ forward
        for axis, _ in tangents:
            seen = (points - lookat) @ axis / depth
            lookat = lookat + axis * distance * (seen.min() + seen.max()) / 2
        offset = points - lookat
        distance = max(float(np.max((np.abs(offset @ axis) + ROBOT_RADIUS) / tangent
                                    - offset @ forward)) for axis, tangent in tangents)
    # The caption covers the upper part, so the flight is placed in the lower one.
    lookat = lookat + up * 0.8 * CAPTION * distance * whole
    return Camera(tuple(map(float, lookat)), distance, float(degrees), ELEVATION)


def frames(scenes: Sequence[Scene], times: np.ndarray, robot: RobotParameters,
           size: int) -> Iterator[Image.Image]:
    """
    Draw the frames of a film.

    Args:
        scenes: panels from left to right.
        times: (F,) times of the frames since the start of the film [s].
        robot: robot to draw.
        size: width of a panel [pixels].

    Raises:
        RuntimeError: no off-screen OpenGL.

    """
    points = np.concatenate([[pose.position for pose in (*scene.poses, *scene.ghosts)
                              if pose is not None] for scene in scenes])
    camera, height = framing(points), 2 * round(size / ASPECT / 2)
    texts = _Texts(size)
    chart = _Chart(scenes, times, size, texts)
    with ExitStack() as stack:
        stages = [stack.enter_context(Stage(
            robot, [Look(), MODEL_LOOK if scene.against_model else TARGET_LOOK], size, height,
            FIELD_OF_VIEW)) for scene in scenes]
        for k in range(len(times)):
            frame = Image.new('RGB', (size * len(scenes), height + chart.height), PAPER)
            for column, (scene, stage) in enumerate(zip(scenes, stages, strict=True)):
                picture = Image.fromarray(stage.draw([scene.poses[k], scene.ghosts[k]], camera,
                                                     _trails(scene, times, k)))
                texts.caption(picture, scene, k, times[k])
                frame.paste(picture, (size * column, 0))
            draw = ImageDraw.Draw(frame)
            for column in range(1, len(scenes)):
                draw.line((size * column, 0, size * column, height), LINE, 1)
            frame.paste(chart.until(k), (0, height))
            yield frame


def _trails(scene, times, k):
    first = int(np.searchsorted(times, times[k] - TRAIL_TIME))
    rows = np.unique(np.linspace(first, k, TRAIL_FRAMES).astype(int))
    return [Trail(np.array([scene.poses[row].position for row in rows]), to_rgb(scene.colour))]


class _Texts:
    """Fonts and captions."""

    def __init__(self, size):
        self._size = size
        self.title, self.number, self.small = (
            ImageFont.truetype(font_manager.findfont(font_manager.FontProperties(
                family='DejaVu Sans', weight=weight)), max(9, round(size * height)))
            for weight, height in (('bold', 0.050), ('bold', 0.043), ('normal', 0.0285)))

    def caption(self, picture, scene, k, time):
        draw, s = ImageDraw.Draw(picture), self._size
        left, top = 0.035 * s, 0.028 * s
        draw.text((left, top), scene.label, scene.colour, self.title)
        draw.text((s - left, top), f'{time:.1f} s', INK, self.title, anchor='ra')
        draw.text((left, top + 0.070 * s), scene.notes[k], FAINT, self.small)
        if np.isfinite(scene.position[k]):
            number = f'{1e3 * scene.position[k]:.0f} mm', f'{scene.orientation[k]:.1f}°'
            for text, name, x in zip(number, ('position', 'attitude'), (0.035, 0.30)):
                draw.text((x * s, top + 0.118 * s), text, INK, self.number)
                draw.text((x * s, top + 0.175 * s), f'{name} error', FAINT, self.small)


class _Chart:
    """Chart of the position errors of all panels up to the present frame."""

    def __init__(self, scenes, times, size, texts):
        self.height = 2 * round(CHART * size / 2)
        width, margin = size * len(scenes), round(0.035 * size)
        self._left, self._right = margin + round(0.13 * size), width - margin
        self._base = Image.new('RGB', (width, self.height), PAPER)
        self._times = times
        top, bottom = 0.14 * self.height, 0.88 * self.height
        span = np.log10(MOST / LEAST)

        def row(error):
            part = np.log10(np.clip(error, LEAST, MOST) / LEAST) / span
            return bottom - (bottom - top) * part

        draw = ImageDraw.Draw(self._base)
        draw.line((0, 0, width, 0), LINE, 1)
        for value, text in TICKS:
            draw.line((self._left, row(value), self._right, row(value)), LINE, 1)
            draw.text((self._left - 6, row(value)), text, FAINT, texts.small, anchor='rm')
        draw.text((self._right, 0.04 * self.height), 'position error', FAINT, texts.small,
                  anchor='ra')
        across = self._left + (self._right - self._left) * times / max(times[-1], 1e-9)
        self._curves = [(scene.colour, [(x, y) if np.isfinite(y) else None for x, y in
                                        zip(across, row(scene.position), strict=True)])
                        for scene in scenes]

    def until(self, k):
        """Draw the curves up to frame ``k``."""
        picture = self._base.copy()
        draw = ImageDraw.Draw(picture)
        for colour, points in self._curves:
            known = [point for point in points[:k + 1] if point is not None]
            if len(known) > 1:
                draw.line(known, colour, 2, joint='curve')
            if known:
                x, y = known[-1]
                draw.ellipse((x - 3, y - 3, x + 3, y + 3), colour)
        return picture
