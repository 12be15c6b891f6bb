"""The ROS host of a component: parameters, subscriptions, publishers, timers, diagnostics."""

from collections.abc import Callable
from functools import partial
import time
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from beetle_omni_ros.bags.messages import MessageError
from beetle_omni_ros.bags.topics import topic_of
from beetle_omni_ros.flight.component import Component, DIAGNOSTICS_PERIOD, node_name
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import parameter
from beetle_omni_ros.ros import parameters, wire
from beetle_omni_ros.ros.graph import claim


class FlightNode(Node):
    """
    A node with declared parameters that runs one component.

    Every second it publishes the component's diagnostics.

    Attributes:
        component: what it runs, see :meth:`run`.
        simulated: whether it uses simulated time.
        steady_clock: clock for timers that are independent of the flight.
        stop: future that ends the process; its exception is reported without a traceback.

    """

    def __init__(self, name: str, base: type | None = None, file: str | None = None,
                 file_key: str | None = None, on_change: Callable | None = None,
                 changeable: tuple[str, ...] = (), **more):
        """
        Claim the name (OSError if such a node runs) and read the parameters.

        The parameters are those of the class ``base``, ``file_key`` and ``more`` (name -> field).
        The arguments from ``file`` on are those of :func:`parameters.declare`.
        """
        super().__init__(name)
        domain, name = self.context.get_domain_id(), self.get_fully_qualified_name()
        self._claim = claim(f'{domain}{name}')
        if self._claim is None:
            raise OSError(f'{name} runs already (ROS domain {domain}); stop it first')
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.simulated = bool(self.get_parameter(parameters.CLOCK).value)
        if file_key:
            more[file_key] = parameters.file_parameter('parameter file')
        self.parameters = parameters.declare(
            self, parameters.extended(f'{name}_parameters', base, more), file, file_key,
            on_change, changeable)
        self.component: Component
        self.warn = wire.warner(self)
        self.stop = Future()
        self._outputs: dict[str, wire.Publisher] = {}
        self.get_logger().debug('started')      # the first call is slow: not during a flight

    @property
    def robot(self) -> RobotParameters:
        """Robot of the parameter robot_file."""
        return RobotParameters.load(self.parameters.robot_file or None)

    def run(self, component: Component) -> None:
        """Connect a component to its topics, timers and services."""
        self.component = component
        component.name = self.get_name()
        for topic in (*component.outputs, 'diagnostics'):
            self._outputs[topic] = wire.Publisher(self, topic)
        for topic, entry in component.inputs.items():
            wire.subscribe_raw(self, topic, partial(self._receive, topic, topic_of(topic)),
                               entry.qos)
        component.attach(self)
        # Simulated time may stop, so timers of the flight must use it too.
        flight_clock = self.get_clock() if self.simulated else self.steady_clock
        for timer in component.timers:
            timer.reset = self.create_timer(
                timer.period, timer.call,
                clock=self.steady_clock if timer.steady else flight_clock).reset
        for service, answer in component.services.items():
            self.create_service(Trigger, f'~/{service}', partial(_answer, answer))
        self.create_timer(DIAGNOSTICS_PERIOD, lambda: self.publish(
            'diagnostics', component.diagnostics()), clock=self.steady_clock)

    def _receive(self, topic, entry, data, published=None):
        component = self.component
        try:
            message = wire.message(entry, data)
            value = entry.take(message)
        except MessageError as error:
            component.reject(topic, str(error), error.kind)
            return
        component.feed(topic, value, message.header.frame_id if topic == 'command' else '',
                       published)

    # Host of the component --------------------------------------------------------------------

    def now(self) -> float:
        """ROS time [s]; the system's time costs a tenth of the call of rclpy."""
        return self.get_clock().now().nanoseconds * 1e-9 if self.simulated else time.time()

    def elapsed(self) -> float:
        """Return steady time, or simulated time if it is used [s]."""
        return self.now() if self.simulated else time.monotonic()

    def publish(self, topic: str, value: Any, source: str = '') -> None:
        """Publish a value; ``source`` is the frame_id of a command."""
        self._outputs[topic].publish(value, source or None)

    def log(self, severity: str, text: str) -> None:
        """Log ``text`` with a severity of :mod:`~beetle_omni_ros.supervisor.interface`."""
        # One call for each severity: rclpy ties a severity to the line of the call.
        logger = self.get_logger()
        if severity == 'error':
            logger.error(text)
        elif severity == 'warning':
            logger.warning(text)
        else:
            logger.info(text)

    # Life of the node -------------------------------------------------------------------------

    def introduce(self) -> None:
        """Log in one line what the node does and which inputs are missing."""
        kind = type(self.component)
        what = ((type(self) if kind is Component else kind).__doc__ or '').strip() \
            .partition('\n')[0]
        waits = ', '.join(self.component.missing)
        self.get_logger().info(f'{what} Waits for {waits}.' if waits else what)

    def close(self) -> None:
        """Release the resources of the node; overridden by subclasses."""

    def destroy_node(self) -> None:
        """Close, leave the graph, release the name."""
        self.close()
        super().destroy_node()
        self._claim.close()


class ComponentNode(FlightNode):
    """Node of a component of others; ``reference`` is that of its class."""

    def __init__(self, kind: type[Component], reference: str):
        super().__init__(node_name(kind), robot_file=parameters.file_parameter(),
                         component=parameter(reference, doc='component that this node runs'))
        self.run(kind(self.robot))      # type: ignore[arg-type]


def _answer(service, _, response):
    """Answer a Trigger request by a component's service."""
    answer = service()
    response.success, response.message = bool(answer), answer.text
    return response
