"""The page in the browser: 3D scene, panel and plots."""

from collections.abc import Callable, Iterator
import contextlib
from dataclasses import dataclass
import html
import io
from pathlib import PosixPath
import socket
import threading
import time

import numpy as np
import viser
from viser import uplot
import viser.infra

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.urdf import Model
from beetle_omni_ros.runs.log import geodesic_angles
from beetle_omni_ros.view.drawing import FORCE, RobotDrawing, WORLD_NEWTON_PER_METRE, wxyz
from beetle_omni_ros.view.frames import COLUMNS, known, pose, T

SOFTWARE_RENDERERS = 'SwiftShader|llvmpipe|softpipe|software|Basic Render'
# Draws without antialiasing if the browser has no graphics card: it takes half of the time of a
# picture that the CPU renders. viser's client requests it and has no option for it.
SCRIPT = """<script>(() => {
  const gl = document.createElement('canvas').getContext('webgl');
  const info = gl && gl.getExtension('WEBGL_debug_renderer_info');
  const renderer = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : '';
  gl?.getExtension('WEBGL_lose_context')?.loseContext();
  if (!/RENDERERS/i.test(renderer)) return;
  const original = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return original.call(this, kind, String(kind).startsWith('webgl')
      ? {...options, antialias: false} : options);
  };
})();</script>""".replace('RENDERERS', SOFTWARE_RENDERERS)
COLOURS = ('#e4572e', '#17a398', '#5b6ee1', '#d4a017')     # of x, y, z; of rotors and joints
RUN_COLOURS = ((228, 87, 46), (23, 163, 152), (91, 110, 225), (212, 160, 23))
NOW = '#8a8f98'
BEHIND, AHEAD = 6.0, 6.0        # [s] around the present that a plot shows
HEIGHT = 150                    # [px]
FOUR = ('1', '2', '3', '4')
RATE = 30.0             # [Hz] of the scene
PANEL_RATE, PLOT_RATE = 4.0, 4.0
SHOWN_PLOTS = ('position error [m]', 'thrust command [N]')      # at the start
ESTIMATE = ((70, 140, 250), 0.35)
GHOST_OPACITY = 0.35
TARGET_AXES = 0.28      # [m]
TRAIL_POINTS = 800
SHADOW_RADIUS, SHADOW_OPACITY = 0.24, 0.15     # of the spot below the robot [m]
VIEW_FROM, SMALLEST_VIEW = np.array([-0.5, -0.8, 0.36]), 2.0     # [m]
NARROW, PHONE_DISTANCE, PANEL_SHARE = 0.8, 1.6, 0.35
SETTLING = 5.0      # [s] after a browser connects in which the page is redrawn
NUDGE = 1e-6        # [s] added to the plots' times so that they change
ROOM = 3.5          # [m]
SKY = 4.0           # brightness of the ambient light, instead of reflections
FLOOR = 10.0        # [m] to each side, with a line at each metre
LABEL_HEIGHT, LABEL_STEP = 0.38, 0.1    # [m] above base_link; for each further run
ESTIMATE_SEEN = 0.01, 1.0   # [m], [deg] error above which the estimate is drawn
LOCAL = '127.0.0.1'


class _Client(PosixPath):
    """Folder and files of viser's client, with the script in its page."""

    def read_bytes(self) -> bytes:
        """Content of the file."""
        data = super().read_bytes()
        return data.replace(b'<head>', b'<head>' + SCRIPT.encode(), 1) \
            if self.name == 'index.html' else data


@contextlib.contextmanager
def served_with_script() -> Iterator[None]:
    """Let a viser server that is created in this context serve the page with the script."""
    server = viser.infra.WebsockServer

    def with_script(*args, **kwargs):
        if 'http_server_root' in kwargs:    # a keyword of viser's internal call
            kwargs['http_server_root'] = _Client(kwargs['http_server_root'])
        return server(*args, **kwargs)

    viser.infra.WebsockServer = with_script     # type: ignore[assignment, misc]
    try:
        yield
    finally:
        viser.infra.WebsockServer = server      # type: ignore[misc]


@dataclass(frozen=True)
class Plot:
    """
    One plot.

    Attributes:
        title: title with unit.
        labels: labels of its series.
        values: rows (N, WIDTH) -> (N, len(labels)).
        compares: whether it shows all runs; otherwise the first run only.

    """

    title: str
    labels: tuple[str, ...]
    values: Callable[[np.ndarray], np.ndarray]
    compares: bool = False


