"""A running graph in 3D."""

from itertools import count
import time
from typing import Any

import numpy as np
import viser

from beetle_omni_ros.bags.log import FAULT_KEY, Recorder
from beetle_omni_ros.bags.topics import TARGETS
from beetle_omni_ros.show.page import rendered
from beetle_omni_ros.show.scene import Moment, Room, segments, target_at

RATE = 30.0             # [Hz]
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
    """Draw a :class:`~beetle_omni_ros.ros.listeners.LiveGraph` as it runs, until Ctrl-C."""
    newest, room = Newest(), Room(server)
    label = server.scene.add_label('/label', '', anchor='bottom-center',
                                   position=(0.0, 0.0, LABEL_HEIGHT))
    server.gui.add_html(rendered('viewer.html', live=True))
    follow = server.gui.add_checkbox('Follow the robot', True)
    shown = server.gui.add_markdown('')
    trail, path = np.zeros((0, 3)), None
    for picture in count():
        time.sleep(1 / RATE)
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
