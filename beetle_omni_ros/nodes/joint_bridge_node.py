"""ROS node of the tilt servos: commands to the bus, measured angles from it."""

from dataclasses import dataclass
import math
import time

from std_srvs.srv import Trigger

from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.drivers.servo_bus import ServoBus
from beetle_omni_ros.drivers.servo_link import ServoBusError
from beetle_omni_ros.drivers.servo_loop import ServoLoop
from beetle_omni_ros.nodes.lifecycle_node import ACTIVE, AUTOSTART, INACTIVE, LifecycleFlightNode
from beetle_omni_ros.nodes.node import CommandSource, Distribution, ERROR, OK, WARN
from beetle_omni_ros.robot.parameters import JOINT_NAMES, RobotParameters
from beetle_omni_ros.robot.readings import JointReading
from beetle_omni_ros.robot.schema import parameter

COMMAND_AGE = 0.1       # [s] older commands are not written
LOST_AFTER = 0.3        # [s] after which a servo without response or torque is lost
CHECK_PERIOD = 0.05     # [s] between checks of the bus thread's events


@dataclass(frozen=True, kw_only=True)
class JointBridgeNodeParameters(ServoBusParameters):
    """Parameters of joint_bridge_node: the bus's parameters, the files, and autostart."""

    robot_file: str = parameter('', doc='robot file; empty: the shipped one', read_only=True)
    servo_bus_file: str = parameter(
        '', doc='servo file to start from; empty: the shipped params/servo_bus.yaml',
        read_only=True)
    autostart: str = parameter('none', choices=tuple(AUTOSTART), read_only=True,
                               doc='transition at the start, repeated until it succeeds')


class JointBridgeNode(LifecycleFlightNode):
    """Lifecycle node: configure checks the servos, activate switches their torque on."""

    real_time = True
    refusals = (ServoBusError, SerialPortError)

    def __init__(self):
        super().__init__('joint_bridge_node', JointBridgeNodeParameters, 'params/servo_bus.yaml',
                         'servo_bus_file', on_change=self._changed,
                         changeable=('confirm_tilts', 'confirmed_tilts'))
        self._travel = RobotParameters.load(self.parameters.robot_file or None).joints
        self._bus = self._loop = None
        self._lost_reason = ''
        self._latency, self._since = Distribution(), 'publication'
        self._state = self.publisher('joint_bridge/state')
        self._published = ''
        self._joints = self.publisher('joint_states')
        self.listen('command', self._on_command, read=CommandSource(self).read,
                    max_age=COMMAND_AGE, stale_after=None, published=True)
        # loop, its cycles and missed cycles, and the time of the last bus status
        self._counted = (None, 0, 0, time.monotonic())
        self.health.report('bus', self._bus_status)
        self.health.report('latency', self._latency_status)
        for k, name in enumerate(JOINT_NAMES):
            self.health.report(name, lambda k=k: servo_status(self._bus, k))
            self.create_service(Trigger, f'~/reboot_{name}',
                                lambda request, response, k=k: self._on_reboot([k], response))
        self.create_service(Trigger, '~/reboot', lambda request, response: self._on_reboot(
            None, response))
        self.create_timer(CHECK_PERIOD, self.changed, clock=self.steady_clock)
        self.start_by_itself(self.parameters.autostart)
        self.changed()

    def waits_for(self):
        """Return the state of the servos."""
        return self._published.replace('waiting:', 'its servos:')

    # --- lifecycle ----------------------------------------------------------------------------

    def configure(self):
        """Open the port, check and write the servos' settings, and start to read angles."""
        self._bus = ServoBus(self.parameters, self._travel, self.now)
        self._bus.open()
        self._bus.configure()
        self._lost_reason = ''
        self._loop = ServoLoop(self._bus, self._publish, self._on_written)
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
        self.changed()

    def _changed(self, new):
        self.parameters = new
        if self._loop is not None:
            with self._loop.exclusive() as bus:
                bus.parameters = new

    def _on_reboot(self, which, response):
        if self._loop is None:
            response.success, response.message = False, 'not configured'
            return response
        if which is None:
            which = [k for k, servo in enumerate(self._bus.servos)
                     if servo.errors and not servo.torque] or range(4)
        with self._loop.exclusive() as bus:
            for k in which:
                bus.reboot(int(self.parameters.ids[k]))
        response.success = True
        response.message = f"restarting {', '.join(JOINT_NAMES[k] for k in which)}"
        return response

    # --- the loop -----------------------------------------------------------------------------

    def _on_command(self, command, published):
        if self._loop is not None:
            if math.isnan(published):
                self._since, published = 'arrival', time.time()
            left = COMMAND_AGE - max(0.0, self.now() - command.stamp)
            self._loop.offer(command.tilt, published, time.monotonic() + left)

    def _on_written(self, published):
        self._latency.add(time.time() - published)

    def _publish(self, readings, good):
        if good.all():
            self._joints.publish(JointReading(
                readings.stamp, readings.position, readings.velocity, readings.effort))
        elif good.any():
            self._joints.publish(JointReading(
                readings.stamp, readings.position[good], readings.velocity[good],
                readings.effort[good], [n for n, is_good in zip(JOINT_NAMES, good) if is_good]))

    # --- state and diagnostics ----------------------------------------------------------------

    def changed(self):
        """Log the thread's events; publish the state if it changed."""
        if self._loop is not None:
            self._log(self._bus)
        text = self._state_text()
        if text != self._published:
            if text.startswith('lost') and not self._lost_reason:
                self.get_logger().error(text)
            else:
                self.get_logger().info(text)
            self._published = text
            self._state.publish(text)

    def _log(self, bus):
        for line in bus.take_events():
            self.get_logger().warning(line)

    def _state_text(self):
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
        loop, bus, text, now = self._loop, self._bus, self._published, time.monotonic()
        if loop is None:
            return (WARN if self.stage == ACTIVE else OK), text, {
                'stage': self.stage}
        before, cycles, missed, then = self._counted
        if loop is not before:
            cycles = missed = 0
        values = {
            'stage': self.stage, 'cycles': loop.cycles, 'missed_cycles': loop.missed,
            'rate_hz': (loop.cycles - cycles) / max(now - then, 1e-3),
            'connected': bus.link.is_open, 'goals_written': loop.written,
            'goals_stale': loop.stale, 'goals_clipped': bus.clipped,
            'incomplete': loop.incomplete, **bus.link.counts}
        missed = loop.missed - missed
        self._counted = (loop, loop.cycles, loop.missed, now)
        if text.startswith('lost'):
            return ERROR, text, values
        if not bus.link.is_open:
            return WARN, 'no connection', values
        return (WARN, f'{missed} cycles missed', values) if missed else \
            (OK, text, values)

    def _latency_status(self):
        times = self._latency
        return OK, f'{self._since} of command to its last byte written', {
            **times.milliseconds(), 'count': times.count}


def servo_status(bus, index):
    """Return level, text and values of one servo."""
    if bus is None:
        return OK, 'not configured', {}
    one = bus.servos[index]
    recovering = one.recovery is not None or one.restarting
    values = {'id': one.identifier, 'responding': not one.silent,
              'torque': 'unknown' if one.torque is None else one.torque,
              'voltage_v': one.voltage, 'temperature_c': one.temperature,
              'errors': ', '.join(one.errors) or 'none',
              'watchdog_expired': one.watchdog_expired, 'recovering': recovering}
    if one.message:
        bad = one.silent or (one.errors and not one.torque)
        return (ERROR if bad else WARN), one.message, values
    return OK, 'being brought back' if recovering else 'ok', values
