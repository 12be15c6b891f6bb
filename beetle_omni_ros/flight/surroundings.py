"""What surrounds the flight stack as components: the simulated robot, the source of targets."""

from collections.abc import Callable
from functools import partial
from math import degrees

import numpy as np

from beetle_omni_ros.bags.messages import MessageError, Wrench
from beetle_omni_ros.bags.topics import SENSOR
from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.control.tasks import Task, TaskPlayer, WITH_WRENCHES
from beetle_omni_ros.flight.component import Component, Distribution, ERROR, OK, WARN
from beetle_omni_ros.model.mode import COMMAND_AGE, FLYING, LANDING
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.emulated.device import EmulatedActuators
from beetle_omni_ros.sim.sensors import Frame
from beetle_omni_ros.sim.simulator import Simulator
from beetle_omni_ros.supervisor.interface import INFO

# --- simulated robot -----------------------------------------------------------------------------

HOPELESS = 10.0     # times what all rotors produce: a larger disturbance is a mistake
# Delayed readings first: the IMU sample triggers the estimate, which should include them.
SENSORS = {'mocap': 'mocap/pose', 'joints': 'joint_states', 'imu': 'imu/data_raw',
           'rotors': 'rotor_states', 'battery': 'battery_state'}
OF_ACTUATORS = ('joints', 'rotors', 'battery')      # the bridges publish those of real devices


class SimulatedRobot(Component):
    """
    Steps the simulator; commands come from the topic, or through emulated ``devices``.

    Attributes:
        simulator: its ``epoch`` is the time of the stamps at which simulated time is zero.
        on_answer: called with 'command' and the stamp of each command.

    """

    def __init__(self, simulator: Simulator, robot: RobotParameters,
                 devices: EmulatedActuators | None = None):
        super().__init__('sim_node')
        self.simulator = simulator
        self.on_answer: Callable[[str, float], None] = lambda topic, stamp: None
        self._devices: EmulatedActuators | None = None
        self._latency = Distribution()
        lift = HOPELESS * 4 * robot.rotors.thrust_max
        self._most_wrench = lift, lift * np.linalg.norm(robot.rotors.positions, axis=1).max()
        self._sensors = dict(SENSORS)
        if devices is None:
            self.reads('command', self.on_command, max_age=COMMAND_AGE)
            self.report('latency', lambda: self._latency.status(
                'stamp of the answered IMU sample to the arrival of its command'))
        else:
            self.use(devices)
        self.writes(*self._sensors.values(), 'ground_truth/odom')
        self.reads('disturbance', self._on_disturbance, expected=False)
        self.track_compute(simulator.tick)
        self.report('robot', self._robot_status)

    def use(self, devices: EmulatedActuators) -> None:
        """Let the plant follow emulated devices; the bridges then publish their readings."""
        self._devices = devices
        for name in OF_ACTUATORS:
            del self._sensors[name]
        self.report('devices', self._devices_status)

    def close(self) -> None:
        """Switch the devices off."""
        if self._devices is not None:
            self._devices.close()

    def advance(self) -> Frame:
        """Simulate one tick; return the readings that arrive in it."""
        return self.timed((self._devices or self.simulator).step)

    def publish(self, frame: Frame) -> None:
        """Publish readings and truth."""
        for name, topic in self._sensors.items():
            reading = getattr(frame, name)
            if reading is not None:
                self.send(topic, reading)
        self.send('ground_truth/odom', frame.truth)

    def on_command(self, command):
        """Let the actuators follow a command."""
        self._latency.add(self.host.now() - command.stamp)
        self.on_answer('command', command.stamp)
        self.simulator.command(Command(command.stamp - self.simulator.epoch, command.tilt,
                                       command.thrust))

    def _on_disturbance(self, wrench):
        size, most = np.linalg.norm([wrench.force, wrench.torque], axis=1), self._most_wrench
        if (size > most).any():
            raise MessageError('{:.3g} N and {:.3g} N m, expected at most {:.3g} N and {:.3g} N m'
                               .format(*size, *most), 'too large')
        self.simulator.wrench = np.concatenate([wrench.force, wrench.torque])

    def _robot_status(self):
        simulator = self.simulator
        faults, impact = simulator.faults, simulator.truth.impact
        values = {'faults': ', '.join(faults), 'broken': int(simulator.truth.broken)}
        if impact is not None:
            values.update(impact_m_s=impact.speed, impact_s=impact.stamp,
                          inclination_deg=degrees(impact.inclination))
        if simulator.truth.broken:
            return ERROR, 'broken by a crash', values
        return WARN if faults else OK, values['faults'] or 'whole', values

    def _devices_status(self):
        faults = self._devices.faults
        level = WARN if faults else OK
        return level, 'faults: ' + (', '.join(faults) or 'none'), self._devices.status()


