"""ROS nodes of estimator, controllers, supervisor, targets of a task, recorder and viewers."""

from functools import partial
import json
import sys

from rcl_interfaces.srv import SetParameters

from beetle_omni_ros.bags.bag_writer import BagWriter, FRAMES, FrameWriter
from beetle_omni_ros.bags.topics import LATCHED_LOG, LOG, SENSOR, topics_with
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerEntry
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.flight.component import Component, component_class, ERROR, OK, WARN
from beetle_omni_ros.flight.stack import ControllerComponent, Estimator, SupervisorComponent
from beetle_omni_ros.flight.surroundings import TaskReference
from beetle_omni_ros.model.schema import parameter, ParameterError, RunError
from beetle_omni_ros.ros import wire
from beetle_omni_ros.ros.graph import NODES
from beetle_omni_ros.ros.node import file_parameter, FlightNode
from beetle_omni_ros.supervisor.interface import SupervisorParameters


def ekf_node() -> FlightNode:
    """Make the node of the state estimator."""
    node = FlightNode('ekf_node', EkfParameters, 'params/ekf.yaml', 'ekf_file',
                      robot_file=file_parameter())
    return node.run(Estimator(node.parameters, node.robot))


def controller_node(entry: ControllerEntry) -> FlightNode:
    """Make the node of a controller, whose exceptions are logged and reported."""
    more = {} if f'{entry.name}_node' in NODES else {'controller': parameter(
        entry.reference, doc='controller that this node runs')}
    node = FlightNode(f'{entry.name}_node', entry.parameter_class, entry.parameters_file,
                      f'{entry.name}_file', robot_file=file_parameter(), **more)
    robot = node.robot
    return node.run(ControllerComponent(entry.name, entry.make(
        robot, parameters=node.parameters if entry.parameter_class else None), robot))


def supervisor_node() -> FlightNode:
    """Make that of the supervisor; its parameter controller selects the active one, also later."""
    def changed(new):
        answer = component.select(new.controller)
        if not answer:
            raise ParameterError(f"key 'controller': {answer.text}")

    controllers = parameter(registry.STANDING_BY, doc=(
        'controllers that may be active: registered names, or FILE.py:Class'))
    node = FlightNode('supervisor_node', SupervisorParameters, 'params/supervisor.yaml',
                      'supervisor_file', changed, changeable=('controller',),
                      controllers=controllers, robot_file=file_parameter())
    given = node.parameters
    names = [registry.find(name).name if ':' in name else name for name in given.controllers]
    if given.controller not in names:
        raise ParameterError(f"key 'controller': expected one of {', '.join(names)}, found "
                             f"'{given.controller}'")
    component = SupervisorComponent(given, node.robot, names)
    return node.run(component)


def reference_node() -> FlightNode:
    """Make the node of the targets of a task."""
    node = FlightNode('reference_node',
                      task=parameter('hover', doc='name of a task, or a CSV file of poses'),
                      seed=parameter(0, doc='seed of random poses', low=0, high=2**31 - 1))
    payload = node.create_client(SetParameters, 'sim_node/set_parameters')
    return node.run(TaskReference(
        make_task(node.parameters.task, node.parameters.seed),
        lambda mass: payload.call_async(wire.parameter_request('payload', mass))))


LINE = 'rcl_interfaces/msg/Log'
WRITE_PERIOD = 0.02     # s between writes of the received messages, so that no callback waits
FLUSH_WRITES = 20       # writes between flushes; a crash loses only messages after the last one


class RecorderNode(FlightNode):
    """Writes every topic of the package and /rosout into a bag, like ``ros2 bag record``."""

    def __init__(self):
        super().__init__(
            'recorder_node',
            bag=parameter(doc='folder to create for the bag'),
            meta=parameter('{}', doc='metadata of the flight, as JSON'),
            controllers=parameter(registry.STANDING_BY,
                                  doc='registered controllers whose commands are recorded'),
            components=parameter((), doc='components whose topics are recorded: FILE.py:Class'))
        for reference in self.parameters.components:
            component_class(reference)      # its module registers its topics
        topics = topics_with(self.parameters.controllers)
        try:
            meta = dict(json.loads(self.parameters.meta))
        except (TypeError, ValueError):
            raise ParameterError("key 'meta': expected a JSON object") from None
        self._bag = BagWriter(self.parameters.bag, meta, namespace=self.get_namespace(),
                              topics=tuple(topics), frames=True)
        self._written = self._lost = self._writes = 0
        self._failure = None
        self._received = []     # (topic, type, CDR, time of receipt [s]) not yet written
        prefix = self.get_namespace().rstrip('/') + '/'
        for name, topic in topics.items():
            wire.subscribe_raw(self, name, partial(self._keep, prefix + name, topic.type),
                               LATCHED_LOG if topic.qos.latched else LOG, self._on_lost)
        self.create_subscription(wire.message_class(LINE), '/rosout', partial(
            self._keep, '/rosout', LINE), wire.profile(LATCHED_LOG), raw=True)
        component = Component('recorder_node')
        component.report('bag', self._bag_status)
        component.every(WRITE_PERIOD, self._write, steady=True)
        self.run(component)

    def _keep(self, topic, message_type, data, *_):
        if not self._failure:       # nothing would empty the list any more
            self._received.append((topic, message_type, data, self.now()))

    def _write(self):
        # Before the first /clock the time is 0: a bag that begins in 1970 cannot be viewed.
        if self._failure or not self._bag or not self.now():
            return
        received, self._received = self._received, []
        try:
            for topic, message_type, data, t in received:
                self._bag.write_raw(topic, message_type, data, t or self.now())
            self._written += len(received)
            self._writes += 1
            if self._writes % FLUSH_WRITES == 0:
                self._bag.flush()
        except RunError as error:
            # A full disk ends the recording but not the process, which is shared with other nodes.
            self._failure = str(error)
            self.get_logger().error(f'recording ended: {error}')

    def _on_lost(self, event):
        new = event.total_count_change
        self._lost += new if new < 2**31 - 1 else 1     # so Fast DDS reports an unknown number
        self.warn('lost', f'{self._lost} messages lost so far')

    def _bag_status(self):
        values = {'written': self._written, 'lost': self._lost}
        if self._failure:
            return ERROR, self._failure, values
        return WARN if self._lost else OK, self.parameters.bag, values

    def close(self):
        """Finish the bag; a second call does nothing."""
        try:
            if self._bag:
                self._write()
                self._bag.close()
        except RunError as error:
            print(f'recorder_node: error: {error}', file=sys.stderr)
        self._bag = None


def viewer_node() -> FlightNode:
    """Make that of description and frames for RViz and Foxglove, like those of a bag."""
    node = FlightNode('viewer_node')
    outputs = {     # tf2_msgs is not on PyPI
        name: node.create_publisher(wire.message_class(kind), name, wire.profile(qos))
        for name, (kind, qos) in FRAMES.items()}
    frames = FrameWriter(lambda topic, kind, data, t: outputs[topic].publish(bytes(data)), '')
    for topic in ('odom', 'joint_states'):
        wire.subscribe_raw(node, topic, lambda data, topic=topic: frames.take(
            topic, data, node.now()), SENSOR)
    return node.run(Component('viewer_node'))
