"""ROS node of any registered controller: state and target in, command out."""

from dataclasses import dataclass, make_dataclass, replace
import math

from rclpy.node import Node

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of, PoseTarget, State
from beetle_omni_ros.control.host import ControllerHost, MOTORS_OFF
from beetle_omni_ros.control.registry import ControllerEntry
from beetle_omni_ros.messages.values import MessageError
from beetle_omni_ros.nodes.node import CommandSource, ERROR, FlightNode, OK, REPEAT
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter, ParameterError
from beetle_omni_ros.runs.targets import TargetChecks

ODOM_AGE = 0.05         # s, no command answers an older estimate
JOINT_AGE = 0.1         # s
# s between a target's stamp and simulated time above which the stamp is of another clock
OTHER_CLOCK = 3600.0
STEP_TOLERANCE = 0.0025     # s, half of the smallest interval between estimates
NAME = 'controller_node'    # of the executable, before its controller is known


class ControllerNode(FlightNode):
    """
    Steps a controller once a period, triggered by the estimate; see ControllerHost.

    An exception of the controller is logged and reported in diagnostics.
    """

    real_time = True

    def __init__(self, controller: ControllerEntry | str = ''):
        """
        Build the controller and subscribe its inputs.

        Args:
            controller: registry entry, name or ``package.module:Class``; '' reads the node's
                parameter ``controller``. Commands go to '<name>/command'.

        """
        entry = controller if isinstance(controller, ControllerEntry) else \
            registry.find(controller or _requested_controller())
        is_own = isinstance(controller, str) and controller     # the executable has one controller
        super().__init__(f'{entry.name}_node', node_parameters(entry, not is_own),
                         entry.parameters_file, entry.file_key, completed=entry.completed)
        self._entry = entry
        robot = RobotParameters.load(self.parameters.robot_file or None)
        controller = entry.make(
            robot, parameters=self.parameters if entry.parameter_class else None)
        self._host = ControllerHost(entry.name, controller, self.timed, self._log)
        self._checks, self._sensors = TargetChecks(robot), robot.sensors
        self._joints = self._command = None
        self._last_step = 0.0
        self._reported_errors, self._logged = 0, ('', -math.inf)    # text, time of the line
        self._publisher = self.publisher(f'{entry.name}/command')
        self.listen('odom', self._on_odom, max_age=ODOM_AGE)
        self.listen('joint_states', self._on_joints, max_age=JOINT_AGE)
        self.listen('command', self._on_command, read=CommandSource(self).read, stale_after=None)
        # Publishers that follow INTERFACES latch targets; `ros2 topic pub` does not.
        for topic in ('target_pose', 'target_trajectory'):
            self.listen(topic, self._on_target, any_qos=True, stale_after=None,
                        published=True, check=self._check_target)
        self.follow('supervisor/state', self._on_mode)
        self.listen('supervisor/target', self._on_override, stale_after=None)
        self.listen('supervisor/actuators', self._on_actuators, stale_after=None)
        self.health.track_compute(controller.period)
        self.health.report('controller', self._controller_status)

    def _on_joints(self, joints):
        self._joints = joints.corrected(self._sensors)

    def _on_command(self, command):
        self._command = command

    def _check_target(self, target, published):
        # The age counts at publication: a latched target stays valid for a node that starts
        # later. Publication times are system time. In simulated time, only a stamp that is very
        # far off is refused, once the clock is known.
        then = None if math.isnan(published) else published
        if self.simulated:
            now = self.now()
            then = now if now and abs(now - target.stamp) > OTHER_CLOCK else None
        reason = self._checks.why_not(target, then) or (
            self._host.too_far(target, self.now()) if self._host.active else '')
        if reason:
            raise MessageError(reason, 'cannot be flown')

    def _on_target(self, target, _=math.nan):
        now = self.now()
        if target.stamp == 0.0:     # `ros2 topic pub` sets no stamp: valid from now on
            target = self._from_now(target)
        elif target.stamp > now:    # a clock that is ahead must not make it outlast later targets
            target = replace(target, stamp=now)
        # Latched and volatile copies may overtake each other: the newest stamp counts, except
        # after the clock was set back.
        old = self._host.target
        if old is None or not target.stamp < old.stamp <= now:
            self._host.target = target

    def _from_now(self, target):
        now = self.now()
        if isinstance(target, PoseTarget):
            return replace(target, stamp=now)
        return replace(target, stamp=now, times=target.times + now)

    def _on_override(self, override):
        self._host.override = override.target

    def _on_actuators(self, report):
        self._host.on_health(report.health)

    def _on_mode(self, mode):
        if mode.partition(':')[0] in MOTORS_OFF:
            self._command = None
        if reason := self._host.on_mode(mode, self.now()):
            self.health.rejected('target_pose', f'{reason}; the present pose is held',
                                 'cannot be flown')

    def _on_odom(self, odom):
        self._host.on_estimate(odom)
        if self._joints is None or not self._is_due(odom.stamp):
            return
        self._last_step = odom.stamp
        command = self._host.step(State.join(odom, self._joints, self._command))
        if command is not None:
            self._publisher.publish(command)

    def _log(self, error):
        text, at = self._logged
        if text != error and not 0 <= (now := self.elapsed()) - at < REPEAT:
            self._logged = error, now
            self.get_logger().error(error)

    def _is_due(self, stamp):
        period = self._host.controller.period
        since = stamp - self._last_step
        if since < 0:
            return True     # the clock was set back
        if self._coincides_with_active(stamp):
            # One estimate later: from then on this node computes between the steps of the active
            # controller, whose command would otherwise be delayed.
            period *= 1.5
        return since >= period - STEP_TOLERANCE

    def _coincides_with_active(self, stamp):
        """Whether the active controller is another one and answers the same estimates."""
        host = self._host
        if self._command is None or not host.mode.startswith('flying:') or host.active:
            return False
        part = (stamp - self._command.stamp) / host.controller.period % 1.0
        return not 0.25 < part < 0.75

    def _controller_status(self):
        host, controller = self._host, self._host.controller
        report = host.call('diagnostics', getattr(controller, 'diagnostics', dict)) or {}
        new, self._reported_errors = host.errors - self._reported_errors, host.errors
        values = {**report, 'guidance': guidance_of(controller)}
        if host.errors:
            values['errors'] = host.errors
        if new:
            return ERROR, host.error, values
        return OK, getattr(controller, 'name', self._entry.name), values


