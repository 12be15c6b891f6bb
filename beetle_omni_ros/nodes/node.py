"""Base class of the package's nodes: parameters, checked inputs, diagnostics."""

from collections.abc import Callable
import time

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from beetle_omni_ros.messages.topics import Qos, topic_of
from beetle_omni_ros.messages.values import MessageError
from beetle_omni_ros.nodes import parameters, wire
from beetle_omni_ros.nodes.discovery import claim
from beetle_omni_ros.nodes.health import Health
from beetle_omni_ros.safety.events import ERROR, WARNING

FUTURE = 0.05       # s ahead of the clock above which a stamp is refused
UNIQUE_CHECKS = 3


class StartError(RuntimeError):
    """A node cannot start or continue; the text is one line for the operator."""


def check_unique_name(node: Node) -> None:
    """
    Check that the ROS graph has no other node of the same name.

    The commands of two supervisors or the estimates of two estimators would alternate on one
    topic.

    Raises:
        StartError: there is one.

    """
    own = (node.get_name(), node.get_namespace())
    if node.get_node_names_and_namespaces().count(own) > 1:
        raise StartError(f'{node.get_fully_qualified_name()} runs already on another computer '
                         f'(ROS domain {node.context.get_domain_id()}); stop it first')


class FlightNode(Node):
    """
    A node with declared parameters, checked inputs and diagnostics.

    Attributes:
        real_time: whether the node is part of the control loop and needs real-time priority.
        steady_clock: clock for timers that are independent of the flight.
        flight_clock: clock for timers of the flight; simulated time if ``use_sim_time`` is set.

    """

    real_time = False

    def __init__(self, name: str, parameter_class: type, file: str | None = None,
                 file_key: str | None = None, on_change: Callable | None = None,
                 changeable: tuple[str, ...] | None = None,
                 completed: Callable[[dict, bool], dict] | None = None):
        """
        Claim the name, read the parameters, start diagnostics.

        The arguments after ``name`` are those of :func:`parameters.declare`.

        Raises:
            ParameterError: unusable parameters.
            StartError: a node of this name runs already.

        """
        super().__init__(name)
        domain, name = self.context.get_domain_id(), self.get_fully_qualified_name()
        # At once for this computer; discovery of other ones takes seconds.
        self._claim = claim(f'{domain}{name}')
        if self._claim is None:
            raise StartError(f'{name} runs already (ROS domain {domain}); stop it first')
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        # Simulated time may stop, so timers of the flight must use it too.
        self.simulated = bool(self.get_parameter(parameters.CLOCK).value)
        self.flight_clock = self.get_clock() if self.simulated else self.steady_clock
        self.parameters = parameters.declare(self, parameter_class, file, file_key,
                                             on_change, changeable, completed)
        parameters.lock_clock(self)
        self.health = Health(self)
        self.get_logger().debug('started')      # the first call is slow: not during a flight
        self._unique_checks = 0
        self._unique_timer = self.create_timer(1.0, self._check_unique, clock=self.steady_clock)

    def now(self) -> float:
        """ROS time [s]."""
        return self.get_clock().now().nanoseconds * 1e-9

    def elapsed(self) -> float:
        """Return steady time, or simulated time if it is used [s]."""
        return self.now() if self.simulated else time.monotonic()

    def log_line(self, severity: str, text: str) -> None:
        """Log ``text`` with a severity of :mod:`~beetle_omni_ros.safety.events`."""
        # One call for each severity: rclpy ties a severity to the line of the call.
        logger = self.get_logger()
        if severity == ERROR:
            logger.error(text)
        elif severity == WARNING:
            logger.warning(text)
        else:
            logger.info(text)

    def publisher(self, topic: str) -> wire.Publisher:
        """Make the publisher of a topic."""
        return wire.Publisher(self, topic)

    def follow(self, topic: str, handle: Callable[[str], None]) -> None:
        """Pass the texts of a latched topic to ``handle``."""
        wire.subscribe(self, topic, handle)

    def listen(self, topic: str, handle: Callable, *, read: Callable | None = None,
               qos: Qos | None = None, any_qos: bool = False, max_age: float | None = None,
               stale_after: float | None = 0.5, published: bool = False,
               check: Callable | None = None) -> None:
        """
        Subscribe ``topic``; pass valid values to ``handle`` and count refused messages.

        Args:
            topic: relative name in the table of topics.
            handle: called with each value.
            read: message -> value with a ``stamp``, raises MessageError; default: the table's
                ``take``.
            qos: quality of service; default: the table's.
            any_qos: receive from publishers of any quality of service, see
                :class:`~beetle_omni_ros.nodes.wire.AnyQosSubscription`.
            max_age: limit of a stamp's age [s], also refuses future stamps; None: no check.
            stale_after: silence after a message that is an error [s]; None: never.
            published: whether ``check`` and ``handle`` also get the time of publication [s, system
                time, or nan].
            check: called with the value before ``handle``; raises MessageError.

        """
        entry, health = topic_of(topic), self.health
        read = read or entry.take
        health.watch(topic, stale_after)

        def callback(message, *publication):
            try:
                value = read(message)
                age = self.now() - value.stamp
                _check_age(age, max_age)
                if check is not None:
                    check(value, *publication)
            except MessageError as error:
                health.rejected(topic, str(error), error.kind)
                return
            health.received(topic, age)
            handle(value, *publication)

        kind = wire.message_class(entry.type)
        if any_qos:
            wire.AnyQosSubscription(self, kind, topic, callback if published else
                                    lambda message, _: callback(message))
            return
        taken = wire.with_publication(callback) if published else callback
        self.create_subscription(kind, topic, taken, wire.profile(qos or entry.qos))

    def timed(self, function: Callable, *args):
        """Call ``function`` and count its CPU and wall time."""
        cpu, wall = time.thread_time(), time.perf_counter()
        result = function(*args)
        self.health.computed(time.thread_time() - cpu, time.perf_counter() - wall)
        return result

    def _check_unique(self):
        # Discovery needs some seconds, so one check is not enough.
        check_unique_name(self)
        self._unique_checks += 1
        if self._unique_checks >= UNIQUE_CHECKS:
            self._unique_timer.cancel()

    def waits_for(self) -> str:
        """Return the inputs without which the node does not work, as text; '' for none."""
        return ', '.join(self.health.waits_for())

    def introduce(self) -> None:
        """Log in one line what the node does and which inputs are missing."""
        what, waits = (type(self).__doc__ or '').strip().partition('\n')[0], self.waits_for()
        self.get_logger().info(f"{what} Waits for {waits or 'nothing'}.")

    def close(self) -> None:
        """Release the resources of the node; overridden by subclasses."""

    def destroy_node(self) -> None:
        """Close, leave the graph, release the name."""
        self.close()
        super().destroy_node()
        if self._claim:
            self._claim.close()


def _check_age(age, limit):
    if limit is not None and age > limit:
        raise MessageError('stale stamp')
    if limit is not None and age < -FUTURE:
        raise MessageError('stamp in the future')
