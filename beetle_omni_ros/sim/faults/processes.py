"""Faults of the flight stack's processes, for a loop that runs them in one process."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.sim.faults.base import Effect, kind, Late, Number, vector


class ProcessEffect(Effect):
    """What a fault of a process does while it is on; the loop calls the hooks."""

    process = True
    clock_step = 0.0                        # by which the flight computer's clock is off [s]
    supervisor_waits = False                # the supervisor is not scheduled
    bridges: dict[str, str] = {}            # bridge -> what it says of itself

    def estimate(self, state):
        """What the estimator tells; None: nothing."""
        return state

    def request(self, command, now) -> list:
        """Commands of the active controller that arrive now; also called with None."""
        return [] if command is None else [command]

    def target(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Position [m] and quaternion in world that somebody else asks for, or None."""
        return None


@kind('clock_jumps')
class ClockJumps(ProcessEffect):
    """The flight computer's clock is set."""

    numbers = {'step': Number('by which', 's', low=-100, high=100)}

    @property
    def clock_step(self):
        return self._numbers['step']


@kind('estimator_dead')
class EstimatorDead(ProcessEffect):
    """The estimator gives nothing."""

    def estimate(self, state):
        return None


@kind('estimator_diverges')
class EstimatorDiverges(ProcessEffect):
    """The estimated position and velocity run away along world x."""

    numbers = {'acceleration': Number('of the error', 'm/s^2', 1.0, 0, 1000)}
    _time = 0.0

    def estimate(self, state):
        self._time += self._tick
        gain = self._numbers['acceleration']
        away = np.array([1.0, 0.0, 0.0])
        return replace(state, position=state.position + 0.5 * gain * self._time ** 2 * away,
                       velocity=state.velocity + gain * self._time * away)


@kind('estimator_nan')
class EstimatorNan(ProcessEffect):
    """The estimator gives NaN."""

    def estimate(self, state):
        return replace(state, position=np.full(3, np.nan))


@kind('estimator_rubbish')
class EstimatorRubbish(ProcessEffect):
    """The estimator gives a random state each time."""

    def estimate(self, state):
        row = self._random.standard_normal(13)
        return replace(state, position=3 * row[:3], velocity=3 * row[3:6],
                       quaternion=rotations.normalized(row[6:10]), angular_velocity=3 * row[10:])


@kind('estimator_frozen')
class EstimatorFrozen(ProcessEffect):
    """The estimator gives the same state with new stamps."""

    _first = None

    def estimate(self, state):
        self._first = self._first or state
        return replace(self._first, stamp=state.stamp)


@kind('controller_silent')
class ControllerSilent(ProcessEffect):
    """The active controller gives nothing."""

    def request(self, command, now):
        return []


class _Answer(ProcessEffect):
    """Changes each command of the active controller."""

    def request(self, command, now):
        return [] if command is None else [self._change(command)]


@kind('controller_nan')
class ControllerNan(_Answer):
    """The active controller gives NaN."""

    def _change(self, command):
        return replace(command, thrust=np.full(4, np.nan))


@kind('controller_rubbish')
class ControllerRubbish(_Answer):
    """The active controller gives random tilts within 3 rad and thrusts within 20 N."""

    def _change(self, command):
        return replace(command, tilt=self._random.uniform(-3, 3, 4),
                       thrust=self._random.uniform(0, 20, 4))


@kind('controller_constant')
class ControllerConstant(_Answer):
    """The active controller gives the same command with new stamps."""

    _first = None

    def _change(self, command):
        self._first = self._first or command
        return replace(self._first, stamp=command.stamp)


@kind('controller_noisy')
class ControllerNoisy(_Answer):
    """The active controller shakes: white noise on its commands, standard deviations."""

    numbers = {'tilt': Number('noise', 'rad', 0.0, 0, 3),
               'thrust': Number('noise', 'N', 0.0, 0, 20)}

    def _change(self, command):
        tilt, thrust = self._random.standard_normal((2, 4))
        return replace(command, tilt=command.tilt + self._numbers['tilt'] * tilt,
                       thrust=np.maximum(command.thrust + self._numbers['thrust'] * thrust, 0.0))


@kind('controller_slow')
class ControllerSlow(Late, ProcessEffect):
    """The active controller answers late, with the stamps of the states that it answers."""

    numbers = {'delay': Number('of its answers', 's', low=0, high=5)}

    def request(self, command, now):
        return self._arrived(command, now)


@kind('supervisor_waits')
class SupervisorWaits(ProcessEffect):
    """The supervisor is not scheduled; the newest ten messages of each topic wait."""

    supervisor_waits = True


@kind('target')
class Target(ProcessEffect):
    """Somebody asks for a pose in world."""

    numbers = {**vector('m', 'in world', x=0.0, y=0.0, z=1.0),
               **vector('rad', 'in world', roll=0.0, pitch=0.0, yaw=0.0)}

    def target(self):
        n = self._numbers
        return (np.array([n['x'], n['y'], n['z']]),
                rotations.from_rpy(n['roll'], n['pitch'], n['yaw']))


@kind('motor_board_lost')
class MotorBoardLost(ProcessEffect):
    """The rotor bridge says 'lost'."""

    bridges = {'rotor': 'lost: motor board silent'}


@kind('servo_bus_lost')
class ServoBusLost(ProcessEffect):
    """The joint bridge says 'lost'."""

    bridges = {'joint': 'lost: a servo is silent'}
