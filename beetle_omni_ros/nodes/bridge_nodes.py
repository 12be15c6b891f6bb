"""ROS lifecycle nodes between the topics and the actuators: tilt servos and motor board."""

from collections import Counter
from functools import partial, partialmethod
import math
import time

import numpy as np
from rclpy.lifecycle import LifecycleNodeMixin, TransitionCallbackReturn
from std_srvs.srv import Trigger

from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.drivers.motor_board import Arming, FLIES, LOST, MotorBoard
from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.drivers.servo_link import ServoBusError
from beetle_omni_ros.drivers.servo_loop import ServoLoop
from beetle_omni_ros.nodes import parameters, wire
from beetle_omni_ros.nodes.graph import AUTOSTART
from beetle_omni_ros.nodes.node import Distribution, ERROR, FlightNode, OK, WARN
from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters
from beetle_omni_ros.robot.readings import RotorReading
from beetle_omni_ros.robot.schema import parameter

UNCONFIGURED, INACTIVE, ACTIVE = 'unconfigured', 'inactive', 'active'
RETRY = 1.0             # [s] between attempts to start by itself
COMMAND_AGE = 0.1       # [s] older commands are not sent to servos and motor board
TARGET_PERIOD = 0.005   # [s] of the targets of the board, new or repeated
LOST_AFTER = 0.3        # [s] after which a servo without response or torque is lost
CHECK_PERIOD = 0.05     # [s] between checks of the bus thread's events
RPM = math.pi / 30      # [rad/s]
POLL_CYCLES = 2         # the board sends its rotors' speeds 100 times a second


class BridgeNode(LifecycleNodeMixin, FlightNode):
    """
    Base of a node that opens a device when configured and powers it when activated.

    A subclass overrides ``configure`` (open the device), ``activate`` (power it), ``deactivate``,
    ``release`` (switch the power off and close it, in any state) and ``state_text`` ('ready',
    'waiting: WHY' or 'lost: WHY'). ServoBusError and SerialPortError refuse a transition. Their
    text goes to the log and to ``refusal``, and the state stays as it was.
    """

    def __init__(self, name, *args, autostart, **kwargs):
        FlightNode.__init__(
            self, name, *args, robot_file=parameters.file_parameter(), autostart=parameter(
                autostart, choices=tuple(AUTOSTART),
                doc='transition at the start, repeated until it succeeds'), **kwargs)
        LifecycleNodeMixin.__init__(self)
        self._states = wire.Publisher(self, f"{name.removesuffix('_node')}/state")
        self.latency = Distribution()
        self.report('latency', lambda: self.latency.status(
            'stamp of the answered IMU sample to the last byte of its command'))
        self.refusal = ''       # why the last transition was refused, '' if it was not
        self._start_timer = None
        self._starts = False    # during an automatic transition
        # In rclpy, an impossible transition ends the process.
        self._answer_change = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state

    @property
    def stage(self) -> str:
        """Name of the present state."""
        return self._state_machine.current_state[1]

    def start_by_itself(self) -> None:
        """Go to the state of the parameter ``autostart``; repeat until it succeeds."""
        if AUTOSTART[self.parameters.autostart]:
            self._start_timer = self.create_timer(RETRY, self.try_to_start,
                                                  clock=self.steady_clock)
            self.try_to_start()
        self.changed()

    def changed(self) -> None:
        """Publish and log the state if it changed."""
        text = self.state_text()
        if self._states.update(text):
            self.log_line('error' if text.startswith('lost') and self.stage == ACTIVE else 'info',
                          text)

    def try_to_start(self) -> None:
        """Make the next transitions of the automatic start."""
        self._starts, goal = True, AUTOSTART[self.parameters.autostart]
        if self.stage == UNCONFIGURED:
            self.trigger_configure()
        if self.stage == INACTIVE and goal == ACTIVE:
            self.trigger_activate()
        if self.stage not in (UNCONFIGURED, INACTIVE) or self.stage == goal:
            self._start_timer.cancel()
        self._starts = False
        self.changed()

    def _attempt(self, what, action, state):
        """Make a transition by a method; any but the first two ends the automatic start."""
        if what not in ('configure', 'activate') and self._start_timer is not None:
            self._start_timer.cancel()
        before, self.refusal = self.refusal, ''
        try:
            getattr(self, action)()
        except (ServoBusError, SerialPortError) as error:
            if what == 'configure':
                self.release()
            self.refusal = ' '.join(str(error).split())
            if self.refusal != before:      # attempts are repeated, lines are not
                self.log_line('info' if self._starts else 'error',
                              f'cannot {what}: {self.refusal}'
                              + ('; tries again' if self._starts else ''))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:      # rclpy does not log it
            self.get_logger().fatal(f'cannot {what}: {type(error).__name__}: {error}')
            raise
        return TransitionCallbackReturn.SUCCESS

    on_configure = partialmethod(_attempt, 'configure', 'configure')
    on_activate = partialmethod(_attempt, 'activate', 'activate')
    on_deactivate = partialmethod(_attempt, 'deactivate', 'deactivate')
    on_cleanup = partialmethod(_attempt, 'clean up', 'release')
    on_shutdown = partialmethod(_attempt, 'shut down', 'release')

    def on_error(self, state):
        """Close the device after an unexpected exception; it can be configured again."""
        self.release()
        return TransitionCallbackReturn.SUCCESS

    def _on_change_state(self, request, response):
        try:
            self._answer_change(request, response)
        except Exception as error:      # rclpy does not export the class
            if 'RCLError' not in type(error).__name__:
                raise
            self.get_logger().warning(f'refused: no such transition from {self.stage}')
            response.success = False
        self.changed()
        return response