def colour(run: int) -> str:
    """Return the HTML colour of a run."""
    return '#{:02x}{:02x}{:02x}'.format(*RUN_COLOURS[run % len(RUN_COLOURS)])


def _field(name, scale=1.0):
    return lambda rows: scale * rows[:, COLUMNS[name]]


PLOTS = (
    Plot('position error [m]', ('',), lambda rows: np.linalg.norm(
        rows[:, COLUMNS['position']] - rows[:, COLUMNS['target_position']], axis=1,
        keepdims=True), True),
    Plot('orientation error [deg]', ('',), lambda rows: np.degrees(geodesic_angles(
        rows[:, COLUMNS['quaternion']], rows[:, COLUMNS['target_quaternion']]))[:, None], True),
    Plot('position [m]', ('x', 'y', 'z'), _field('position')),
    Plot('tilt [deg]', FOUR, _field('tilt', 180 / np.pi)),
    Plot('thrust command [N]', FOUR, _field('thrust')),
    Plot('battery [V]', ('V',), _field('voltage')),
)


def window(plot: Plot, runs: list[np.ndarray], now: float) -> tuple[np.ndarray, ...] | None:
    """
    Return the series of a plot around the present time.

    Args:
        plot: plot to draw.
        runs: rows (N, WIDTH) of each run, on the time base of the first.
        now: present time [s].

    Returns:
        Times, the series, and a vertical line at ``now`` from 0 to 1 on its own scale. All have
        equal length. The series contain no NaN, at which the plotting library would stop. None
        without data.

    """
    series = [plot.values(rows) for rows in (runs if plot.compares else runs[:1])]
    own = [rows[:, T] for rows in runs][:len(series)]
    times = np.unique(np.concatenate(own))
    if not any(np.isfinite(values).any() for values in series):
        return None
    columns = [_over(times, t, column) for t, values in zip(own, series, strict=True)
               for column in values.T]
    spare = next(column for column in columns if column is not None)
    k = int(np.searchsorted(times, now))
    mark = np.insert(np.full(len(times), np.nan), [k, k], [0.0, 1.0])
    return (np.insert(times, [k, k], now),
            *(np.insert(column, [k, k], np.interp(now, times, column))
              for column in (spare if column is None else column for column in columns)), mark)


def _over(times, own, values):
    """Values interpolated at other times, without NaN; None without values."""
    there = np.isfinite(values)
    return np.interp(times, own[there], values[there]) if there.any() else None


def moments(stop: threading.Event) -> Iterator[tuple[float, float]]:
    """Yield (time, time since the last one) [s] at RATE until ``stop``, without late ones."""
    last = due = time.monotonic()
    while True:
        due = max(due + 1 / RATE, time.monotonic())
        if stop.wait(due - time.monotonic()):
            return
        now = time.monotonic()
        yield now, now - last
        last = now


@dataclass(frozen=True)
class Shown:
    """
    Displayed data of one run at one moment.

    Attributes:
        row: row of values, see :mod:`~beetle_omni_ros.view.frames`.
        window: rows around it, for the plots, on the time base of the first run.
        state: state of the supervisor.
        faults: fault names so far -> time of the first report [s].

    """

    row: np.ndarray
    window: np.ndarray
    state: str = ''
    faults: dict[str, float] | None = None


