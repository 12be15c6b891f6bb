"""ROS node of the motor board: thrusts to the rotors, battery and rotor speeds from it."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
import math
import time

import numpy as np

from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters
from beetle_omni_ros.drivers.motor_board import Arming, FLIES, LOST, MotorBoard, Sent
from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.nodes.lifecycle_node import AUTOSTART, LifecycleFlightNode
from beetle_omni_ros.nodes.node import CommandSource, Distribution, ERROR, Health, OK, WARN
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import RotorReading
from beetle_omni_ros.robot.schema import parameter

RPM = math.pi / 30      # [rad/s]
UNCONFIGURED, INACTIVE = 'not configured', 'not activated'
POLL_CYCLES = 2         # the board sends its rotors' speeds 100 times a second


@dataclass(frozen=True, kw_only=True)
class RotorBridgeNodeParameters(MotorBoardParameters):
    """Parameters of rotor_bridge_node: the driver's parameters, the files, and autostart."""

    robot_file: str = parameter(
        '', doc='robot file with the rotor map; empty: the shipped one', read_only=True)
    motor_board_file: str = parameter(
        '', doc='motor board file; empty: the shipped params/motor_board.yaml', read_only=True)
    autostart: str = parameter('activate', choices=tuple(AUTOSTART), read_only=True,
                               doc='transition at the start')


class TargetStream:
    """
    Counts of a stream with one target every ``period`` [s].

    Attributes:
        cycles: periods in which a target was due.
        missed: periods without a target.
        unsent: reason -> number of targets that could not be sent.
        latency: time from the publication of a command to the last byte of its first target.
        latency_from: event from which the latency counts.
        age: time from a command's stamp to the last byte of its target: the latency of the whole
            loop from the IMU sample on.
        command: (4,) normalised commands of the newest target.
        saturated: (4,) number of targets of each rotor above the limit of the battery.

    """

    def __init__(self, period: float):
        self._period = period
        self._last: float | None = None
        self.cycles = self.missed = 0
        self.unsent: Counter = Counter()
        self.latency, self.latency_from = Distribution(), 'no command yet'
        self.age = Distribution()
        self.command = np.zeros(4)
        self.saturated = np.zeros(4, dtype=int)

    def rest(self) -> None:
        """Count no missed period before the next target."""
        self._last = None

    def add(self, sent: Sent, now: float) -> None:
        """Count the result of one target at monotonic time ``now`` [s]."""
        if sent.reason:
            self.unsent[sent.reason] += 1
            return
        if self._last is not None:
            # A gap nearer to one period than to two was in time.
            cycles = round((now - self._last) / self._period)
            self.cycles += cycles
            self.missed += max(cycles - 1, 0)
        self._last = now
        self.command = sent.command
        self.saturated += sent.saturated

    def answered(self, seconds: float, begin: str, age: float) -> None:
        """Add the latency [s] of one command since the event ``begin``, and its age [s]."""
        self.latency.add(seconds)
        self.latency_from = begin
        self.age.add(age)


class RotorBridgeReport:
    """Sources of the diagnostic statuses of the bridge."""

    def __init__(self, reports: Health, board: MotorBoard, arming: Arming,
                 stream: TargetStream):
        self._board, self._arming, self._stream = board, arming, stream
        self._battery = self._rotors = None
        self._saturated, self._missed = stream.saturated.copy(), 0
        reports.report('board', self._board_status)
        reports.report('latency', self._latency_status)
        for k in range(4):
            reports.report(f'rotor{k + 1}', partial(self._rotor_status, k))

    def update(self, battery, rotors) -> None:
        """Store the newest measurements of the board; None for no new one."""
        self._battery = battery or self._battery
        self._rotors = rotors or self._rotors

    def _board_status(self):
        arming, stream, text = self._arming, self._stream, self._arming.text
        values = {'phase': arming.phase, 'cycles': stream.cycles, 'missed_cycles': stream.missed}
        values.update((f'not sent: {reason}', n) for reason, n in stream.unsent.items())
        missed, self._missed = stream.missed - self._missed, stream.missed
        level = ERROR if arming.phase == LOST else \
            OK if text == 'ready' and not missed else WARN
        if missed and text == 'ready':
            text = f'{missed} cycles missed'
        if status := self._board.state.status:
            values.update({'armed': int(status.armed), 'state': status.state,
                           'last disarmed': status.stop_reason,
                           'conditions': ', '.join(status.conditions),
                           'contract': status.contract})
        if self._battery is not None:
            values.update({'voltage_V': self._battery.voltage, 'current_A': self._battery.current})
        return level, text, {**values, **self._board.link()}

    def _latency_status(self):
        times, ages = self._stream.latency, self._stream.age
        return OK, f'from {self._stream.latency_from} to the last byte written', {
            **times.milliseconds(), 'count': times.count, **ages.milliseconds('age_')}

    def _rotor_status(self, k):
        stream, rotors = self._stream, self._rotors
        values = {'saturated': int(stream.saturated[k]),
                  'command': float(stream.command[k]) if self._arming.phase == FLIES else 0.0}
        saturates = stream.saturated[k] > self._saturated[k]
        self._saturated[k] = stream.saturated[k]
        if rotors is None:
            return OK, 'no data yet', values
        faults = list(rotors.failures[k])
        if math.isnan(rotors.rpm[k]):
            faults.append('offline')
        values.update({
            'speed_rad_s': float(rotors.rpm[k]) * math.pi / 30,
            'voltage_V': float(rotors.voltage[k]), 'current_A': float(rotors.current[k]),
            'temperature_C': float(rotors.temperature[k]), 'failures': ', '.join(faults),
            'error_count': int(rotors.error_count[k])})
        if faults:
            return ERROR, ', '.join(faults), values
        if saturates:
            return WARN, 'target above the thrust that the battery permits', values
        return OK, 'ok', values