# --- servos -------------------------------------------------------------------------------------

class JointBridgeNode(BridgeNode):
    """Lifecycle node: configure checks the servos, activate switches their torque on."""

    def __init__(self):
        super().__init__('joint_bridge_node', ServoBusParameters, 'params/servo_bus.yaml',
                         'servo_bus_file', autostart='none')
        self._travel = RobotParameters.load(self.parameters.robot_file or None).joints
        self._bus = self._loop = None
        self._lost_reason = ''
        self._joints = wire.Publisher(self, 'joint_states')
        self.listen('command', self._on_command, max_age=COMMAND_AGE, expected=False)
        self.report('bus', self._bus_status)
        for k, name in enumerate(JOINT_NAMES):
            self.report(name, partial(self._servo_status, k))
        self.create_service(Trigger, '~/reboot', self._on_reboot)
        self.create_timer(CHECK_PERIOD, self._on_timer, clock=self.steady_clock)
        self.start_by_itself()

    def configure(self):
        """Open the port, check and write the servos' settings, and start to read angles."""
        self._bus = ServoBus(self.parameters, self._travel, self.now)
        self._bus.open()
        self._bus.configure()
        self._lost_reason = ''
        self._loop = ServoLoop(self._bus, self._joints.publish,
                               lambda stamp: self.latency.add(self.now() - stamp))
        self._loop.start()

    def activate(self):
        """Switch the torque on; the servos hold their present angles."""
        if self._loop.failure:
            raise ServoBusError(f'{self._loop.failure}; clean up and configure again')
        with self._loop.exclusive() as bus:
            bus.enable()

    def deactivate(self):
        """Switch the torque off."""
        if self._bus.enabled:
            self._lost_reason = 'no torque, deactivated'
        with self._loop.exclusive() as bus:
            confirmed = bus.disable()
        if not confirmed:
            self.get_logger().error('torque off is not confirmed by all servos; it is switched '
                                    'off as soon as they respond')

    def release(self):
        """Switch the torque off and close the port."""
        loop, bus = self._loop, self._bus
        self._loop = self._bus = None
        if bus is None:
            return
        if bus.enabled:
            self._lost_reason = 'no torque, the node was shut down'
        if loop is not None:
            loop.stop()
        bus.close()
        if loop is not None:    # without a loop, the refusal was logged
            self._log(bus)

    def close(self):
        """Switch the torque off and publish the state."""
        self.release()
        self._states.publish(self.state_text())

    def _on_reboot(self, _, response):
        """Restart the servos that have switched themselves off, or all if none has."""
        if self._loop is None:
            response.success, response.message = False, 'not configured'
            return response
        which = [k for k, servo in enumerate(self._bus.servos)
                 if servo.errors and not servo.torque] or range(4)
        with self._loop.exclusive() as bus:
            for k in which:
                bus.reboot(k)
        response.success = True
        response.message = f"restarting {', '.join(JOINT_NAMES[k] for k in which)}"
        return response

    def _on_command(self, command):
        if self._loop is not None:
            left = COMMAND_AGE - max(0.0, self.now() - command.stamp)
            self._loop.offer(command.tilt, command.stamp, time.monotonic() + left)

    def _on_timer(self):
        if self._loop is not None:
            self._log(self._bus)
        self.changed()

    def _log(self, bus):
        for line in bus.take_events():
            self.get_logger().warning(line)

    def state_text(self):
        """Return the state of the servos."""
        if self.stage == ACTIVE and self._loop is not None:
            lost = self._loop.lost(LOST_AFTER)
            return f'lost: {lost}' if lost else 'ready'
        if self.refusal:
            return f'waiting: {self.refusal}'
        if self._lost_reason:
            return f'lost: {self._lost_reason}'
        return 'waiting: no torque, not activated' if self.stage == INACTIVE \
            else 'waiting: not configured'

    def _bus_status(self):
        loop, bus, text = self._loop, self._bus, self._states.value
        if loop is None:
            return WARN if self.stage == ACTIVE else OK, text, {'stage': self.stage}
        level = ERROR if text.startswith('lost') else OK if bus.link.is_open else WARN
        return level, 'no connection' if level == WARN else text, {
            'stage': self.stage, 'cycles': loop.cycles, 'missed_cycles': loop.missed,
            'connected': bus.link.is_open, 'goals_written': loop.written,
            'goals_stale': loop.stale, 'incomplete': loop.incomplete, **bus.link.counts}

    def _servo_status(self, k):
        if self._bus is None:
            return OK, 'not configured', {}
        one = self._bus.servos[k]
        recovering = one.recovery is not None or one.restarting
        values = {'id': one.identifier, 'responding': not one.silent,
                  'torque': 'unknown' if one.torque is None else one.torque,
                  'voltage_v': one.voltage, 'temperature_c': one.temperature,
                  'errors': ', '.join(one.errors) or 'none', 'recovering': recovering}
        if one.message:
            bad = one.silent or (one.errors and not one.torque)
            return (ERROR if bad else WARN), one.message, values
        return OK, 'being brought back' if recovering else 'ok', values