class Page:
    """
    A page served for browsers.

    Args:
        names: names of the runs; the first is drawn solid, the others transparent.
        model: links and shapes of the robot.
        robot: robot parameters, for the positions of forces.
        title: title of the folder of the controls.
        host, port: address; if the port is in use, the next free one is taken.
        dark: whether the page starts with dark colours.

    Attributes:
        url: address for the browser.
        controls: folder for further controls.

    """

    def __init__(self, names: list[str], model: Model, robot: RobotParameters, *,
                 title: str = 'Playback', host: str = LOCAL, port: int = 8080, dark: bool = False):
        self._names, self._robot, self._model, self._title = names, robot, model, title
        try:
            with socket.socket() as probe:      # if bind fails, viser would wait forever
                probe.bind((host, 0))
            # viser prints its own addresses
            with served_with_script(), contextlib.redirect_stdout(io.StringIO()):
                self.server = viser.ViserServer(host, port, label='beetle_omni', verbose=False)
        except (OSError, OverflowError, RuntimeError, UnicodeError) as error:
            raise ParameterError(f'--host {host} --port {port}: cannot be served there '
                                 f'({error})') from None
        shown = 'localhost' if host in (LOCAL, '0.0.0.0') else host
        self.url = f'http://{shown}:{self.server.get_port()}'
        self._last_panel = self._last_plot = -np.inf
        self._nudge, self._newcomer = 0.0, -np.inf
        self._followed: np.ndarray | None = None
        self._add_scene(dark)
        self._add_panel(dark)

        @self.server.on_client_connect
        def _(client):
            self._newcomer = time.monotonic()
            if client.camera.aspect < NARROW:   # a phone, where the panel covers the lower half
                camera, given = client.camera, self.server.initial_camera
                away = np.asarray(given.position) - given.look_at
                centre = given.look_at - [0, 0, PANEL_SHARE * np.linalg.norm(away)]
                camera.position, camera.look_at = (
                    centre + away * PHONE_DISTANCE, centre)

    # -- scene -----------------------------------------------------------------------------

    def _add_scene(self, dark):
        scene = self.server.scene
        # Shadows, reflections and an infinite floor would dominate the rendering time.
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient('/sky', intensity=SKY)
        self._set_theme(dark)
        self._robots = [RobotDrawing(
            scene, f'/run{k}', self._model, self._robot,
            None if k == 0 else (RUN_COLOURS[k % 4], GHOST_OPACITY))
            for k in range(len(self._names))]
        self._estimate = RobotDrawing(scene, '/estimate', self._model, self._robot, ESTIMATE)
        self._target = scene.add_frame('/target', axes_length=TARGET_AXES, axes_radius=0.008,
                                       origin_radius=0.018, visible=False)
        self._shadow = scene.add_cylinder(
            '/shadow', SHADOW_RADIUS, 0.002, (0, 0, 0), opacity=SHADOW_OPACITY, visible=False,
            cast_shadow=False, receive_shadow=False)
        self._force = scene.add_arrows('/force', np.zeros((1, 2, 3)), FORCE, shaft_radius=0.012,
                                       head_radius=0.03, head_length=0.06, visible=False)
        self._labels = [scene.add_label(f'/label{k}', name, visible=False,
                                        anchor='bottom-center')
                        for k, name in enumerate(self._names)] if len(self._names) > 1 else []
        self._trails = {}

    def _set_theme(self, dark):
        self.server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, control_width='medium',
            brand_color=(228, 87, 46))
        scene = self.server.scene
        k = np.arange(-FLOOR, FLOOR + 1.0)
        along = np.array([[[x, -FLOOR, 0], [x, FLOOR, 0]] for x in k])
        scene.add_line_segments('/floor', np.concatenate([along, along[:, :, [1, 0, 2]]]),
                                (84, 90, 102) if dark else (196, 201, 209), thickness=1.0,
                                thickness_units='screen')

    def look_at(self, centre: np.ndarray, size: float) -> None:
        """Set the initial camera, to see a region of ``size`` [m] around ``centre`` (3,) [m]."""
        camera = self.server.initial_camera
        camera.look_at = centre
        camera.position = centre + max(size, SMALLEST_VIEW) * VIEW_FROM

    def look_at_room(self) -> None:
        """Set the initial camera for a flight without known poses."""
        self.look_at(np.array([0.0, 0.0, 1.0]), ROOM)

    def draw_trail(self, k: int, positions: np.ndarray) -> None:
        """Draw the path of a run: (N, 3) in world [m]."""
        if len(positions) < 2:
            return
        # Evenly spaced along the path, because most samples are at the hovered poses.
        steps = np.diff(positions, axis=0, prepend=positions[:1])
        flown = np.cumsum(np.linalg.norm(steps, axis=1))
        points = positions[np.searchsorted(flown, np.linspace(0, flown[-1], TRAIL_POINTS))]
        lines = np.stack([points[:-1], points[1:]], axis=1)
        self._trails[k] = self.server.scene.add_line_segments(
            f'/trail{k}', lines, RUN_COLOURS[k % 4] if len(self._names) > 1
            else (150, 158, 170), thickness=1.5, thickness_units='screen',
            visible=self._show_trail.value)

    # -- panel -----------------------------------------------------------------------------

    def _add_panel(self, dark):
        gui = self.server.gui
        self._status = gui.add_html('')
        self.controls = gui.add_folder(self._title, expand_by_default=True)
        with gui.add_folder('Show', expand_by_default=False):
            self._show_estimate = gui.add_checkbox('estimate', True)
            self._show_forces = gui.add_checkbox('thrust and torque', True)
            self._show_trail = gui.add_checkbox('path', True)
            self._follow = gui.add_checkbox('follow the robot', False)
            self._dark = gui.add_checkbox('dark', dark)
            self._run_boxes = [gui.add_checkbox(name, True) for name in self._names] \
                if len(self._names) > 1 else []
        self._dark.on_update(lambda _: self._set_theme(self._dark.value))
        self._show_forces.on_update(
            lambda _: self._robots[0].show_forces(self._show_forces.value))

        @self._show_trail.on_update
        def _(_):
            for trail in self._trails.values():
                trail.visible = self._show_trail.value
        with gui.add_folder('Plots', expand_by_default=True):
            self._plots = [(gui.add_checkbox(plot.title, plot.title in SHOWN_PLOTS),
                            self._add_plot(plot)) for plot in PLOTS]

    def _add_plot(self, plot):
        if plot.compares:
            labels = self._names
            colours = [colour(k) for k in range(len(labels))]
        else:
            labels, colours = plot.labels, COLOURS
        series = [uplot.Series(label='t')]
        series += [uplot.Series(label=label, stroke=colour, width=2, points={'show': False})
                   for label, colour in zip(labels, colours)]
        series += [uplot.Series(label='', stroke=NOW, width=1, scale='now',
                                points={'show': False})]
        empty = np.zeros(0)
        return self.server.gui.add_uplot(
            (empty,) * len(series), tuple(series), height=HEIGHT,
            scales={'x': uplot.Scale(time=False, auto=True), 'now': uplot.Scale(range=(0, 1))},
            visible=False, legend=uplot.Legend(show=False), padding=(4, 8, 0, 0))

    # -- drawing ---------------------------------------------------------------------------

    def show(self, runs: list[Shown], now: float, passed: float, headline: str) -> None:
        """
        Draw one moment.

        Args:
            runs: data of each run.
            now: present time on the time base of the first run [s].
            passed: time since the previous call, for the rotation of the rotors [s].
            headline: first line of the status.

        """
        first = runs[0]
        with self.server.atomic():
            for k, (robot, run) in enumerate(zip(self._robots, runs, strict=True)):
                wanted = not self._run_boxes or self._run_boxes[k].value
                robot.show(run.row, passed=passed) if wanted else robot.hide()
                if self._labels:
                    _place(self._labels[k], pose(run.row) if wanted else None,
                           [0, 0, LABEL_HEIGHT + LABEL_STEP * k])
            # An estimate at the true pose would only tint the robot.
            metres, degrees = _apart(first.row, 'estimate_')
            if self._show_estimate.value and (
                    metres > ESTIMATE_SEEN[0] or degrees > ESTIMATE_SEEN[1]):
                self._estimate.show(first.row, 'estimate_')
            else:
                self._estimate.hide()
            placed, target = pose(first.row), pose(first.row, 'target_')
            _place(self._target, target)
            if target is not None:
                self._target.wxyz = wxyz(target[1])
            _place(self._shadow, placed and (placed[0] * [1, 1, 0], None), [0, 0, 0.001])
            force = known(first.row, 'force')
            self._force.visible = force is not None and placed is not None
            if self._force.visible:
                self._force.points = [[placed[0], placed[0] + force / WORLD_NEWTON_PER_METRE]]
            self._move_cameras(placed)
        if time.monotonic() - self._last_panel > 1 / PANEL_RATE:
            self._last_panel = time.monotonic()
            self._status.content = status(first, headline, self._model, self._names)
        self._draw_plots([run.window for run in runs], now)

    def _draw_plots(self, windows, now):
        if time.monotonic() - self._last_plot > 1 / PLOT_RATE:
            self._last_plot = time.monotonic()
            # A chart that is opened during a pause draws its time axis only when the data change.
            self._nudge = NUDGE - self._nudge
            for plot, (wanted, handle) in zip(PLOTS, self._plots, strict=True):
                data = window(plot, windows, now) if wanted.value else None
                handle.visible = data is not None
                if data is not None:
                    data[0][0] += self._nudge
                    handle.data = data

    def refresh(self) -> None:
        """Let the next call of :meth:`show` update panel and plots too."""
        self._last_panel = self._last_plot = -np.inf

    @property
    def settling(self) -> bool:
        """Whether a browser connected a short time ago."""
        return time.monotonic() < self._newcomer + SETTLING

    def _move_cameras(self, placed):
        if not self._follow.value or placed is None:
            self._followed = None
            return
        if self._followed is not None:
            moved = placed[0] - self._followed
            for client in self.server.get_clients().values():
                with contextlib.suppress(AttributeError, AssertionError):  # just connected
                    camera = client.camera
                    camera.position, camera.look_at = (camera.position + moved,
                                                       camera.look_at + moved)
        self._followed = placed[0].copy()

    def notify(self, title: str, text: str, colour: str = 'red') -> None:
        """Show a notification in all browsers."""
        for client in self.server.get_clients().values():
            client.add_notification(title, text, color=colour, auto_close_seconds=8.0)

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()


