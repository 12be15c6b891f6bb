"""Configurations of RViz, Foxglove, PlotJuggler and the aggregator name what the package has."""

import json
import re
import xml.etree.ElementTree as ElementTree

import pytest
from rosbags.interfaces import Nodetype
import yaml

from beetle_omni_ros.messages.bag_types import TYPESTORE
from beetle_omni_ros.messages.topics import ALL
from beetle_omni_ros.nodes import plan
from beetle_omni_ros.robot.parameters import JOINT_NAMES, ROTOR_NAMES
from beetle_omni_ros.robot.resources import share_path

VIEWERS = share_path('viewers')
# What viewer_node adds to the topics of a flight.
SHOWN = {'markers': 'visualization_msgs/msg/MarkerArray',
         'robot_description': 'std_msgs/msg/String'}
TYPES = {**{name: topic.type for name, topic in ALL.items()}, **SHOWN}
JOINT_STATE = 'sensor_msgs/msg/JointState'


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


def test_each_path_of_the_foxglove_layout_leads_to_a_value():
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
    assert panels['3D!robot']['layers']['robot']['topic'] == '/robot_description'


def test_every_panel_of_the_foxglove_layout_is_placed_once():
    layout = json.loads((VIEWERS / 'foxglove.json').read_text())

    def leaves(part):
        if isinstance(part, str):
            return [part]
        return leaves(part['first']) + leaves(part['second'])

    placed = leaves(layout['layout'])
    for tab in layout['configById']['Tab!plots']['tabs']:
        placed += leaves(tab['layout'])
    assert sorted(placed) == sorted(layout['configById'])


def test_each_curve_of_the_plotjuggler_layout_leads_to_a_value():
    curves = [curve.get('name') for curve in
              ElementTree.parse(VIEWERS / 'plotjuggler.xml').getroot().iter('curve')]
    assert len(curves) > 30
    for curve in curves:
        topic, fields = split(curve)
        if TYPES[topic] == JOINT_STATE:     # shown by the names in the message
            name, field = fields.split('/')
            assert name in (JOINT_NAMES if field == 'position' else ROTOR_NAMES)
        else:
            walk(TYPES[topic], fields.split('/'))


def test_rviz_shows_topics_of_the_graph_with_a_quality_of_service_that_matches():
    content = yaml.safe_load((VIEWERS / 'beetle_omni.rviz').read_text())
    displays = content['Visualization Manager']['Displays']
    expected = {'rviz_default_plugins/Pose': 'geometry_msgs/msg/PoseStamped',
                'rviz_default_plugins/Odometry': 'nav_msgs/msg/Odometry',
                'rviz_default_plugins/MarkerArray': SHOWN['markers'],
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


@pytest.mark.parametrize('node', [name for name in plan.NODES if name != plan.GENERIC])
def test_the_aggregator_has_a_group_for_each_node(node):
    content = yaml.safe_load((VIEWERS / 'diagnostic_aggregator.yaml').read_text())
    groups = [group for group in content['analyzers']['ros__parameters'].values()
              if isinstance(group, dict)]
    found = [group for group in groups
             if any(node.startswith(prefix) for prefix in group['startswith'])]
    assert len(found) == 1, node
