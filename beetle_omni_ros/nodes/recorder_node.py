"""ROS node that records a flight into a bag, like ``ros2 bag record -s mcap``."""

from dataclasses import dataclass
import sys

from rclpy.event_handler import SubscriptionEventCallbacks

from beetle_omni_ros.control import registry
from beetle_omni_ros.messages.topics import ALL, LATCHED_LOG, LOG, topics_with
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.node import ERROR, FlightNode, OK, WARN
from beetle_omni_ros.robot.schema import NAMES, parameter, ParameterError
from beetle_omni_ros.robot.urdf import description
from beetle_omni_ros.runs.bag import BagError
from beetle_omni_ros.runs.bag_writer import BagWriter, COMPRESSIONS

FLUSH_PERIOD = 0.4      # s; a crash loses only messages after the last flush
HELD = 1000             # messages at most that wait for the first simulated time
TARGETS = 'target_pose', 'target_trajectory'    # with any quality of service


@dataclass(frozen=True, kw_only=True)
class RecorderNodeParameters:
    """Parameters of recorder_node."""

    bag: str = parameter(doc='folder to create for the bag', read_only=True)
    controllers: NAMES = parameter(
        tuple(registry.standing_by()), read_only=True,
        doc='registered controllers whose commands are recorded')
    urdf_file: str = parameter('', doc='robot description for the recorded frames; empty: the '
                                       'shipped one', read_only=True)
    compression: str = parameter('none', choices=COMPRESSIONS, read_only=True,
                                 doc='compression of the chunks in the MCAP file')


class RecorderNode(FlightNode):
    """Writes the messages of every topic of the package into a bag."""

    real_time = True        # the times of receipt in the bag are measurements

    def __init__(self):
        super().__init__('recorder_node', RecorderNodeParameters)
        topics = topics_with(self.parameters.controllers)
        try:
            self._bag = BagWriter(self.parameters.bag, namespace=self.get_namespace(),
                                  topics=tuple(topics),
                                  compression=self.parameters.compression,
                                  description=description(self.parameters.urdf_file))
        except BagError as error:
            raise ParameterError(f"key 'bag': {error}") from None
        self._written = self._lost = 0
        self._failure = None
        self._held = []     # (topic, type, CDR) from before the first simulated time
        prefix = self.get_namespace().rstrip('/') + '/'
        for name, topic in {**ALL, **topics}.items():
            kind, write = wire.message_class(topic.type), self._writer(prefix + name, topic.type)
            if name in TARGETS:
                wire.AnyQosSubscription(self, kind, name, write, depth=50, raw=True,
                                        on_lost=self._on_lost)
                continue
            profile = wire.profile(LATCHED_LOG if topic.qos.latched else LOG)
            self.create_subscription(
                kind, name, write, profile, raw=True,
                event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_lost))
        self.health.report('bag', self._bag_status)
        self.create_timer(FLUSH_PERIOD, self._flush, clock=self.steady_clock)

    def _writer(self, topic, message_type):
        def write(data, _=None):
            self._held.append((topic, message_type, data))
            # Before the first /clock the time is 0: a bag that begins in 1970 cannot be viewed.
            if len(self._held) > HELD or self.now():
                self._write_held()
        return write

    def _write_held(self):
        held, self._held = self._held, []
        try:
            for message in held:
                if self._failure:
                    return
                self._bag.write_raw(*message, self.now())
                self._written += 1
        except BagError as error:
            self._give_up(error)

    def waits_for(self):
        """Return what is recorded where; a recorder needs no particular input."""
        return f'messages, and writes them to {self.parameters.bag}'

    def _on_lost(self, event):
        self._lost += event.total_count_change
        self.get_logger().warning(f'{event.total_count_change} messages lost')

    def _flush(self):
        try:
            if not self._failure:
                self._bag.flush()
        except BagError as error:
            self._give_up(error)

    def _give_up(self, error):
        # A full disk ends the recording but not the process, which is shared with other nodes.
        if self._failure is None:
            self._failure = str(error)
            self.get_logger().error(f'recording ended: {error}')

    def _bag_status(self):
        values = {'written': self._written, 'lost': self._lost}
        if self._failure:
            return ERROR, self._failure, values
        return WARN if self._lost else OK, self.parameters.bag, values

    def close(self):
        """Finish the bag."""
        bag = getattr(self, '_bag', None)
        try:
            if bag:
                self._write_held()
                bag.close()
        except BagError as error:
            print(f'recorder_node: error: {error}', file=sys.stderr)
