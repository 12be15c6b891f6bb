"""Bridges from topics to servos and motor board as components; the loop that flies with them."""

from collections import Counter
from dataclasses import replace
from functools import partial
import math
import sys
import time

import numpy as np

from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.drivers.motor_board import Arming, FLIES, LOST, MotorBoard
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.drivers.servo_loop import ServoLoop
from beetle_omni_ros.drivers.servo_xc330 import ServoBusError
from beetle_omni_ros.flight.component import Component, Distribution, ERROR, OK, WARN
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.model.mode import COMMAND_AGE
from beetle_omni_ros.model.parameters import JOINT_NAMES, RobotParameters
from beetle_omni_ros.model.readings import RotorReading
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.emulated.device import EmulatedActuators
from beetle_omni_ros.sim.faults import DEVICES
from beetle_omni_ros.supervisor.interface import Answer, INFO, WARNING
from beetle_omni_ros.supervisor.interface import ERROR as SEVERE

UNCONFIGURED, INACTIVE, ACTIVE = 'unconfigured', 'inactive', 'active'   # states of a lifecycle
TARGET_PERIOD = 0.005   # [s] of the targets of the board, new or repeated
LOST_AFTER = 0.3        # [s] after which a servo without response or torque is lost
CHECK_PERIOD = 0.05     # [s] between checks of the bus thread's events
RPM = math.pi / 30      # [rad/s]
POLL_CYCLES = 2         # the board sends its rotors' speeds 100 times a second


class Bridge(Component):
    """
    Base of a component with a device and the states of a lifecycle.

    A host calls ``configure`` (open the device), ``activate`` (power it), ``deactivate`` and
    ``release`` (switch the power off and close it, in any state), and then sets ``stage``.
    ServoBusError and SerialPortError refuse a transition. ``state_text`` is 'ready',
    'waiting: WHY' or 'lost: WHY'.

    Attributes:
        stage: present state of the lifecycle.
        refusal: why the last transition was refused, '' if it was not.

    """

    def __init__(self, name: str):
        super().__init__(name)
        self.state_topic = f"{name.removesuffix('_node')}/state"
        self.writes(self.state_topic)
        self.stage, self.refusal, self.latency = UNCONFIGURED, '', Distribution()
        self.report('latency', lambda: self.latency.status(
            'stamp of the answered IMU sample to the last byte of its command'))

    def state_text(self) -> str:
        """State of the device for the supervisor."""
        raise NotImplementedError

    def changed(self) -> None:
        """Publish and log the state if it changed."""
        text = self.state_text()
        if self.update(self.state_topic, text):
            self.host.log(SEVERE if text.startswith('lost') and self.stage == ACTIVE else INFO,
                          text)


# --- servos -------------------------------------------------------------------------------------

class JointBridge(Bridge):
    """Lifecycle node: configure checks the servos, activate switches their torque on."""

    def __init__(self, parameters: ServoBusParameters, robot: RobotParameters):
        super().__init__('joint_bridge_node')
        self._parameters, self._travel = parameters, robot.joints
        self._bus = self._loop = None
        self._lost_reason = ''
        self.writes('joint_states')
        self.reads('command', self._on_command, max_age=COMMAND_AGE, expected=False)
        self.report('bus', self._bus_status)
        for k, name in enumerate(JOINT_NAMES):
            self.report(name, partial(self._servo_status, k))
        self.services['reboot'] = self._reboot
        self.every(CHECK_PERIOD, self._on_timer, steady=True)

    def configure(self) -> None:
        """Open the port, check and write the servos' settings, and start to read angles."""
        self._bus = ServoBus(self._parameters, self._travel, self.host.now)
        self._bus.open()
        self._bus.configure()
        self._lost_reason = ''
        self._loop = ServoLoop(self._bus, partial(self.send, 'joint_states'),
                               lambda stamp: self.latency.add(self.host.now() - stamp))
        self._loop.start()

    def activate(self) -> None:
        """Switch the torque on; the servos hold their present angles."""
        if self._loop.failure:
            raise ServoBusError(f'{self._loop.failure}; clean up and configure again')
        with self._loop.exclusive() as bus:
            bus.enable()

    def deactivate(self) -> None:
        """Switch the torque off."""
        if self._bus.enabled:
            self._lost_reason = 'no torque, deactivated'
        with self._loop.exclusive() as bus:
            confirmed = bus.disable()
        if not confirmed:
            self.host.log(SEVERE, 'torque off is not confirmed by all servos; it is switched off '
                          'as soon as they respond')

    def release(self) -> None:
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

    def close(self) -> None:
        """Switch the torque off and publish the state."""
        self.release()
        self.send(self.state_topic, self.state_text())

    def _reboot(self):
        """Restart the servos that have switched themselves off, or all if none has."""
        if self._loop is None:
            return Answer(False, 'not configured')
        which = [k for k, servo in enumerate(self._bus.servos)
                 if servo.errors and not servo.torque] or range(4)
        with self._loop.exclusive() as bus:
            for k in which:
                bus.reboot(k)
        return Answer(True, f"restarting {', '.join(JOINT_NAMES[k] for k in which)}")

    def _on_command(self, command):
        if self._loop is not None:
            left = COMMAND_AGE - max(0.0, self.host.now() - command.stamp)
            self._loop.offer(command.tilt, command.stamp, time.monotonic() + left)

    def _on_timer(self):
        if self._loop is not None:
            self._log(self._bus)
        self.changed()

    def _log(self, bus):
        for line in bus.take_events():
            self.host.log(WARNING, line)

    def state_text(self) -> str:
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
        loop, bus, text = self._loop, self._bus, self.newest.get(self.state_topic, '')
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

