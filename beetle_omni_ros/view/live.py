"""A running graph in 3D, with targets and controller selection by the user."""

from collections.abc import Callable
import threading
from typing import Any, Protocol

import numpy as np
import viser

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.log import FAULT_KEY, Recorder
from beetle_omni_ros.runs.targets import TargetChecks
from beetle_omni_ros.view.moments import Moment, target_at
from beetle_omni_ros.view.scene import Room, wxyz

RATE = 30.0             # [Hz]
WAITING = 'waiting for odom or ground_truth/odom'
LOW, HIGH = np.array([-1.8, -1.8, 0.0]), np.array([1.8, 1.8, 2.0])      # [m] seen at the start


class Graph(Protocol):
    """Interface of a running graph for the page."""

    def take(self, newest: 'Newest') -> None:
        """Pass on the messages since the last call."""

    def controllers(self) -> list[str]:
        """Return the names of the controllers in the graph."""

    def publish_target(self, target: PoseTarget) -> None:
        """Publish a target pose."""

    def select(self, controller: str, answer: Callable[[str], None]) -> None:
        """Select a controller; calls ``answer`` with the reason of a refusal, or ''."""


class Newest(Recorder):
    """
    Newest value of each topic.

    Attributes:
        values: topic -> value.
        statuses: name -> newest diagnostic status.

    """

    def __init__(self):
        self.values: dict[str, Any] = {}
        self.statuses: dict[str, Any] = {}

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """Keep one value."""
        if topic == 'diagnostics':
            self.statuses.update((status.name, status) for status in value)
        else:
            self.values[topic] = value

    @property
    def clock(self) -> float:
        """Stamp of the newest pose [s]; 0 before the first."""
        body = self._body()
        return 0.0 if body is None else body.stamp

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
        targets = sorted((values[topic] for topic in ('target_pose', 'target_trajectory')
                          if topic in values), key=lambda target: target.stamp)
        if targets:
            made.target = target_at(targets[-1:], max(self.clock, targets[-1].stamp))
        return made

    def text(self, moment: Moment) -> str:
        """Return state, errors, battery, faults and warnings as Markdown."""
        lines = [f'**{self.clock:.1f} s**', moment.text()]
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
        return '\n\n'.join(lines)


class Live:
    """
    Draws a graph as it runs.

    Args:
        server: server of the page.
        graph: graph to display.
        robot: robot parameters for the checks of targets.
        allow_targets: whether the page has controls for targets and the controller.

    """

    def __init__(self, server: viser.ViserServer, graph: Graph, robot: RobotParameters,
                 allow_targets: bool):
        self._server, self._graph, self._newest = server, graph, Newest()
        self._checks, self._stop = TargetChecks(robot), threading.Event()
        self._room, self._dragging, self._gizmo = Room(server), False, None
        self._room.look_at(LOW, HIGH)
        self._text = server.gui.add_markdown(WAITING)
        if allow_targets:
            self._controller = server.gui.add_dropdown('controller', ('-',), initial_value='-')
            self._controller.on_update(self._on_controller)
            self._gizmo = server.scene.add_transform_controls(
                '/wanted', scale=0.55, line_width=3.0, depth_test=False, visible=False)
            self._gizmo.on_update(self._on_gizmo)

    def run(self) -> None:
        """Draw until :meth:`stop`."""
        while not self._stop.wait(1 / RATE):
            self.step()

    def stop(self) -> None:
        """End :meth:`run`."""
        self._stop.set()

    def step(self) -> None:
        """Process new messages and draw."""
        self._graph.take(self._newest)
        moment = self._newest.moment()
        if moment is None:
            return
        with self._server.atomic():
            self._room.show([moment], [''])
            text = self._newest.text(moment)
            if self._text.content != text:
                self._text.content = text
            if self._gizmo is not None:
                self._update_controls(moment)

    def _update_controls(self, moment):
        names = ('-', *self._graph.controllers())
        kind, _, flying = moment.state.partition(':')
        if names != tuple(self._controller.options):
            self._controller.options = names
        if kind == 'flying' and flying in names and self._controller.value != flying:
            self._controller.value = flying
        self._gizmo.visible = True
        if not self._dragging:
            position, quaternion = moment.target or (moment.position, moment.quaternion)
            self._gizmo.position, self._gizmo.wxyz = position, wxyz(quaternion)

    async def _on_gizmo(self, event):   # a coroutine: viser then keeps the order of events
        self._dragging = event.phase != 'end'
        if self._dragging:
            return
        # Stamp by the flight's clock, so that the target is newer than previous ones.
        target = PoseTarget(np.array(event.target.position), rotations.normalized(
            np.roll(event.target.wxyz, -1)), self._newest.clock)
        if reason := self._checks.why_not(target, None):
            self._notify('target not sent', reason)
        else:
            self._graph.publish_target(target)

    def _on_controller(self, event):
        name = self._controller.value
        if event.client is not None and name != '-':    # not set by this page itself
            self._graph.select(name, lambda reason: self._notify(
                name, reason or 'the supervisor agrees'))

    def _notify(self, title, text):
        for client in self._server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=8.0)
