"""Recorded runs in 3D: one HTML text with viser's player, which needs no network."""

from collections.abc import Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from beetle_omni_ros.bags.bag import read_flights
from beetle_omni_ros.bags.log import FlightLog, motion
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.show.figures import COLOURS, colours_of
from beetle_omni_ros.show.page import rendered
from beetle_omni_ros.show.scene import close, drawable, moments, Room, serve
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
