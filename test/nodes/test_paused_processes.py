"""Processes that are not scheduled for a while: only true faults are reported."""

import signal
import time

import pytest
from witness import running_graph

from beetle_omni_ros.nodes.graph import COMPOSED, plan

pytestmark = pytest.mark.real_time
PAUSE = 0.5     # [s]
SOFT = 0.6      # [m/s] of a touchdown; a fall by 0.1 m is faster


def test_a_pause_of_the_computer_in_flight_is_not_reported_as_a_crash(ros_domain,
                                                                      tmp_path):
    nodes, _ = plan('nmpc', task='hover', actuators='direct', standby=False)
    with running_graph(nodes, tmp_path, ros_domain) as (graph, witness):
        witness.can_judge(graph)
        witness.take_off(lambda: witness.state.startswith('flying'))
        witness.spin(2.0)
        witness.states.clear()
        process = graph.processes[COMPOSED]
        process.send_signal(signal.SIGSTOP)
        time.sleep(PAUSE)
        process.send_signal(signal.SIGCONT)
        witness.spin(6.0)
        robot = witness.values('sim_node: robot')
        impact = float(robot.get('impact_m_s', 0.0))
        assert not any('crash' in state for state in witness.states), (witness.states, robot)
        assert robot['broken'] == '0' and impact < SOFT
        assert witness.state.startswith('flying') or witness.state == 'disarmed'