# --- targets of a task ---------------------------------------------------------------------------

# A trajectory is published in overlapping windows: a reader would need tenths of a second to
# decode the whole of it, and a node that starts late soon receives the next window.
WINDOW, WINDOW_PERIOD = 3.0, 1.5    # [s]
STATE = 'reference/state'
WAITING, DONE, ABORTED = 'waiting', 'done', 'aborted'


class TaskReference(Component):
    """
    Publishes the targets of a task, beginning when the supervisor reports 'flying'.

    Each command lets the task proceed, so that a target comes after the controllers' step and
    before the next one, in any host.

    ``reference/state`` (latched) is 'waiting', 'flying 3/15', 'done',
    'done: control lost at level 60', or 'aborted' if the flight ended before the task.
    ``hang`` is called with each new payload of the task [kg].
    """

    def __init__(self, task: Task, hang: Callable[[float], None]):
        super().__init__('reference_node')
        self._task, self._hang = task, hang
        self._player = self._odom = self._trajectory = None
        self._window_end = 0.0
        self.writes('target_pose', 'target_trajectory', 'disturbance', STATE)
        self.follows('supervisor/state', self._on_supervisor)
        if task.kind in WITH_WRENCHES:      # the loss of control ends tasks with rising levels
            self.reads('odom', partial(setattr, self, '_odom'), qos=SENSOR)
        self.reads('command', self._on_command, expected=False)
        self.report('task', lambda: (OK, self.state, {'task': task.name}))

    def start(self) -> None:
        """Publish the state."""
        self.update(STATE, WAITING)

    @property
    def state(self) -> str:
        """Newest value of ``reference/state``."""
        return self.newest[STATE]

    def _on_supervisor(self, mode):
        if self.state == WAITING and mode.state == FLYING:
            self._player = TaskPlayer(self._task, self.host.now())
            self.host.log(INFO, f"task '{self._task.name}', {self._task.ends[-1]:g} s")
        elif self._player and (mode.motors_off or mode.state == LANDING):
            self._player = None
            self.update(STATE, ABORTED)

    def _on_command(self, command):
        player = self._player
        if player is None or command.stamp <= player.start:     # of the take-off
            return
        now = self.host.now()
        over = player.update(now, *((self._odom.position, self._odom.quaternion)
                                    if self._odom else ()))
        target, segment = player.target, player.segment
        if isinstance(target, PoseTarget):
            self._trajectory = None
            self.send('target_pose', target)
        elif target is not None:
            self._trajectory, self._window_end = target, target.times[0]
        if self._trajectory is not None and now > self._window_end - WINDOW_PERIOD:
            self._publish_window(now)
        if player.changed and self._task.kind in WITH_WRENCHES:
            self.send('disturbance', Wrench(now, segment.force_world, segment.torque_body))
        if player.changed and self._task.kind == 'payload':
            self._hang(float(segment.payload))
        if over:
            level = player.lost_level
            lost = '' if level is None else f': control lost at level {level:g}'
            self._player = self._trajectory = None
            self.update(STATE, f'{DONE}{lost}')
        else:
            count = len(self._task.segments)
            self.update(STATE, f'flying {min(player.index + 1, count)}/{count}')

    def _publish_window(self, now):
        """Publish the trajectory's own points from now on, so that no reader sees it changed."""
        path = self._trajectory
        last = len(path.times) - 1
        # One point before the present one, because a trajectory rests up to its first point.
        begin = min(max(int(np.searchsorted(path.times, now, 'right')) - 2, 0), last - 1)
        end = min(max(int(np.searchsorted(path.times, path.times[begin] + WINDOW)), begin + 1),
                  last)
        part = slice(begin, end + 1)
        self.send('target_trajectory', TrajectoryTarget(
            path.times[part], path.positions[part], path.quaternions[part], path.velocities[part],
            path.angular_velocities[part], stamp=float(path.times[begin])))
        self._window_end = path.times[end] if end < last else float('inf')