# --- motor board --------------------------------------------------------------------------------

class RotorBridgeNode(BridgeNode):
    """
    Executes the thrusts of command; publishes battery_state, rotor_states and its own state.

    A lifecycle node: configure opens the port, activate permits arming. The node arms the motor
    board when the supervisor takes off. It disarms the board when the supervisor disarms or stops,
    and when this process ends.
    """

    def __init__(self):
        super().__init__('rotor_bridge_node', MotorBoardParameters, 'params/motor_board.yaml',
                         'motor_board_file', autostart='activate')
        given = self.parameters
        robot = RobotParameters.load(given.robot_file or None)
        self._board = MotorBoard(given, robot, clock=self.now)
        self._arming = Arming(self._board)
        self._arming.inhibit('not configured')
        self._command = self._battery = self._speeds = None
        self._updated = time.monotonic()
        self._cycle, self._sent_at = 0, 0.0
        self._unsent = Counter()
        self._saturated, self._saturated_reported = np.zeros((2, 4), dtype=int)
        self._batteries = wire.Publisher(self, 'battery_state')
        self._rotors = wire.Publisher(self, 'rotor_states')
        self.report('board', self._board_status)
        for k in range(4):
            self.report(f'rotor{k + 1}', partial(self._rotor_status, k))
        self.listen('command', self._on_command, max_age=COMMAND_AGE, expected=False)
        wire.subscribe(self, 'supervisor/state', self._on_supervisor)
        self._timer = self.create_timer(TARGET_PERIOD, self._on_timer, clock=self.steady_clock)
        self.start_by_itself()

    def configure(self):
        """Open the port; from then on battery and rotors are published."""
        self._board.open()
        self._arming.inhibit('not activated')

    def activate(self):
        """Permit arming, which the supervisor requests."""
        self._arming.inhibit('')

    def deactivate(self):
        """Disarm, also in flight."""
        self._arming.inhibit('not activated')

    def release(self):
        """Disarm and close the port."""
        self._arming.inhibit('not configured')
        self._board.close()

    def close(self):
        """Disarm."""
        self._arming.end()
        self._states.publish(self._arming.text)
        self._board.close()

    def _on_command(self, command):
        self._command = command
        if self._send():
            self._timer.reset()     # sends this command again after a period without a newer one
            self.latency.add(self.now() - command.stamp)

    def _on_supervisor(self, state):
        self._arming.follow(state)
        self.changed()

    def _on_timer(self):
        now = time.monotonic()
        self._arming.update(now - self._updated)
        self._updated = now
        if now - self._sent_at < TARGET_PERIOD / 2:
            # A command came between this expiry and its callback; its reset of the timer was
            # too late.
            self._timer.reset()
        else:
            self._send()
        self._cycle += 1
        if self._cycle % POLL_CYCLES == 0:
            self._poll()
        self.changed()

    def _send(self):
        """Send the newest thrusts while flying; return whether they were sent."""
        command = self._command
        if self._arming.phase != FLIES or command is None \
                or self.now() - command.stamp > COMMAND_AGE:
            return False
        reason = self._board.send(command.thrust, command.stamp)
        self._sent_at = time.monotonic()
        if reason:
            self._unsent[reason] += 1
            return False
        self._saturated += self._board.saturated
        return True

    def _poll(self):
        battery, rotors = self._board.poll()
        if battery is not None:
            self._battery = battery
            self._batteries.publish(battery)
        if rotors is not None:
            self._speeds = rotors
            self._rotors.publish(RotorReading(rotors.stamp, RPM * rotors.rpm))

    def state_text(self):
        """Return the state of the board, or why its port is closed."""
        text = self._arming.text
        return f'waiting: {self.refusal}' if self.refusal and text.startswith('waiting') else text

    def _board_status(self):
        arming, text = self._arming, self._arming.text
        values = {'phase': arming.phase,
                  **{f'not sent: {reason}': n for reason, n in self._unsent.items()}}
        level = ERROR if arming.phase == LOST else OK if text == 'ready' else WARN
        if status := self._board.state.status:
            values.update({'armed': int(status.armed), 'state': status.state,
                           'last disarmed': status.stop_reason,
                           'conditions': ', '.join(status.conditions),
                           'contract': status.contract})
        if self._battery is not None:
            values.update({'voltage_V': self._battery.voltage, 'current_A': self._battery.current})
        return level, text, {**values, **self._board.link()}

    def _rotor_status(self, k):
        rotors, saturated = self._speeds, int(self._saturated[k])
        values = {'saturated': saturated, 'command': float(self._board.duty[k])
                  if self._arming.phase == FLIES else 0.0}
        saturates = saturated > self._saturated_reported[k]
        self._saturated_reported[k] = saturated
        if rotors is None:
            return OK, 'no data yet', values
        faults = list(rotors.failures[k])
        if math.isnan(rotors.rpm[k]):
            faults.append('offline')
        values.update({
            'speed_rad_s': RPM * float(rotors.rpm[k]),
            'voltage_V': float(rotors.voltage[k]), 'current_A': float(rotors.current[k]),
            'temperature_C': float(rotors.temperature[k]), 'failures': ', '.join(faults),
            'error_count': int(rotors.error_count[k])})
        if faults:
            return ERROR, ', '.join(faults), values
        if saturates:
            return WARN, 'target above the thrust that the battery permits', values
        return OK, 'ok', values
