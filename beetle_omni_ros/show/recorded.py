"""Recorded runs in 3D, as one HTML text with viser's player; and a running graph."""

from collections.abc import Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
import time
from typing import Any

import numpy as np
import viser

from beetle_omni_ros.bags.bag import read_flights
from beetle_omni_ros.bags.log import FAULT_KEY, FlightLog, motion, Recorder
from beetle_omni_ros.bags.topics import TARGETS
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.show.figures import COLOURS, colours_of
from beetle_omni_ros.show.page import rendered
from beetle_omni_ros.show.scene import (
    close,
    drawable,
    Moment,
    moments,
    Room,
    segments,
    serve,
    target_at,
)
from beetle_omni_ros.show.table import title

RATE, MOST = 20.0, 4000     # [Hz] of the pictures; of all robots
TEXT_EVERY = 4              # pictures
PATH_POINTS = 800
BEFORE = 3.0                # [s] shown before the first target
LOCAL = '127.0.0.1'


def recorded_scene(logs: Mapping[str, FlightLog]) -> str:
    """Make the HTML of a player of flights by name; a ParameterError refuses one without poses."""
    for name, log in logs.items():
        if not len(motion(log)):
            raise ParameterError('; '.join([f'{name}: no pose of the robot; expected '
                                            'ground_truth/odom or odom', *log.warnings]))
    begin = max(-BEFORE, min(motion(log).t[0] - log.begin for log in logs.values()))
    end = max(motion(log).t[-1] - log.begin for log in logs.values())
    step = max(1 / RATE, (end - begin) * len(logs) / MOST)
    times = np.arange(begin, end, step)
    server = serve(LOCAL, 8080)
    try:
        room = Room(server, colours_of(logs.values()))
        paths = [drawable(motion(log).position) for log in logs.values()]
        for number, path in enumerate(paths):
            room.draw_path(number, path[::max(1, len(path) // PATH_POINTS)])
        recording = server.get_scene_serializer()
        columns = [moments(log, log.begin + times) for log in logs.values()]
        with server.atomic():       # nothing is sent in between
            for row in zip(*columns, strict=True):
                room.show(row)
                recording.insert_sleep(float(step))
        page = recording.as_html()
    finally:
        close(server)
    # Texts are HTML: a label of viser lags behind a jump, for it draws few new letters a picture.
    texts = [[moment.text() if moment else '' for moment in column[::TEXT_EVERY]]
             for column in columns]
    head = rendered('viewer.html', title=title(next(iter(logs.values())).meta), texts=texts,
                    begin=begin, every=TEXT_EVERY * step,
                    runs=zip(logs, colours_of(logs.values())))
    return page.replace('</head>', head + '</head>', 1)


def run_view(runs: list[Path], *, host: str, port: int) -> None:
    """Serve a player of recorded runs until Ctrl-C; a ParameterError reports unusable input."""
    page = recorded_scene(read_flights(runs, len(COLOURS))).encode()

    class PageHandler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header('Content-Type', 'text/html; charset=utf-8')
            self.end_headers()
            with suppress(ConnectionError):     # a browser may leave before the end
                self.wfile.write(page)

        def log_message(self, *given):
            """Print nothing."""

    try:
        server = ThreadingHTTPServer((host, port), PageHandler)
    except OSError as error:
        raise ParameterError(f'--host {host} --port {port}: cannot be served there '
                             f'({error})') from None
    announce(host, server.server_port)
    try:
        server.serve_forever()
    except KeyboardInterrupt:       # the regular end
        server.server_close()


def announce(host: str, port: int) -> None:
    """Print the address of the page."""
    shown = 'localhost' if host in (LOCAL, '0.0.0.0') else host
    print(f'http://{shown}:{port}  (Ctrl-C ends it)', flush=True)


LIVE_RATE = 30.0        # [Hz]
LABEL_HEIGHT = 0.5      # [m] above the robot
TRAIL, TRAIL_EVERY = 400, 2     # points of the path behind the robot; pictures between them


class Newest(Recorder):
    """Newest value of each topic."""

    def __init__(self):
        self.begin: float | None = None         # time 0, the first target [s]
        self.values: dict[str, Any] = {}        # topic -> value
        self.statuses: dict[str, Any] = {}      # name -> newest diagnostic status

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """Keep one value."""
        if topic == 'diagnostics':
            self.statuses.update((status.name, status) for status in value)
            return
        self.values[topic] = value
        if self.begin is None and topic in TARGETS and (value.stamp or self._body()):
            self.begin = value.stamp or self._body().stamp

    def _body(self):
        return self.values.get('ground_truth/odom', self.values.get('odom'))

    def moment(self) -> Moment | None:
        """Return what is shown now; None before the first pose."""
        body, values = self._body(), self.values
        if body is None:
            return None
        made = Moment(body.position, body.quaternion, state=values.get('supervisor/state', ''))
        if 'joint_states' in values:
            made.tilt = values['joint_states'].position
        if 'command' in values:
            made.thrust = np.nan_to_num(values['command'].thrust)
        if 'disturbance' in values:
            made.force = values['disturbance'].force
        targets = sorted((values[topic] for topic in TARGETS if topic in values),
                         key=lambda target: target.stamp)
        if targets:
            made.target = target_at(targets[-1:], max(body.stamp, targets[-1].stamp))
        return made

    def time(self) -> str:
        """Return the time since the first target, '' before it."""
        return '' if self.begin is None else f'{self._body().stamp - self.begin:.1f} s'

    def text(self, moment: Moment) -> str:
        """Return state, errors, battery, faults and warnings as Markdown."""
        lines = [self.time(), self.values.get('reference/state', ''), moment.text()]
        estimate, battery = self.values.get('odom'), self.values.get('battery_state')
        if estimate is not None and 'ground_truth/odom' in self.values:
            away = np.linalg.norm(estimate.position - moment.position)
            lines.append(f'estimate {1e3 * away:.0f} mm off')
        if battery is not None:
            lines.append(f'battery {battery.voltage:.1f} V')
        for status in self.statuses.values():
            lines += [f'**{key}**' for key in status.values if key.startswith(FAULT_KEY)]
            if status.level:
                lines.append(f'{status.name}: {status.message}')
        return '\n\n'.join(filter(None, lines))


def draw(server: viser.ViserServer, graph) -> None:
    """Draw a :class:`~beetle_omni_ros.ros.clients.LiveGraph` as it runs, until Ctrl-C."""
    server.gui.add_html(rendered('viewer.html', live=True))     # first: dark mode loads it again
    newest, room = Newest(), Room(server)
    label = server.scene.add_label('/label', '', anchor='bottom-center',
                                   position=(0.0, 0.0, LABEL_HEIGHT))
    follow = server.gui.add_checkbox('Follow the robot', True)
    shown = server.gui.add_markdown('')
    trail, path = np.zeros((0, 3)), None
    for picture in count():
        time.sleep(1 / LIVE_RATE)
        graph.take(newest)
        moment = newest.moment()
        with server.atomic():
            if moment:
                room.show([moment], follow.value)
                if label.text != moment.text():
                    label.text = moment.text()
                if path is None:
                    trail = np.tile(moment.position, (TRAIL, 1))
                    path = room.draw_path(0, trail)
                elif picture % TRAIL_EVERY == 0:
                    trail = np.vstack([trail[1:], moment.position])
                    path.points = segments(trail).astype(np.float32)
            text = newest.text(moment) if moment else graph.waits()
            if shown.content != text:
                shown.content = text
