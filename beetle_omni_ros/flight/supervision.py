"""The supervisor as a component."""

from collections.abc import Callable, Sequence
from functools import partial
import math
import secrets

import numpy as np

from beetle_omni_ros.control.base import State
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.flight.component import Component, ERROR, IDENTITY, OK, WARN
from beetle_omni_ros.flight.estimator import SENSOR_AGE
from beetle_omni_ros.model.mode import FALLBACK, FLYING, STOPPED
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor.events import Answer, Event
from beetle_omni_ros.supervisor.parameters import SupervisorParameters
from beetle_omni_ros.supervisor.supervisor import Supervisor

# [s] between checks while nothing triggers a step, and without a trigger until they begin. The
# triggers are commands in flight, otherwise estimates: steps do not depend on a timer's phase.
WATCH_PERIOD, WATCH_AFTER = 0.01, 0.015
REQUESTS = ('arm', 'disarm', 'land', 'emergency_stop')
BRIDGES = ('joint', 'rotor')


class SupervisorComponent(Component):
    """
    Publishes command, the only topic that actuators execute, and supervisor/state (latched).

    Services ~/arm, ~/disarm, ~/land and ~/emergency_stop; :meth:`select` selects the active
    controller, also in flight. ``on_event`` gets each event.
    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 controllers: Sequence[str], on_event: Callable[[Event], None] | None = None):
        super().__init__('supervisor_node')
        self._sensors, self._on_event = robot.sensors, on_event
        self.supervisor = supervisor = Supervisor(parameters, robot, HoverController(robot),
                                                  controllers)
        self._joints = None
        self._sent = (None, '')     # stamp and source of the last command
        self._triggered = -math.inf     # time of the last step by a message [s]
        self._identity_sent = f'supervisor_node:{secrets.token_hex(4)}'     # of this run
        self.writes('command', IDENTITY, 'supervisor/state', 'supervisor/target',
                    'supervisor/actuators')
        self.reads('odom', self._on_odom)
        self.reads('joint_states', self._on_joints, max_age=SENSOR_AGE)
        self.reads('imu/data_raw', lambda s: supervisor.on_imu(
            s.stamp, s.specific_force, s.angular_velocity), max_age=SENSOR_AGE)
        self.reads('mocap/pose', lambda s: supervisor.on_mocap(
            s.stamp, s.position, s.quaternion), max_age=SENSOR_AGE)
        self.reads('rotor_states', lambda r: supervisor.on_rotors(r.stamp, r.speed),
                   expected=False)
        self.reads('battery_state', lambda battery: supervisor.on_battery(battery.voltage))
        for name in controllers:
            self.reads(f'{name}/command', partial(self._on_command, name), expected=False)
        for name in BRIDGES:
            self.follows(f'{name}_bridge/state', partial(self._on_bridge, name))
        for name in REQUESTS:
            self.services[name] = partial(self.request, name)
        self.report('supervisor', self._supervisor_status)
        self.every(WATCH_PERIOD, self._watch)

    def start(self) -> None:
        """Publish identity and state."""
        self.send(IDENTITY, self._identity_sent)
        self.step()

    def select(self, controller: str) -> Answer:
        """Select another controller."""
        answer = self.supervisor.select(controller, self.host.now())
        self._publish_states()
        return answer

    def request(self, name: str) -> Answer:
        """Answer one of REQUESTS."""
        answer = getattr(self.supervisor, name)(self.host.now())
        self.step()
        return answer

    def _on_joints(self, joints):
        joints = joints.corrected(self._sensors)
        if not np.isnan(joints.position).any():
            self._joints = joints
        self.supervisor.on_joints(joints.stamp, joints.position, joints.velocity)

    def _on_odom(self, odom):
        if self._joints is None:
            return
        now = self.host.now()
        self.supervisor.on_state(State.join(odom, self._joints), now)
        if self.supervisor.state != FLYING:     # the fallback controller answers each estimate
            self._triggered = now
            self.step()

    def _watch(self):
        if not 0 <= self.host.now() - self._triggered < WATCH_AFTER:
            self.step()

    def _on_command(self, name, command):
        supervisor, now = self.supervisor, self.host.now()
        accepted = supervisor.on_command(name, command, now)
        if accepted and name == supervisor.active and supervisor.state == FLYING:
            self._triggered = now
            self.step()

    def _on_bridge(self, name, text):
        self.supervisor.on_actuators(name, text, self.host.now())
        self.step()

    def step(self) -> None:
        """Publish the command, if it is a new one, and changed states."""
        supervisor = self.supervisor
        command = supervisor.update(self.host.now())
        # A command is not repeated: the actuators detect missing commands by the age.
        if command is not None and (command.stamp, supervisor.source) != self._sent:
            self._sent = (command.stamp, supervisor.source)
            self.send('command', command, self._identity_sent)
        self._publish_states()

    def _publish_states(self):
        supervisor = self.supervisor
        self.update('supervisor/state', supervisor.mode)
        self.update('supervisor/target', supervisor.target_override)
        self.update('supervisor/actuators', supervisor.health)
        for event in supervisor.events:
            self.host.log(event.severity, event.text)
            if self._on_event:
                self._on_event(event)
        supervisor.events.clear()

    def _supervisor_status(self):
        supervisor = self.supervisor
        level = {FALLBACK: WARN, STOPPED: ERROR}.get(
            supervisor.state, WARN if supervisor.faults else OK)
        named = ', '.join(supervisor.faults)
        state = self.newest['supervisor/state']
        return level, f'{state}; faults: {named}' if named else state, \
            supervisor.diagnostics()
