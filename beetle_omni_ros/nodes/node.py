"""What every node of the package shares: parameters, guarded inputs, diagnostics."""

from __future__ import annotations

from collections.abc import Callable
import time

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from beetle_omni_ros.messages.topics import Qos, topic_of
from beetle_omni_ros.messages.values import MessageError
from beetle_omni_ros.nodes import parameters, wire
from beetle_omni_ros.nodes.health import Health
from beetle_omni_ros.nodes.private import HeldError, Lock

# A stamp this far ahead of the clock comes from another clock.
FUTURE = 0.05
TWIN_CHECKS = 3


class StartError(RuntimeError):
    """A node cannot start or go on; the text is one line for the operator."""


def claim(node: Node):
    """
    Take the node's lock until it is closed, or the process ends.

    Two supervisors, or two estimators, on one set of topics would take turns with the robot. A
    lock file names the holder at once on the same computer and goes with its process, however
    that ends; a node on another computer is seen in the ROS graph.

    Raises:
        StartError: another process of this computer holds it.

    """
    domain = node.context.get_domain_id()
    name = node.get_fully_qualified_name()
    try:
        return Lock(f"{domain}{name.replace('/', '.')}.lock")
    except HeldError as error:
        raise StartError(f'{name} runs already (process {str(error) or "unknown"}, ROS domain '
                         f'{domain}); stop it first') from None
    except OSError as error:    # the graph check still stands
        node.get_logger().warning(f'a second {name} on this computer may go unnoticed: {error}')
        return None


def refuse_twin(node: Node) -> None:
    """
    Look for a node of the same name elsewhere in the ROS graph.

    Raises:
        StartError: there is one.

    """
    own = (node.get_name(), node.get_namespace())
    if node.get_node_names_and_namespaces().count(own) > 1:
        raise StartError(f'{node.get_fully_qualified_name()} runs already on another computer '
                         f'(ROS domain {node.context.get_domain_id()}); stop it first')


class FlightNode(Node):
    """
    A node whose inputs are checked before its code sees them.

    Attributes:
        real_time: whether it is part of the control loop and runs before ordinary processes.
        steady_clock: for timers that have nothing to do with the flight.
        flight_clock: for those that have; simulated time where ``use_sim_time`` is set.

    """

    real_time = False

    def __init__(self, name: str, parameter_class: type, file: str | None = None,
                 file_key: str | None = None, on_change: Callable | None = None,
                 changeable: tuple[str, ...] | None = None,
                 completed: Callable[[dict, bool], dict] | None = None):
        """
        Claim the name, read the parameters, start diagnostics.

        Args:
            name: default node name.
            parameter_class: see :func:`parameters.declare`, as for the rest.
            file: shipped parameter file.
            file_key: parameter that names another one.
            on_change: takes a changed instance.
            changeable: names that may be set in flight.
            completed: adds to what a file says.

        Raises:
            ParameterError, StartError: with one line for the operator.

        """
        super().__init__(name)
        self._claim = claim(self)
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        # Simulated time may stand still; what times a flight then goes by it, and by nothing else.
        self.simulated = bool(self.get_parameter(parameters.CLOCK).value)
        self.flight_clock = self.get_clock() if self.simulated else self.steady_clock
        self.parameters = parameters.declare(self, parameter_class, file, file_key,
                                             on_change, changeable, completed)
        parameters.lock_clock(self)
        self.health = Health(self)
        self.get_logger().debug('started')      # the first call is slow: not in flight
        self._twin_checks = 0
        self._twin_timer = self.create_timer(1.0, self._look_for_twin, clock=self.steady_clock)

    def now(self) -> float:
        """ROS time [s]."""
        return self.get_clock().now().nanoseconds * 1e-9

    def elapsed(self) -> float:
        """Time that nobody sets [s]: steady, or simulated where that is used."""
        return self.now() if self.simulated else time.monotonic()

    def publisher(self, topic: str) -> wire.Publisher:
        """Make a publisher of a topic's values."""
        return wire.Publisher(self, topic)

    def follow(self, topic: str, handle: Callable[[str], None]) -> None:
        """Pass the latched text of a topic to ``handle``, whenever it changes."""
        wire.subscribe(self, topic, handle)

    def listen(self, topic: str, handle: Callable, *, read: Callable | None = None,
               qos: Qos | None = None, every_offer: bool = False, max_age: float | None = None,
               stale_after: float | None = 0.5, published: bool = False,
               check: Callable | None = None) -> None:
        """
        Subscribe ``topic``: read its values, refuse what is bad, pass on to ``handle``.

        Args:
            topic: relative name, of the table of topics.
            handle: called with the value.
            read: message -> value with a ``stamp``, other than the table's ``take``; raises
                MessageError.
            qos: other than what the topic's publisher offers.
            every_offer: hear publishers of any quality of service, see
                :class:`~beetle_omni_ros.nodes.wire.EveryOffer`.
            max_age: refuse stamps older than this, or ahead of the clock [s]; None: any.
            stale_after: silence that is an error, once the topic came [s]; None: none.
            published: pass the time of publication [s, system time, or nan] to ``check`` and
                ``handle`` too.
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
        if every_offer:
            wire.EveryOffer(self, kind, topic, callback if published else
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

    def _look_for_twin(self):
        # Discovery takes its time: look a few times after the start, then never again.
        refuse_twin(self)
        self._twin_checks += 1
        if self._twin_checks >= TWIN_CHECKS:
            self._twin_timer.cancel()

    def waits_for(self) -> str:
        """What has to come before it does its work; '' where nothing has to."""
        return ', '.join(self.health.waits_for())

    def introduce(self) -> None:
        """Say in one line what it is and what it waits for."""
        what, waits = (type(self).__doc__ or '').strip().partition('\n')[0], self.waits_for()
        self.get_logger().info(f"{what} Waits for {waits or 'nothing'}.")

    def close(self) -> None:
        """Release what only this node holds; each node says what."""

    def destroy_node(self) -> None:
        """Close, leave the graph, let go of the name."""
        self.close()
        super().destroy_node()
        if self._claim:
            self._claim.close()
            self._claim = None


def _check_age(age, limit):
    if limit is not None and age > limit:
        raise MessageError('stale stamp')
    if limit is not None and age < -FUTURE:
        raise MessageError('stamp in the future')
