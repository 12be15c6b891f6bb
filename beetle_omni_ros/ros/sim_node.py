"""ROS node of the simulated robot, with topics or emulated serial devices as actuators."""

from collections.abc import Callable
from dataclasses import dataclass
import math
import time

from rosgraph_msgs.msg import Clock

from beetle_omni_ros.bags.conversions import set_time
from beetle_omni_ros.bags.topics import SENSOR
from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.flight.component import OK, WARN
from beetle_omni_ros.flight.surroundings import SimulatedRobot
from beetle_omni_ros.model.schema import group, parameter, ParameterError, RunError
from beetle_omni_ros.ros import wire
from beetle_omni_ros.ros.node import file_parameter, FlightNode
from beetle_omni_ros.sim.emulated.device import (
    BoardFaults,
    EmulatedActuators,
    ServoFaults,
    switched_on,
)
from beetle_omni_ros.sim.faults import DEVICES, parse_faults
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.simulator import Simulator

# Ticks that are caught up after a stall of the computer; more would delay the next ones.
CATCH_UP_TICKS = 8
EARLY = 0.3             # part of a tick that the timer may come before the tick
SLEW = 0.01             # largest shift of a tick to a later time, in ticks
# Simulated time waits for a node that is farther behind than in real time, where the newest sample
# is one period old. It does not wait for a node that has stopped.
LAG = 0.02              # s between the newest sample and the newest answered one, at most
NEVER = 1e9             # s
PATIENCE = 0.3          # s of steady time without an answer after which a node has stopped


class RealTimePacing:
    """
    Ticks by the ROS clock; starts with the first call of :meth:`due`.

    Attributes:
        ticks: number of ticks so far.
        lost_ticks: ticks skipped after stalls; the simulation stopped meanwhile.
        epoch: time at which simulated time is zero [s]; None before the start.

    """

    def __init__(self, tick: float, clock: Callable[[], float]):
        self._tick, self._clock = tick, clock
        self.pause_at = math.inf    # real time does not stand still
        self.epoch: float | None = None
        self.ticks = self.lost_ticks = 0

    def due(self) -> int:
        """Return the number of ticks that are due now; called by the timer, once a tick."""
        now, tick = self._clock(), self._tick
        if self.epoch is None:
            self.epoch = now - tick
        due = int((now - self.epoch) / tick + EARLY) - self.ticks
        if not -CATCH_UP_TICKS <= due <= CATCH_UP_TICKS:    # a stall, or the clock was set
            lost = due - (CATCH_UP_TICKS if due > 0 else 0)
            self.lost_ticks += max(lost, 0)
            self.epoch += lost * tick
            due -= lost
        due = max(due, 0)
        self.ticks += due
        if due:
            # The phase of the timer is unknown. If ticks were always due some milliseconds before
            # it fires, every stamp would be too old by this time. So ticks come earlier at once,
            # and later slowly.
            self.epoch += min(now - self.epoch - self.ticks * tick, SLEW * tick)
        return due


class SimulatedTimePacing:
    """
    Ticks of simulated time: one each time the timer fires, none while an answer is due.

    An answer is due as long after the one before as that was after its predecessor, at most LAG.
    On a slow computer, time passes more slowly and no deadline is missed. For a node that has
    stopped, simulated time waits once.

    Attributes:
        epoch: time of the stamps at which simulated time is zero, a whole second [s].
        sent: stamp of the newest published sample [s].
        pause_at: simulated time since the start at which it stands still [s].

    """

    lost_ticks = 0

    def __init__(self, tick: float, epoch: float, steady: Callable[[], float] = time.monotonic):
        self._tick, self.epoch, self._steady = tick, math.floor(epoch), steady
        self.sent, self.ticks, self.pause_at = float('-inf'), 0, math.inf
        # topic -> stamp of its newest answer, its interval, steady time of its arrival [s]
        self._answers: dict[str, tuple[float, float, float]] = {}

    @property
    def now(self) -> float:
        """Simulated time [s]."""
        return self.epoch + self.ticks * self._tick

    def answered(self, name: str, stamp: float) -> None:
        """Record that ``name`` has answered the sample with this stamp."""
        before = self._answers.get(name, (-math.inf, 0.0, 0.0))[0]
        interval = stamp - before if 0 < stamp - before < LAG else LAG
        self._answers[name] = (stamp, interval, self._steady())

    def due(self) -> int:
        """Return the number of ticks that are due now: 1 or 0."""
        now, half = self._steady(), 0.5 * self._tick
        if self.ticks * self._tick > self.pause_at - half or any(
                self.sent - stamp > interval - half and now - arrived < PATIENCE
                for stamp, interval, arrived in self._answers.values()):
            return 0
        self.ticks += 1
        return 1


