"""ROS node of any registered controller: state and target in, command out."""

from dataclasses import dataclass, make_dataclass, replace
import math

from rclpy.node import Node

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import (
    called,
    checked,
    ControllerError,
    corrected,
    forward_health,
    guidance_of,
    PoseTarget,
    reach_of,
    State,
)
from beetle_omni_ros.control.registry import ControllerEntry
from beetle_omni_ros.messages.values import MessageError
from beetle_omni_ros.nodes import health
from beetle_omni_ros.nodes.command_source import CommandSource
from beetle_omni_ros.nodes.node import FlightNode
from beetle_omni_ros.robot.actuator_health import ALL_HEALTHY
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import parameter, ParameterError
from beetle_omni_ros.runs.target_checks import out_of_reach, TargetChecks

ODOM_AGE = 0.05         # s, no command answers an older estimate
JOINT_AGE = 0.1         # s
# s between a target's stamp and simulated time above which the stamp is of another clock
OTHER_CLOCK = 3600.0
STEP_TOLERANCE = 0.0025     # s, half of the smallest interval between estimates
NAME = 'controller_node'    # of the executable, before its controller is known


class ControllerNode(FlightNode):
    """
    Steps a controller once a period, triggered by the estimate.

    Before the first target it holds the pose at which it became active. While another controller
    is active, it still computes commands, so that it can take over without a jump. An exception of
    the controller is logged and reported in diagnostics; no command is then published.
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
        self._controller = entry.make(
            RobotParameters.load(self.parameters.robot_file or None),
            parameters=self.parameters if entry.parameters else None)
        self._target = self._joints = self._command = None
        self._hold = self._override = self._position = None
        self._actuators = ALL_HEALTHY
        self._checks = TargetChecks(RobotParameters.load(self.parameters.robot_file or None))
        self._mode, self._own_mode = '', f'flying:{entry.name}'
        self._last_step = 0.0
        self._errors, self._reported_errors = 0, 0
        self._error, self._logged = '', ('', -math.inf)     # text, time of the line
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
        self.health.track_compute(self._controller.period)
        self.health.report('controller', self._controller_status)

    def _on_joints(self, joints):
        self._joints = joints

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
            self._too_far(target) if self._mode == self._own_mode else '')
        if reason:
            raise MessageError(reason, 'cannot be flown')

    def _too_far(self, target):
        """Return why a target is out of reach from the present position, or ''."""
        return '' if self._position is None else out_of_reach(
            target, self._position, reach_of(self._controller), self.now())

    def _on_target(self, target, _=math.nan):
        now = self.now()
        if target.stamp == 0.0:     # `ros2 topic pub` sets no stamp: valid from now on
            target = self._from_now(target)
        elif target.stamp > now:    # a clock that is ahead must not make it outlast later targets
            target = replace(target, stamp=now)
        # Latched and volatile copies may overtake each other: the newest stamp counts, except
        # after the clock was set back.
        if self._target is None or not target.stamp < self._target.stamp <= now:
            self._target = target

    def _from_now(self, target):
        now = self.now()
        if isinstance(target, PoseTarget):
            return replace(target, stamp=now)
        return replace(target, stamp=now, times=target.times + now)

    def _on_override(self, override):
        self._override = override.target

    def _on_actuators(self, report):
        self._actuators = report.health
        self._call('set_health', forward_health, self._controller, report.health)

    def _on_mode(self, mode):
        state = mode.partition(':')[0]
        if state in ('disarmed', 'emergency_stop') and self._mode.partition(':')[0] != state:
            self._call('reset', self._controller.reset)
            self._command = self._hold = self._override = None
        took_over = mode == self._own_mode != self._mode
        self._mode = mode
        if took_over and self._target is not None and (reason := self._too_far(self._target)):
            # The target was accepted while another controller was active.
            self.health.rejected('target_pose', f'{reason}; the present pose is held',
                                 'cannot be flown')
            self._target = self._hold = None

    def _on_odom(self, odom):
        self._position = odom.position
        if self._joints is None or not self._is_due(odom.stamp):
            return
        self._last_step = odom.stamp
        state = corrected(State.join(odom, self._joints, self._command), self._actuators)
        if self._target is None:
            if self._hold is None or not self._mode.startswith('flying'):
                self._hold = PoseTarget(odom.position, odom.quaternion, odom.stamp)
        target = self._override or self._target or self._hold
        command = self._call('step', self._step, state, target)
        if command is not None:
            self._publisher.publish(command)

    def _step(self, state, target):
        return self.timed(self._controller.step, state, target)

    def _call(self, method, function, *arguments):
        """
        Return the result of a controller's method; None after an exception, which is logged.

        In a process with other nodes, the exception would end the supervisor, too.
        """
        try:
            result = called(self._entry.name, method, function, *arguments)
            return checked(self._entry.name, result) if method == 'step' else result
        except ControllerError as error:
            self._errors, self._error = self._errors + 1, str(error)
            text, at = self._logged
            if text != self._error and not 0 <= (now := self.elapsed()) - at < health.REPEAT:
                self._logged = self._error, now
                self.get_logger().error(self._error)
            return None

    def _is_due(self, stamp):
        period = self._controller.period
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
        if self._command is None or not self._mode.startswith('flying:') \
                or self._mode == self._own_mode:
            return False
        part = (stamp - self._command.stamp) / self._controller.period % 1.0
        return not 0.25 < part < 0.75

    def _controller_status(self):
        controller = self._controller
        report = self._call('diagnostics', getattr(controller, 'diagnostics', dict)) or {}
        new, self._reported_errors = self._errors - self._reported_errors, self._errors
        values = {**report, 'guidance': guidance_of(controller)}
        if self._errors:
            values['errors'] = self._errors
        if new:
            return health.ERROR, self._error, values
        return health.OK, getattr(controller, 'name', self._entry.name), values


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
