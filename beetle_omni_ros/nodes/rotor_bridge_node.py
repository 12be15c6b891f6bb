"""ROS node of the motor board: thrusts to the rotors, battery and rotor speeds from it."""

from dataclasses import dataclass, replace
import math
import time

from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters
from beetle_omni_ros.drivers.motor_board import Arming, FLIES, MotorBoard
from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.nodes.lifecycle_node import AUTOSTART, LifecycleFlightNode
from beetle_omni_ros.nodes.node import CommandSource
from beetle_omni_ros.nodes.rotor_bridge_report import RotorBridgeReport, TargetStream
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
