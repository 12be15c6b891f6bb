"""Faults of the flight stack's processes, for the in-process loop."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.sim.faults.base import Effect, Frozen, Late, Number, vector


class ProcessEffect(Effect):
    """Effect of a fault of a process; the loop calls the hooks."""

    process = True
    clock_step = 0.0                        # [s] error of the flight computer's clock
    supervisor_waits = False                # whether the supervisor is not scheduled
    bridges: dict[str, str] = {}            # bridge -> its reported state

    def estimate(self, state):
        """Return the changed estimate, or None."""
        return state

    def request(self, command, now) -> list:
        """Return the commands of the active controller that arrive now; also called with None."""
        return [] if command is None else [command]

    def target(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Position [m] and quaternion in world of another target, or None."""
        return None


class ClockJumps(ProcessEffect, kind='clock_jumps'):
    """The clock of the flight computer jumps."""

    numbers = {'step': Number('jump of the clock', 's', low=-100, high=100)}

    @property
    def clock_step(self):
        return self._numbers['step']


class EstimatorDead(ProcessEffect, kind='estimator_dead'):
    """The estimator publishes nothing."""

    def estimate(self, state):
        return None


class EstimatorDiverges(ProcessEffect, kind='estimator_diverges'):
    """The errors of position and velocity grow along world x."""

    numbers = {'acceleration': Number('acceleration of the error', 'm/s^2', 1.0, 0, 1000)}
    _time = 0.0

    def estimate(self, state):
        self._time += self._tick
        gain = self._numbers['acceleration']
        away = np.array([1.0, 0.0, 0.0])
        return replace(state, position=state.position + 0.5 * gain * self._time ** 2 * away,
                       velocity=state.velocity + gain * self._time * away)


class EstimatorNan(ProcessEffect, kind='estimator_nan'):
    """The estimator publishes NaN."""

    def estimate(self, state):
        return replace(state, position=np.full(3, np.nan))


class EstimatorRubbish(ProcessEffect, kind='estimator_rubbish'):
    """The estimator publishes random states."""

    def estimate(self, state):
        row = self._random.standard_normal(13)
        return replace(state, position=3 * row[:3], velocity=3 * row[3:6],
                       quaternion=rotations.normalized(row[6:10]), angular_velocity=3 * row[10:])


class EstimatorFrozen(Frozen, ProcessEffect, kind='estimator_frozen'):
    """The estimator publishes the same state with new stamps."""

    def estimate(self, state):
        return self._change(state)


class ControllerSilent(ProcessEffect, kind='controller_silent'):
    """The active controller publishes nothing."""

    def request(self, command, now):
        return []


class _CommandEffect(ProcessEffect):
    """Changes each command of the active controller."""

    def request(self, command, now):
        return [] if command is None else [self._change(command)]


class ControllerNan(_CommandEffect, kind='controller_nan'):
    """The active controller commands NaN."""

    def _change(self, command):
        return replace(command, thrust=np.full(4, np.nan))


class ControllerRubbish(_CommandEffect, kind='controller_rubbish'):
    """The active controller commands random tilts within 3 rad and thrusts up to 20 N."""

    def _change(self, command):
        return replace(command, tilt=self._random.uniform(-3, 3, 4),
                       thrust=self._random.uniform(0, 20, 4))


class ControllerConstant(Frozen, _CommandEffect, kind='controller_constant'):
    """The active controller repeats one command with new stamps."""


class ControllerNoisy(_CommandEffect, kind='controller_noisy'):
    """The commands of the active controller have white noise."""

    numbers = {'tilt': Number('standard deviation', 'rad', 0.0, 0, 3),
               'thrust': Number('standard deviation', 'N', 0.0, 0, 20)}

    def _change(self, command):
        tilt, thrust = self._random.standard_normal((2, 4))
        return replace(command, tilt=command.tilt + self._numbers['tilt'] * tilt,
                       thrust=np.maximum(command.thrust + self._numbers['thrust'] * thrust, 0.0))


class ControllerSlow(Late, ProcessEffect, kind='controller_slow'):
    """The commands of the active controller are late, with correct stamps."""

    def request(self, command, now):
        return self._delayed(command, now)


class SupervisorWaits(ProcessEffect, kind='supervisor_waits'):
    """The supervisor is not scheduled; the newest ten messages of each topic wait."""

    supervisor_waits = True


class Target(ProcessEffect, kind='target'):
    """Another program publishes a target pose in world."""

    numbers = {**vector('m', 'in world', x=0.0, y=0.0, z=1.0),
               **vector('rad', 'in world', roll=0.0, pitch=0.0, yaw=0.0)}

    def target(self):
        n = self._numbers
        return (np.array([n['x'], n['y'], n['z']]),
                rotations.from_rpy(n['roll'], n['pitch'], n['yaw']))


class MotorBoardLost(ProcessEffect, kind='motor_board_lost'):
    """The rotor bridge reports 'lost'."""

    bridges = {'rotor': 'lost: motor board silent'}


class ServoBusLost(ProcessEffect, kind='servo_bus_lost'):
    """The joint bridge reports 'lost'."""

    bridges = {'joint': 'lost: a servo is silent'}
