"""
The ROS host of a component: parameters, subscriptions, publishers, timers, diagnostics.

ROS ignores an override of an undeclared key, and a bad value causes a traceback. Here, the checks
of the parameter files refuse both at the start of the node, in one line that names the key.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import make_dataclass, MISSING
from functools import partial
import time
from typing import Any

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from beetle_omni_ros.bags.messages import MessageError
from beetle_omni_ros.bags.topics import topic_of
from beetle_omni_ros.flight.component import Component, DIAGNOSTICS_PERIOD, node_name
from beetle_omni_ros.model import schema
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import NAMES, parameter, ParameterError
from beetle_omni_ros.ros import wire
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
        The arguments from ``file`` on are those of :func:`declare`.
        """
        super().__init__(name)
        domain, name = self.context.get_domain_id(), self.get_fully_qualified_name()
        self._claim = claim(f'{domain}{name}')
        if self._claim is None:
            raise OSError(f'{name} runs already (ROS domain {domain}); stop it first')
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.simulated = bool(self.get_parameter(CLOCK).value)
        if file_key:
            more[file_key] = file_parameter('parameter file')
        self.parameters = declare(
            self, extended(f'{name}_parameters', base, more), file, file_key,
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

    def run(self, component: Component) -> FlightNode:
        """Connect a component to its topics, timers and services; return this node."""
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
        return self

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


def component_node(kind: type[Component], reference: str) -> FlightNode:
    """Make the node of a component of others; ``reference`` is that of its class."""
    node = FlightNode(node_name(kind), robot_file=file_parameter(),
                      component=parameter(reference, doc='component that this node runs'))
    return node.run(kind(node.robot))       # type: ignore[arg-type]


def _answer(service, _, response):
    """Answer a Trigger request by a component's service."""
    answer = service()
    response.success, response.message = bool(answer), answer.text
    return response


# Overrides that ROS itself adds.
CLOCK = 'use_sim_time'
ROS_OWN = (CLOCK, 'start_type_description_service')
ROS_OWN_PREFIX = 'qos_overrides.'


def file_parameter(what: str = 'robot file'):
    """Make the parameter of a node that names a file."""
    return schema.parameter('', doc=f'{what}; empty: the shipped one')


def extended(name: str, base: type | None, fields: dict) -> type:
    """Make a parameter class: ``base`` with more texts, numbers or lists of names."""
    return make_dataclass(
        name, [(key, NAMES if isinstance(entry.default, tuple) else
                str if entry.default is MISSING else type(entry.default), entry)
               for key, entry in fields.items()],
        bases=(base,) if base else (), kw_only=True,
        frozen=base is None or base.__dataclass_params__.frozen)


def declare(node: Node, cls: type, file: str | None = None, file_key: str | None = None,
            on_change: Callable | None = None, changeable: tuple[str, ...] = ()):
    """
    Declare every leaf of the parameter dataclass ``cls``; return its validated instance.

    Overrides of the command line (``--params-file``, ``-p``) precede the values of the file, and
    these precede the defaults of the class. ``file`` is the shipped one, the parameter
    ``file_key`` names another. Names that begin with one of ``changeable`` may be set in flight;
    ``on_change`` gets the new instance, and may raise ParameterError to refuse it.

    Raises:
        ParameterError: unusable value; names file, key and expectation.

    """
    overrides = {name: value.value for name, value in node._parameter_overrides.items()
                 if name not in ROS_OWN and not name.startswith(ROS_OWN_PREFIX)}
    start_from = overrides.get(file_key) or (share_path(file) if file else None)
    mapping = schema.load_yaml(start_from) if start_from else {}
    for name, value in overrides.items():
        schema.put(mapping, name, value)
    instance = schema.bind(cls, mapping)
    for name, entry, hint, value in schema.flatten(instance):
        if isinstance(value, (dict, tuple)) and hint != NAMES:
            continue    # structured values live in files only
        node.declare_parameter(name, _plain(value), _descriptor(
            entry, hint, not name.startswith(changeable)), ignore_override=True)
    if on_change:
        _validate_changes(node, cls, instance, on_change)
    return instance


def _plain(value):
    if isinstance(value, np.ndarray):
        return value.ravel().astype(float).tolist()
    if value is None:       # an optional number that is not set
        return float('nan')
    return list(value) if isinstance(value, tuple) else value


def _descriptor(entry, hint, fixed) -> ParameterDescriptor:
    meta = entry.metadata
    unit = f" [{meta['unit']}]" if meta.get('unit') else ''
    return ParameterDescriptor(
        description=meta.get('doc', '') + unit,
        # ROS gives an empty list another type, and [2] is a list of integers.
        dynamic_typing=hint is np.ndarray and meta.get('shape') is None or hint == NAMES,
        read_only=fixed,
        additional_constraints=f"one of {', '.join(meta['choices'])}" if meta.get('choices')
        else ' to '.join(f'{meta[end]:g}' for end in ('low', 'high')
                         if meta.get(end) is not None))


def _validate_changes(node, cls, instance, on_change):
    current = {name: value for name, _, _, value in schema.flatten(instance)}

    def changed(parameters):
        # ROS itself refuses read-only and unknown names.
        proposed = current | {each.name: each.value for each in parameters if each.name in current}
        try:
            new = schema.bind(cls, schema.nest(proposed), node.get_name())
            on_change(new)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        current.update(proposed)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(changed)