def _apart(row, prefix):
    """Distance [m], [deg] of body and 'estimate_' or 'target_'; NaN if one is unknown."""
    body, other = pose(row), pose(row, prefix)
    if body is None or other is None:
        return np.nan, np.nan
    return (float(np.linalg.norm(body[0] - other[0])),
            float(np.degrees(rotations.geodesic_angle(body[1], other[1]))))


def _place(handle, placed, shift=(0, 0, 0)):
    """Show a handle at a pose, or hide it without one."""
    handle.visible = placed is not None
    if placed is not None:
        handle.position = placed[0] + shift


def status(run: Shown, headline: str, model: Model, names: list[str]) -> str:
    """Return the HTML of the status: state, errors, faults, battery and joint angles."""
    lines = [f'<b>{html.escape(headline)}</b>']
    if len(names) > 1:
        lines.append('<div style="font-size:.85em">' + ' &nbsp; '.join(
            f'<span style="color:{colour(k)}">&#9632;</span> {html.escape(name)}'
            for k, name in enumerate(names)) + '</div>')
    voltage, current = known(run.row, 'voltage'), known(run.row, 'current')
    entries = [('state', html.escape(run.state or 'unknown'))]
    for name, prefix, word in (('off target', 'target_', ''), ('estimate', 'estimate_', ' off')):
        away, angle = _apart(run.row, prefix)
        if np.isfinite(away):
            entries.append((name, f'{away:.3f} m, {angle:.1f}&deg;{word}'))
    if voltage is not None:
        text = f'{voltage[0]:.1f} V'
        if current is not None:
            text += f', {-current[0]:.0f} A'
        entries.append(('battery', text))
    faults = run.faults or {}
    entries.append(('faults', '<span style="color:#e03131;font-weight:600">' + html.escape(
        ', '.join(faults)) + '</span>' if faults else 'none'))
    rows = ''.join(f'<tr><td style="opacity:.65;padding-right:.8em">{key}</td>'
                   f'<td>{value}</td></tr>' for key, value in entries)
    lines.append(f'<table style="font-size:.85em;line-height:1.45">{rows}</table>')
    lines.append(_winding(run.row, model))
    return f'<div style="padding:.2em .9em .3em">{"".join(lines)}</div>'