class RotorBridgeNode(LifecycleFlightNode):
    """
    Executes the thrusts of command; publishes battery_state, rotor_states and its own state.

    A lifecycle node: configure opens the port, activate permits arming. The node arms the motor
    board when the supervisor takes off. It disarms the board when the supervisor disarms or stops,
    and when this process ends. rotor_bridge/state (latched) is 'ready', 'waiting: WHY' or
    'lost: WHY'.
    """

    real_time = True

    def __init__(self):
        super().__init__('rotor_bridge_node', RotorBridgeNodeParameters,
                         'params/motor_board.yaml', 'motor_board_file')
        given = self.parameters
        robot = RobotParameters.load(given.robot_file or None)
        self._cells = robot.battery.cells
        self._period = 1 / given.target_rate
        self._board = MotorBoard(given, robot, clock=self.now)
        self._arming = Arming(self._board)
        self._arming.inhibit(UNCONFIGURED)
        self._stream = TargetStream(self._period)
        self._command = None
        # _port_error: why the port is closed, '' if not yet known; None: open, or not configured.
        self._state, self._port_error = '', None
        self._updated = self._next_try = time.monotonic()
        self._cycle, self._sent = 0, 0.0
        self._states = self.publisher('rotor_bridge/state')
        self._batteries = self.publisher('battery_state')
        self._rotors = self.publisher('rotor_states')
        self._report = RotorBridgeReport(self.health, self._board, self._arming,
                                         self._stream)
        self.listen('command', self._on_command, read=CommandSource(self).read,
                    max_age=given.stamp_age_limit, stale_after=None, published=True)
        self.follow('supervisor/state', self._on_supervisor)
        self._timer = self.create_timer(self._period, self._on_timer, clock=self.steady_clock)
        self.start_by_itself(given.autostart)
        if given.autostart != 'none':
            self._try_to_start()    # at once; nothing is refused here

    # --- lifecycle ----------------------------------------------------------------------------

    def configure(self):
        """Open the port, now or as soon as it exists; then battery and rotors are published."""
        self._port_error, self._next_try = '', time.monotonic()
        self._arming.inhibit(INACTIVE)

    def activate(self):
        """Permit arming, which the supervisor requests."""
        self._arming.inhibit('')

    def deactivate(self):
        """Disarm, also in flight."""
        self._arming.inhibit(INACTIVE)

    def release(self):
        """Disarm and close the port."""
        self._arming.inhibit(UNCONFIGURED)
        self._port_error = None
        self._board.close()

    def changed(self):
        """Publish the state."""
        self._publish_state()

    # --- the stream ---------------------------------------------------------------------------

    def waits_for(self):
        """Return the state of the motor board."""
        self._publish_state()
        return self._state.replace('waiting:', 'the motor board:')

    def _on_command(self, command, published):
        self._command = command
        if not self._send():
            return
        self._timer.reset()     # sends this command again after a period without a newer one
        age = self.now() - command.stamp
        if math.isnan(published):
            self._stream.answered(age, 'the stamp of the command', age)
        else:
            self._stream.answered(time.time() - published, 'the publication of the command', age)

    def _on_supervisor(self, state):
        self._arming.follow(state)
        self._publish_state()

    def _on_timer(self):
        now = time.monotonic()
        self._open(now)
        self._arming.update(now - self._updated)
        self._updated = now
        if now - self._sent < self._period / 2:
            # A command came between this expiry and its callback; its reset of the timer was
            # too late.
            self._timer.reset()
        else:
            self._send()
        self._cycle += 1
        if self._cycle % POLL_CYCLES == 0:
            self._poll()
        self._publish_state()

    def _open(self, now):
        """Try to open the port; afterwards the driver itself reconnects."""
        if self._port_error is None or now < self._next_try:
            return
        self._next_try = now + self.parameters.reconnect_period
        try:
            self._board.open()
        except SerialPortError as error:
            if str(error) != self._port_error:
                self._port_error = str(error)
                self.get_logger().warning(f'{error}; searching for it')
        else:
            self._port_error = None

    def _send(self):
        """Send the newest thrusts while flying; return whether they were sent."""
        command = self._command
        if self._arming.phase != FLIES or command is None \
                or self.now() - command.stamp > self.parameters.stamp_age_limit:
            self._stream.rest()
            return False
        sent = self._board.send(command.thrust, command.stamp)
        self._sent = time.monotonic()
        self._stream.add(sent, self._sent)
        return not sent.reason

    def _poll(self):
        battery, rotors, events = self._board.poll()
        self._report.update(battery, rotors)
        if battery is not None:
            self._batteries.publish(replace(battery, cells=self._cells))
        if rotors is not None:
            self._rotors.publish(RotorReading(rotors.stamp, RPM * rotors.rpm))
        for event in events:
            self.log_line(*event)

    def _publish_state(self):
        text = self._arming.text
        if self._port_error and text.startswith('waiting'):
            text = f'waiting: {self._port_error}'
        if text != self._state:
            if not text.startswith('waiting'):
                self.log_line('error' if text.startswith('lost') else 'info',
                              f'motor board: {text}')
            self._state = text
            self._states.publish(text)

    def close(self):
        """Disarm."""
        self._arming.end()
        self._states.publish(self._arming.text)
        self._board.close()
