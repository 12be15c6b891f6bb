"""Components of others in the loop and as nodes."""

from pathlib import Path

import numpy as np
import pytest

from beetle_omni_ros.bags.log import Recorder
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.flight.component import component_class, made, node_name
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

OBSERVER = f"{Path(__file__).parents[2] / 'examples' / 'own_component.py'}:WrenchObserver"
ROBOT = RobotParameters.load()


class Forces(Recorder):
    """Keeps the observed forces."""

    def __init__(self):
        super().__init__()
        self.values = []

    def write(self, topic, value, received=None):
        if topic == 'observer/force':
            self.values.append(value.force)


def test_an_observer_of_others_estimates_an_external_force_in_the_loop():
    forces = Forces()
    loop = FlightLoop(ROBOT, ROBOT, {'hover': HoverController(ROBOT)}, forces,
                      others=made([OBSERVER], ROBOT))
    loop.take_off()
    loop.aim(PoseTarget(np.array([0.0, 0.0, 1.0]), np.array([0, 0, 0, 1.0]), loop.now()))
    loop.simulator.wrench = np.array([3.0, -2.0, 4.0, 0, 0, 0])
    loop.run(2.0)
    assert np.allclose(np.mean(forces.values[-200:], axis=0), [3.0, -2.0, 4.0], atol=0.5)


def test_a_class_that_is_no_component_is_refused(tmp_path):
    file = tmp_path / 'own.py'
    file.write_text('class Own:\n    pass\n')
    with pytest.raises(ParameterError, match='no subclass of Component'):
        component_class(f'{file}:Own')
    assert node_name(component_class(OBSERVER)) == 'wrench_observer_node'


def test_the_graph_runs_it_as_a_node_of_its_own():
    graph = pytest.importorskip('beetle_omni_ros.ros.graph')
    nodes, _ = graph.plan('hover', actuators='direct', components=[OBSERVER])
    assert nodes['wrench_observer_node'] == {'component': OBSERVER}