def _winding(row, model):
    """HTML of a bar for each tilt joint: angle between the limits, and command as a line."""
    tilt, command = known(row, 'tilt'), known(row, 'tilt_command')
    bars = []
    for k, name in enumerate(JOINT_NAMES):
        low, high = model.limits.get(name, (-np.pi, np.pi))
        if tilt is None:
            continue
        ends = [tilt[k], tilt[k] if command is None else command[k]]
        share = 100 * (np.clip(ends, low, high) - low) / (high - low)
        left, width = min(share[0], 50.0), abs(share[0] - 50.0)
        colour = '#e03131' if abs(share[0] - 50) > 42 else COLOURS[k]
        bars.append(
            f'<div style="display:flex;align-items:center;gap:.5em;font-size:.8em">'
            f'<span style="opacity:.65;width:4.4em">{name}</span>'
            f'<span style="position:relative;flex:1;height:.55em;border-radius:3px;'
            f'background:rgba(128,128,128,.22)">'
            f'<span style="position:absolute;left:{left:.1f}%;width:{width:.1f}%;height:100%;'
            f'background:{colour}"></span>'
            f'<span style="position:absolute;left:{share[1]:.1f}%;width:2px;top:-2px;'
            f'bottom:-2px;background:currentColor"></span></span>'
            f'<span style="width:3.6em;text-align:right">{np.degrees(tilt[k]):.0f}&deg;</span>'
            f'</div>')
    return ''.join(bars)