class RotorBridge(Bridge):
    """
    Executes the thrusts of command; publishes battery_state, rotor_states and its own state.

    Configure opens the port, activate permits arming. It arms the motor board when the supervisor
    takes off. It disarms the board when the supervisor disarms or stops, and when it is closed.
    """

    def __init__(self, parameters: MotorBoardParameters, robot: RobotParameters):
        super().__init__('rotor_bridge_node')
        self._board = MotorBoard(parameters, robot, clock=lambda: self.host.now())
        self._arming = Arming(self._board)
        self._arming.inhibit('not configured')
        self._command = self._battery = self._speeds = None
        self._updated = time.monotonic()
        self._cycle, self._sent_at = 0, 0.0
        self._unsent: Counter = Counter()
        self._saturated, self._saturated_reported = np.zeros((2, 4), dtype=int)
        self.writes('battery_state', 'rotor_states')
        self.report('board', self._board_status)
        for k in range(4):
            self.report(f'rotor{k + 1}', partial(self._rotor_status, k))
        self.reads('command', self._on_command, max_age=COMMAND_AGE, expected=False)
        self.follows('supervisor/state', self._on_supervisor)
        self._timer = self.every(TARGET_PERIOD, self._on_timer, steady=True)

    def configure(self) -> None:
        """Open the port; from then on battery and rotors are published."""
        self._board.open()
        self._arming.inhibit('not activated')

    def activate(self) -> None:
        """Permit arming, which the supervisor requests."""
        self._arming.inhibit('')

    def deactivate(self) -> None:
        """Disarm, also in flight."""
        self._arming.inhibit('not activated')

    def release(self) -> None:
        """Disarm and close the port."""
        self._arming.inhibit('not configured')
        self._board.close()

    def close(self) -> None:
        """Disarm."""
        self._arming.end()
        self.send(self.state_topic, self._arming.text)
        self._board.close()

    def _on_command(self, command):
        self._command = command
        if self._send_thrusts():
            self._timer.reset()     # sends this command again after a period without a newer one
            self.latency.add(self.host.now() - command.stamp)

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
            self._send_thrusts()
        self._cycle += 1
        if self._cycle % POLL_CYCLES == 0:
            battery, rotors = self._board.poll()
            if battery is not None:
                self._battery = battery
                self.send('battery_state', battery)
            if rotors is not None:
                self._speeds = rotors
                self.send('rotor_states', RotorReading(rotors.stamp, RPM * rotors.rpm))
        self.changed()

    def _send_thrusts(self):
        """Send the newest thrusts while flying; return whether they were sent."""
        command = self._command
        if self._arming.phase != FLIES or command is None \
                or self.host.now() - command.stamp > COMMAND_AGE:
            return False
        reason = self._board.send(command.thrust, command.stamp)
        self._sent_at = time.monotonic()
        if reason:
            self._unsent[reason] += 1
            return False
        self._saturated += self._board.saturated
        return True

    def state_text(self) -> str:
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


# --- the loop in real time ----------------------------------------------------------------------

WAIT = 0.0005           # [s] between looks for messages of the drivers' threads
THREAD_SWITCH = 0.0005  # [s] a servo has 3 ms to answer


class EmulatedLoop(FlightLoop):
    """
    A flight whose commands go through bridges, drivers, serial ports and emulated devices.

    The devices keep real time, and so does this loop; its digits depend on the computer. Close it
    after the flight. Arguments are those of FlightLoop.
    """

    simulated = False
    start_timeout = 20.0    # [s] also for the bridges

    def __init__(self, robot, plant, *arguments, **options):
        for fault in options.get('faults', ()):
            if fault.changes(*DEVICES):
                raise ParameterError(f"--faults: '{fault.kind}' affects a device; expected "
                                     '--actuators direct')
        servos, board = ServoBusParameters.load(), MotorBoardParameters.load()
        self._began = time.monotonic()
        self._switch_interval = sys.getswitchinterval()
        super().__init__(robot, plant, *arguments, **options)
        devices = EmulatedActuators.of(self.simulator, plant, servos, seed=options.get('seed', 0))
        self.robot.use(devices)
        self._bridges: list[Bridge] = [
            JointBridge(replace(servos, port=devices.bus.port), robot),
            RotorBridge(replace(board, port=devices.board.port), robot)]
        sys.setswitchinterval(THREAD_SWITCH)
        for bridge in self._bridges:
            self.add(bridge)
            bridge.configure()
            bridge.activate()
            bridge.stage = ACTIVE
            bridge.changed()
        self._began = time.monotonic() - self.simulator.time

    def now(self) -> float:
        """Time on the clock of the stamps [s]."""
        return self.simulator.epoch + self.elapsed()

    def elapsed(self) -> float:
        """Real time since the start [s]."""
        return time.monotonic() - self._began

    def step(self) -> None:
        """Wait for the next tick, deliver the messages of the drivers meanwhile, and run it."""
        due = self._began + self.simulator.time + self.simulator.tick
        while (left := due - time.monotonic()) > 0:
            time.sleep(min(left, WAIT))
            self._now = self.now()
            self.deliver()
        super().step()

    def close(self) -> None:
        """Switch the devices off and end the recording."""
        for bridge in self._bridges:
            bridge.close()
        self.robot.close()
        sys.setswitchinterval(self._switch_interval)
        super().close()
