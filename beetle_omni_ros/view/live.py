"""Display of a running graph, with targets and controller selection by the user."""

from collections.abc import Callable
import threading
import time
from typing import Protocol

import numpy as np

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.targets import TargetChecks
from beetle_omni_ros.view.drawing import wxyz
from beetle_omni_ros.view.frames import pose, Rows, Sampler, T
from beetle_omni_ros.view.page import BEHIND, moments, Page, Shown

KEPT = 60.0             # [s] of rows
ANSWER_TIME = 3.0       # [s] to wait for a refusal of a target; diagnostics come every 1 s
JUMP = 1.0              # [s] step back of the clock that indicates a new flight
WAITING = 'waiting for odom or ground_truth/odom'


class Graph(Protocol):
    """Interface of a running graph for the page."""

    def take(self, sampler: Sampler) -> None:
        """Pass on the messages since the last call."""

    def controllers(self) -> list[str]:
        """Return the names of the controllers in the graph."""

    def publish_target(self, target: PoseTarget) -> None:
        """Publish a target pose."""

    def select(self, controller: str, answer: Callable[[str], None]) -> None:
        """Select a controller; calls ``answer`` with the reason of a refusal, or ''."""


class Live:
    """
    Draws a graph as it runs.

    Args:
        page: page for one run.
        graph: graph to display.
        robot: robot parameters for the checks of targets.
        allow_targets: whether the page has controls for targets and the controller.

    """

    def __init__(self, page: Page, graph: Graph, robot: RobotParameters, allow_targets: bool):
        self._page, self._graph = page, graph
        self._checks = TargetChecks(robot)
        self._sampler, self._rows = Sampler(), Rows(KEPT)
        self._begin: float | None = None
        self._stop = threading.Event()
        self._pending: tuple[float, PoseTarget | None] | None = None
        self._requested: PoseTarget | None = None   # set by the page, published by the next step
        self._dragging = False
        self._gizmo = None
        gui = page.server.gui
        with page.controls:
            self._text = gui.add_markdown(WAITING)
            if allow_targets:
                self._controller = gui.add_dropdown('controller', ('-',), initial_value='-')
                self._controller.on_update(self._on_controller)
                self._position = gui.add_vector3('target [m]', (0.0, 0.0, 1.0), step=0.05)
                self._angles = gui.add_vector3('roll pitch yaw [deg]', (0.0, 0.0, 0.0), step=5.0)
                gui.add_button('fly there').on_click(lambda _: self._send(
                    np.array(self._position.value), rotations.from_rpy(
                        *np.radians(self._angles.value))))
        if allow_targets:
            self._gizmo = page.server.scene.add_transform_controls(
                '/wanted', scale=0.55, line_width=3.0, depth_test=False, visible=False)
            self._gizmo.on_update(self._on_gizmo)

    def run(self) -> None:
        """Draw until :meth:`stop`."""
        for _, passed in moments(self._stop):
            self.step(passed)

    def stop(self) -> None:
        """End :meth:`run`."""
        self._stop.set()

    def step(self, passed: float) -> None:
        """Process new messages and draw; ``passed`` is the time since the last step [s]."""
        sampler = self._sampler
        self._publish()
        self._graph.take(sampler)
        self._check_refusal()
        if not sampler.placed:
            return
        if len(self._rows) and sampler.clock < self._rows.times[-1] - JUMP:
            self._rows, self._begin = Rows(KEPT), None
        row = sampler.row(sampler.clock)
        self._rows.append(row[None])
        if self._begin is None:
            self._begin = sampler.clock
        now = sampler.clock - self._begin
        window = self._rows.window(sampler.clock - 2 * BEHIND, np.inf).copy()
        window[:, T] -= self._begin
        state = sampler.states[-1][1] if sampler.states else ''
        self._page.show([Shown(row, window, state, sampler.faults)], now, passed,
                        f'live: {now:.1f} s')
        self._update_controls(state, row)

    def _update_controls(self, state, row):
        text = 'live'
        if self._gizmo is not None:
            text = 'drag the target, or give numbers'
            names = ('-', *self._graph.controllers())
            flying = state.partition(':')[2] if state.startswith('flying:') else ''
            if names != tuple(self._controller.options):
                self._controller.options = names
            if flying in names and self._controller.value != flying:
                self._controller.value = flying
            self._place_gizmo(pose(row, 'target_') or pose(row))
        if self._text.content != text:
            self._text.content = text

    # -- controls --------------------------------------------------------------------------

    def _place_gizmo(self, placed):
        self._gizmo.visible = True
        if not self._dragging and self._pending is None:
            self._gizmo.position, self._gizmo.wxyz = placed[0], wxyz(placed[1])

    async def _on_gizmo(self, event):   # a coroutine: viser then keeps the order of events
        self._dragging = event.phase != 'end'
        position = np.array(event.target.position)
        quaternion = np.roll(np.array(event.target.wxyz), -1)
        self._position.value = tuple(round(float(x), 3) for x in position)
        self._angles.value = tuple(round(float(x), 1)
                                   for x in np.degrees(rotations.to_rpy(quaternion)))
        if event.phase == 'end':
            self._send(position, quaternion)

    def _send(self, position, quaternion):
        """Request a target pose if it is valid; the nodes may still refuse it."""
        # Stamp by the flight's clock, so that the target is newer than previous ones.
        target = PoseTarget(position, rotations.normalized(quaternion),
                            float(np.nan_to_num(self._sampler.clock)))
        if reason := self._checks.why_not(target, None):
            self._page.notify('target not sent', reason)
            return
        self._requested = target

    def _publish(self):
        """Publish the requested target; in the drawing thread, which owns the sampler."""
        target, self._requested = self._requested, None
        if target is not None:
            self._pending = (time.monotonic(), self._sampler.target)
            self._sampler.input_warnings.clear()
            self._sampler.target = target
            self._graph.publish_target(target)

    def _check_refusal(self):
        if self._pending is None:
            self._sampler.input_warnings.clear()
            return
        at, before = self._pending
        for status, text in self._sampler.input_warnings:
            if 'target_pose' in text and 'rejected' in text:
                self._page.notify('target refused', f'{status}: {text}')
                self._sampler.target, self._pending = before, None
                return
        if time.monotonic() - at > ANSWER_TIME:
            self._pending = None

    def _on_controller(self, event):
        name = self._controller.value
        if event.client is None or name == '-':     # set by this page itself
            return

        def answer(reason):
            if reason:
                self._page.notify(f'{name} refused', reason)
            else:
                self._page.notify(f'{name} selected', 'the supervisor agrees', 'green')
        self._graph.select(name, answer)