@dataclass(frozen=True, kw_only=True)
class SimNodeParameters:
    """Parameters of sim_node."""

    robot_file: str = file_parameter('robot file of the simulated robot')
    simulator_file: str = file_parameter('simulator file')
    conditions: str = parameter('nominal', choices=('nominal', 'published'),
                                doc='randomisation of plant and sensors')
    seed: int = parameter(0, doc='seed of all random numbers', low=0, high=2**31 - 1)
    actuators: str = parameter('direct', choices=('direct', 'emulated'),
                               doc='how commands reach the plant: from the topic, or through '
                               'emulated devices on serial ports')
    servo_port: str = parameter('', doc="path of the emulated servos' port; empty: a temporary "
                                'one')
    board_port: str = parameter('', doc="path of the emulated motor board's port; empty: a "
                                'temporary one')
    servo_bus_file: str = file_parameter('ids, signs and zeros of the emulated servos')
    clock: str = parameter('system', choices=('system', 'simulated'),
                           doc='real time, or simulated time on /clock, which waits for late '
                           'nodes; all other nodes then need use_sim_time')
    pause_at: float = parameter(NEVER, doc='simulated time since the start at which it stands '
                                'still, with clock simulated', unit='s', low=0)
    payload: float = parameter(0.0, doc='mass attached below the body', unit='kg', low=0, high=2)
    faults: str = parameter('', doc='active faults, as "rotor_stops rotor=2; mocap_lost '
                            'duration=3"; docs/faults.md lists the kinds')
    task_faults: str = parameter('', doc='faults, as faults, that begin with the task of '
                                 'reference_node')
    servo_faults: ServoFaults = group(ServoFaults, 'faults of the servo bus')
    board_faults: BoardFaults = group(BoardFaults, 'faults of the motor board')


class SimNode(FlightNode):
    """
    Steps the simulator by the ROS clock.

    With ``clock`` simulated it publishes /clock after each step. Steps then wait until estimator
    and supervisor have answered the newest samples.
    """

    component: SimulatedRobot

    def __init__(self):
        self._devices: EmulatedActuators | None = None
        self._clock_publisher = None
        self._task_waits = True
        super().__init__('sim_node', SimNodeParameters, on_change=self._changed, changeable=(
            'payload', 'pause_at', 'faults', 'servo_faults.', 'board_faults.'))
        given, robot = self.parameters, self.robot
        self._simulator = Simulator(
            robot, SimulatorParameters.load(given.simulator_file or None),
            conditions=given.conditions, seed=given.seed)
        self._pacing = self._make_pacing(given)
        if given.actuators == 'emulated':
            self._devices = EmulatedActuators.of(
                self._simulator, robot, ServoBusParameters.load(given.servo_bus_file or None),
                seed=given.seed, servo_port=given.servo_port, board_port=given.board_port)
            self.get_logger().info(f'servos at {self._devices.bus.port}, motor board at '
                                   f'{self._devices.board.port}')
        self._changed(given)
        component = SimulatedRobot(self._simulator, robot, self._devices)
        component.report('pacing', self._pacing_status)
        component.every(self._simulator.tick, self._on_timer, steady=True)
        if given.task_faults:
            self._check_faults(parse_faults(given.task_faults))
            component.follows('reference/state', self._on_task)
        if given.clock == 'simulated':
            component.on_answer = self._pacing.answered
            component.reads('odom', lambda odom: self._pacing.answered('odom', odom.stamp))
        self.run(component)

    def _make_pacing(self, given):
        if given.clock == 'system':
            return RealTimePacing(self._simulator.tick, self.now)
        if given.actuators == 'emulated':
            raise ParameterError("key 'clock': simulated: serial devices keep real time; start "
                                 'with actuators:=direct')
        self._clock_publisher = self.create_publisher(Clock, '/clock', wire.profile(SENSOR))
        return SimulatedTimePacing(self._simulator.tick, super().now())

    def now(self) -> float:
        """Return ROS time [s]; this node is the source of simulated time."""
        return super().now() if self._clock_publisher is None else self._pacing.now

    def close(self) -> None:
        """Switch the emulated devices off."""
        if self._devices is not None:
            self._devices.close()

    def _changed(self, new):
        """Set faults and payload; unchanged faults continue."""
        faults, devices = self._check_faults(parse_faults(new.faults)), self._devices
        of_devices = [*switched_on(new.servo_faults), *switched_on(new.board_faults)]
        if devices is not None:
            devices.set_faults(new.servo_faults, new.board_faults)
        elif of_devices:
            raise ParameterError(f'servo_faults, board_faults: {of_devices[0]}: there are no '
                                 'devices with actuators direct; start with actuators:=emulated')
        self._simulator.set_faults(faults)
        self._simulator.payload = new.payload
        self._pacing.pause_at = new.pause_at
        if new is not self.parameters:
            active = '; '.join(filter(None, (new.faults, *of_devices)))
            self.get_logger().info(f"faults: {active or 'none'}, payload {new.payload:g} kg")

    def _check_faults(self, faults):
        for fault in faults:
            if self._devices is not None and fault.changes(*DEVICES):
                raise ParameterError(f"faults: '{fault.kind}': the emulated devices handle this "
                                     'signal; use servo_faults and board_faults, or '
                                     'actuators:=direct')
        return faults

    def _on_task(self, state):
        """Start the faults of the task when the task begins."""
        if self._task_waits and state.startswith('flying'):
            self._simulator.set_faults(parse_faults(self.parameters.task_faults))
        self._task_waits = state == 'waiting'

    def _on_timer(self):
        component, pacing = self.component, self._pacing
        for _ in range(pacing.due()):
            self._simulator.epoch = pacing.epoch
            try:
                frame = component.advance()
            except RunError as error:
                self.stop.set_exception(error)
                return
            if self._clock_publisher is not None:
                message = Clock()
                set_time(message.clock, round(pacing.now, 6))   # a tick is whole microseconds
                self._clock_publisher.publish(message)
                if frame.imu is not None:
                    pacing.sent = frame.imu.stamp
            component.publish(frame)

    def _pacing_status(self):
        pacing = self._pacing
        level = WARN if pacing.lost_ticks else OK
        return level, f'{pacing.lost_ticks} ticks lost', {
            'ticks': pacing.ticks, 'lost_ticks': pacing.lost_ticks,
            'lost_s': pacing.lost_ticks * self._simulator.tick,
            'simulated_s': self._simulator.time}