class NmpcNode(ControllerNode):
    """Publishes nmpc/command, stamped with the state that it answers."""

    def __init__(self):
        super().__init__('nmpc')


class RlNode(ControllerNode):
    """Publishes rl/command, stamped with the state that it answers."""

    def __init__(self):
        super().__init__('rl')


@dataclass(frozen=True, kw_only=True)
class NoParameters:
    """Parameters of a controller that has none."""


def node_parameters(entry: ControllerEntry, selectable: bool) -> type:
    """Make the parameter class of a controller's node: controller, robot and controller file."""
    base = entry.parameter_class or NoParameters
    more = {'robot_file': ('', 'robot file of the controller; empty: the shipped one'),
            entry.file_key: ('', f"controller file; empty: {entry.parameters_file or 'none'}")}
    if selectable:
        more['controller'] = (entry.reference, 'controller that this node runs')
    return make_dataclass(
        f'{entry.name}_parameters',
        [(name, str, parameter(default, doc=doc, read_only=True))
         for name, (default, doc) in more.items()],
        bases=(base,), frozen=base.__dataclass_params__.frozen, kw_only=True)


def _requested_controller() -> str:
    """Read the parameter ``controller`` by a temporary node, before the real one is made."""
    probe = Node(NAME, start_parameter_services=False, enable_rosout=False)
    given, name = probe._parameter_overrides.get('controller'), probe.get_name()
    probe.destroy_node()
    if given is not None:
        return str(given.value)
    if name != NAME:
        return name.removesuffix('_node')
    raise ParameterError("key 'controller': missing; expected a registered controller "
                         f"({', '.join(registry.names())}) or {registry.CLASS}")
