"""Configurations of RViz and Foxglove name what the package has."""

import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import pytest
from rosbags.interfaces import Nodetype
from synthetic_flights import fly
import yaml

from beetle_omni_ros.bags.bag import read_bag, read_messages
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.bags.messages import from_bytes, TYPESTORE
from beetle_omni_ros.bags.topics import ALL
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.model.urdf import description
from beetle_omni_ros.show import rerun_view as view

VIEWERS = share_path('viewers')
SHOWN = {'robot_description': 'std_msgs/msg/String'}       # beside the topics of a flight
TYPES = {**{name: topic.type for name, topic in ALL.items()}, **SHOWN}


def split(path):
    """Topic and the rest of a path that begins with a topic."""
    topics = [name for name in TYPES if path.startswith('/' + name) and
              path[len(name) + 1:len(name) + 2] in ('', '.', '/')]
    assert topics, f'{path}: no such topic'
    topic = max(topics, key=len)
    return topic, path[len(topic) + 2:]


def walk(kind, fields):
    """Follow fields through message types; the last must be a number or a text."""
    for name in fields:
        definitions = dict(TYPESTORE.fielddefs[kind][1])
        assert name in definitions, f'{kind} has no {name}'
        node, what = definitions[name]
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            node, what = what[0]
        kind = what if node == Nodetype.NAME else what[0]
    assert kind in ('float32', 'float64', 'string', 'uint8'), kind


def test_each_path_of_the_foxglove_layout_has_a_value():
    layout = json.loads((VIEWERS / 'foxglove.json').read_text())
    panels = layout['configById']
    paths = [path['value'] for panel in panels.values() for path in panel.get('paths', ())]
    assert len(paths) > 30
    for path in paths:
        topic, fields = split(path)
        walk(TYPES[topic], [re.sub(r'\[\d+\]$', '', field) for field in fields.split('.')])
        index = re.search(r'\[(\d+)\]', fields)
        if index:
            assert int(index[1]) < (8 if topic == 'command' else 4)
    for topic in panels['3D!robot']['topics']:
        assert topic.lstrip('/') in TYPES
    assert panels['3D!robot']['topics']['/robot_description']['visible']


def test_each_plot_and_state_of_the_rerun_layout_is_a_topic():
    for path in [*sum(view.PLOTS.values(), []), *view.STATES.values()]:
        topic, field = split('/' + path)
        assert TYPES[topic] == 'sensor_msgs/msg/JointState' if field else topic == path
        if field:
            walk(TYPES[topic], [field])


def test_rerun_shows_the_robot_the_targets_and_the_errors_of_a_bag(tmp_path):
    rerun = pytest.importorskip('rerun', reason='the extra rerun is not installed')
    with BagWriter(tmp_path / 'bag', frames=True) as writer:
        fly(writer, make_task('waypoints'), duration=12.0)
    recording = rerun.RecordingStream(view.APPLICATION)
    recording.save(tmp_path / 'bag.rrd', default_blueprint=view.blueprint())
    with view.meshes():
        view.send(read_bag(tmp_path / 'bag'), recording)
        recording.disconnect()
    shown = subprocess.run([sys.executable, '-m', 'rerun', 'rrd', 'print', '-v',
                            str(tmp_path / 'bag.rrd')], capture_output=True, text=True).stdout
    for entity, component in (
            ('error/position', 'Scalars'), ('target', 'Transform3D'), ('tf', 'Transform3D'),
            ('command/effort', 'Scalars'), ('supervisor/state', 'TextDocument'),
            ('beetle_omni/visual_geometries/main_body/visual_0', 'Asset3D'),
            ('ground_truth/odom', 'nav_msgs.msg.Odometry')):
        assert f'/{entity}@{component}' in shown, entity


def test_without_rerun_the_view_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, 'rerun', None)
    with pytest.raises(ParameterError, match="--rerun: .*pip install 'rerun-sdk>="):
        view.run_rerun([])


def test_rviz_shows_topics_of_the_graph_with_a_quality_of_service_that_matches():
    content = yaml.safe_load((VIEWERS / 'beetle_omni.rviz').read_text())
    displays = content['Visualization Manager']['Displays']
    expected = {'rviz_default_plugins/Pose': 'geometry_msgs/msg/PoseStamped',
                'rviz_default_plugins/Odometry': 'nav_msgs/msg/Odometry',
                'rviz_default_plugins/RobotModel': SHOWN['robot_description']}
    seen = set()
    for display in displays:
        given = display.get('Topic') or display.get('Description Topic')
        if given is None:
            continue
        name = given['Value'].lstrip('/')
        assert TYPES[name] == expected[display['Class']]
        latched = given['Durability Policy'] == 'Transient Local'
        assert not latched or name in SHOWN or ALL[name].qos.latched
        reliable = given['Reliability Policy'] == 'Reliable'
        assert not reliable or name in SHOWN or ALL[name].qos.reliable
        seen.add(display['Class'])
    assert seen == set(expected)


def test_a_bag_has_encodings_of_all_viewers_and_frames_of_all_layouts(tmp_path):
    with BagWriter(tmp_path / 'bag', frames=True) as writer:
        fly(writer, make_task('waypoints'), duration=2.0)
    file, = (tmp_path / 'bag').glob('*.mcap')
    with open(file, 'rb') as source:
        for schema, channel, *_ in make_reader(source, decoder_factories=[
                DecoderFactory()]).iter_decoded_messages():
            assert (channel.message_encoding, schema.encoding) == ('cdr', 'ros2msg')
    parents = {}
    for message in read_messages(tmp_path / 'bag'):
        if message.topic in ('/tf', '/tf_static'):
            for transform in from_bytes(message.data, message.type).transforms:
                parents[transform.child_frame_id] = transform.header.frame_id
    rviz = yaml.safe_load((VIEWERS / 'beetle_omni.rviz').read_text())['Visualization Manager']
    layout = json.loads((VIEWERS / 'foxglove.json').read_text())['configById']
    frames = {*parents, *parents.values()}
    assert {rviz['Global Options']['Fixed Frame'], rviz['Views']['Current']['Target Frame'],
            layout['3D!robot']['followTf'],
            *(layer['frameId'] for layer in layout['3D!robot']['layers'].values()
              if 'frameId' in layer)} <= frames
    links = {link.get('name') for link in ElementTree.fromstring(description()).findall('link')}
    assert links <= frames
    for link in links:      # each has world as its root
        while link != 'world':
            link = parents[link]
