"""A controller as a component: when it steps, and which target it follows."""

from dataclasses import replace
from functools import partial
import math

import numpy as np

from beetle_omni_ros.bags.messages import MessageError
from beetle_omni_ros.bags.topics import TARGETS
from beetle_omni_ros.control.base import (
    Controller,
    ControllerHost,
    guidance_of,
    PoseTarget,
    State,
)
from beetle_omni_ros.control.targets import TargetChecks
from beetle_omni_ros.flight.component import Component, ERROR, OK
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor.events import ERROR as SEVERE

ODOM_AGE = 0.05         # [s] no command answers an older estimate
JOINT_AGE = 0.1         # [s]
REPEAT = 1.0            # [s] between two log lines about a controller
STEP_TOLERANCE = 0.0025     # [s] half of the smallest interval between estimates
CANNOT_BE_FLOWN = 'cannot be flown'     # kind of a refused target


class ControllerComponent(Component):
    """Steps a controller once a period, triggered by the estimate; see ControllerHost."""

    def __init__(self, name: str, controller: Controller, robot: RobotParameters):
        super().__init__(f'{name}_node')
        self.stepper = ControllerHost(name, controller, self.took, self._on_error)
        self._command_topic = f'{name}/command'
        self._checks, self._sensors = TargetChecks(robot), robot.sensors
        self._joints = self._command = None
        self._last_step, self._quiet_until = -math.inf, -math.inf
        self._reported_errors = 0
        self.writes(self._command_topic)
        self.reads('odom', self._on_odom, max_age=ODOM_AGE)
        self.reads('joint_states', self._on_joints, max_age=JOINT_AGE)
        self.reads('command', partial(setattr, self, '_command'), expected=False)
        for topic in TARGETS:
            self.reads(topic, self._on_target, expected=False)
        self.follows('supervisor/state', self._on_mode)
        self.follows('supervisor/target', partial(setattr, self.stepper, 'override'))
        self.follows('supervisor/actuators', self.stepper.on_health)
        self.track_compute(controller.period)
        self.report('controller', self._controller_status)

    def _on_error(self, text):
        if self.host.elapsed() >= self._quiet_until:
            self._quiet_until = self.host.elapsed() + REPEAT
            self.host.log(SEVERE, text)

    def _on_joints(self, joints):
        if not np.isnan(joints.position).any():     # a bridge has lost a servo for the moment
            self._joints = joints.corrected(self._sensors)

    def _check_target(self, target, published):
        # The age counts at publication: a latched target stays valid for a node that starts
        # later. Publication times are system time, so simulated stamps have no age.
        then = None if self.host.simulated or math.isnan(published) else published
        reason = self._checks.why_not(target, then) or (
            self.stepper.too_far(target, self.host.now()) if self.stepper.active else '')
        if reason:
            raise MessageError(reason, CANNOT_BE_FLOWN)

    def _on_target(self, target, published):
        self._check_target(target, published)
        now = self.host.now()
        if target.stamp == 0.0:     # `ros2 topic pub` sets no stamp: valid from now on
            target = replace(target, stamp=now, **(
                {} if isinstance(target, PoseTarget) else {'times': target.times + now}))
        elif target.stamp > now:    # a clock that is ahead must not make it outlast later targets
            target = replace(target, stamp=now)
        # Latched and volatile copies may overtake each other: the newest stamp counts, except
        # after the clock was set back.
        old = self.stepper.target
        if old is None or not target.stamp < old.stamp <= now:
            self.stepper.target = target

    def _on_mode(self, mode):
        if mode.motors_off:
            self._command = None
        if reason := self.stepper.on_mode(mode, self.host.now()):
            self.reject('target_pose', f'{reason}; the present pose is held', CANNOT_BE_FLOWN)

    def _on_odom(self, odom):
        stepper = self.stepper
        stepper.on_estimate(odom)
        since = odom.stamp - self._last_step        # < 0: the clock was set back
        if self._joints is None or 0 <= since < stepper.controller.period - STEP_TOLERANCE:
            return
        self._last_step = odom.stamp
        command = stepper.step(State.join(odom, self._joints, self._command))
        if command is not None:
            self.send(self._command_topic, command)

    def _controller_status(self):
        stepper, controller = self.stepper, self.stepper.controller
        report = stepper.call('diagnostics') or {}
        new, self._reported_errors = stepper.errors - self._reported_errors, stepper.errors
        values = {**report, 'guidance': guidance_of(controller)}
        if stepper.errors:
            values['errors'] = stepper.errors
        if new:
            return ERROR, stepper.error, values
        return OK, getattr(controller, 'name', self.name.removesuffix('_node')), values
