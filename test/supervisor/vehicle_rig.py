"""A kinematic vehicle for tests of the state machine, which the test moves."""

from copy import deepcopy
from functools import cache

import numpy as np

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor.interface import SupervisorParameters
from beetle_omni_ros.supervisor.supervisor import Supervisor

ROBOT = RobotParameters.load()
PARAMETERS = SupervisorParameters.load()
ALLOCATOR = Allocator(ROBOT)
TICK = 0.01
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
ALL = ('estimate', 'joints', 'imu', 'mocap', 'nmpc', 'rl')


def hover_command(stamp, quaternion=LEVEL):
    """A plausible command with noise, so that no two are equal."""
    hover = ALLOCATOR.hover(quaternion, np.zeros(4))
    return Command(stamp, hover.tilt, hover.thrust + 1e-9 * np.sin(1e3 * stamp))


class VehicleRig:
    """Supervisor with all its message sources; those in ``alive`` publish."""

    def __init__(self):
        self.supervisor = Supervisor(PARAMETERS, ROBOT, HoverController(ROBOT))
        self.now = 100.0
        self.alive = set(ALL)
        self.position, self.velocity = np.array([0.3, -0.2, 0.16]), np.zeros(3)
        self.quaternion, self.rate = LEVEL, np.zeros(3)
        self.voltage = 24.0
        self.age = dict.fromkeys(ALL, 0.0)      # of estimates and commands [s]
        self.lifts = True           # whether takeoff moves it
        self.command = None
        self.thrust = np.zeros(4)
        self.sent = []

    def run(self, duration):
        """Simulate a time; return the sent commands."""
        sent = []
        for _ in range(round(duration / TICK)):
            self.now += TICK
            self._publish()
            self.command = self.supervisor.update(self.now)
            sent.append(self.command)
            if self.supervisor.state == 'takeoff' and self.lifts \
                    and self.command is not None and self.command.thrust.sum() > 10:
                self.position = np.array([0.3, -0.2, min(1.0, self.position[2] + 0.01)])
        return sent

    def fly(self):
        """Arm and get to 'flying'."""
        self.run(0.6)
        answer = self.supervisor.arm(self.now)
        assert answer, answer.text
        for _ in range(100):
            self.run(0.1)
            if self.supervisor.state == 'flying':
                return self
        raise AssertionError(f'never flew: {self.supervisor.inputs.events}')

    def texts(self, severity=None):
        """All event texts, of one severity."""
        return [e.text for e in self.supervisor.inputs.events if severity in (None, e.severity)]

    def _specific_force(self, tilt):
        """Specific force: of the rotors in the air, of the ground on the floor."""
        asked = self.command.thrust if self.command is not None else np.zeros(4)
        self.thrust += -np.expm1(-TICK / ROBOT.rotors.time_constant) * (asked - self.thrust)
        if self.supervisor.inputs.airborne:
            return ALLOCATOR.wrench(tilt, self.thrust)[0] / ALLOCATOR.mass
        return np.array([0, 0, ROBOT.gravity])

    def _publish(self):
        supervisor, alive = self.supervisor, self.alive
        tilt = self.command.tilt if self.command is not None else np.zeros(4)
        if 'imu' in alive:
            noise = 1e-6 * np.sin(1e3 * self.now + np.arange(6))   # readings have noise
            supervisor.inputs.on_imu(self.now, self._specific_force(tilt) + noise[:3],
                              self.rate + noise[3:])
        if 'mocap' in alive:
            noise = 1e-6 * np.array([round(self.now / TICK) % 2, 0, 0])
            supervisor.inputs.on_mocap(self.now - 0.01, self.position + noise, self.quaternion)
        stamp = self.now - 0.01 if 'joints' in alive else np.nan
        if 'joints' in alive:
            supervisor.inputs.on_joints(stamp, tilt, np.zeros(4))
        if 'estimate' in alive:
            noise = 1e-9 * np.sin(1e3 * self.now + np.arange(3))    # no two estimates are equal
            supervisor.inputs.on_state(State(
                self.now - self.age['estimate'], self.position + noise, self.velocity,
                self.quaternion, self.rate, tilt, np.zeros(4), stamp), self.now)
        supervisor.inputs.on_battery(self.voltage)
        for name in ('nmpc', 'rl'):
            if name in alive:
                supervisor.inputs.on_command(name, hover_command(self.now - self.age[name],
                                                          self.quaternion), self.now)


def flown():
    """A copy of a vehicle in state 'flying'; the take-off is simulated once."""
    return deepcopy(_flown())


@cache
def _flown():
    return VehicleRig().fly()
