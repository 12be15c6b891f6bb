"""Faults of processes: outcomes of a flight through ROS, and one real flight."""

import time
from types import SimpleNamespace

import pytest

from beetle_omni_ros.faults.watch import BETTER
from beetle_omni_ros.nodes import process_faults
from beetle_omni_ros.nodes.process_faults import Observer
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.sim.faults.listed import FaultList

LIMITS = FaultList.load().limits


def seen(robot, *, touched=5.0, on=4.9, takeoffs=0, states=('landing:rotor1_lost',)):
    """An observer with given observations; times in seconds."""
    zero = time.monotonic() - 10
    return SimpleNamespace(values=lambda _: robot, takeoffs=takeoffs, states=list(states),
                           thrust_at=zero + on,
                           touched=None if touched is None else zero + touched)


SOFT, HARD = {'broken': '0', 'impact_m_s': '0.3', 'inclination_deg': '2'}, {
    'broken': '0', 'impact_m_s': '1.4'}
BROKEN = {'broken': '1', 'impact_m_s': '4.1'}


@pytest.mark.parametrize('observer, flying, refused, outcome', [
    (seen(SOFT, on=6.0), True, False, 'flies_on'), (seen(SOFT, on=6.0), True, True, 'refused'),
    (seen(SOFT, on=6.0), False, False, 'lands'), (seen(HARD), False, False, 'hard'),
    (seen({**SOFT, 'inclination_deg': '40'}), False, False, 'tilted'),
    (seen(BROKEN, on=5.2), False, False, 'stops'),
    (seen(BROKEN, on=6.0), False, False, 'crash, motors on'),
    (seen(SOFT, touched=None), True, False, 'does not land'),
    (seen(BROKEN, takeoffs=1), False, False, 'takes off')])
def test_the_outcome_is_determined_from_truth_and_commands(observer, flying, refused, outcome):
    result = process_faults._outcome(observer, flying, refused, LIMITS)
    assert result['outcome'] == outcome and result['named'] == 'rotor1_lost'


def test_a_take_off_from_the_floor_is_counted_and_a_bounce_is_not(monkeypatch):
    observer, now = Observer.__new__(Observer), [0.0]
    monkeypatch.setattr(process_faults.time, 'monotonic', lambda: now[0])
    observer._limits, observer.states = LIMITS, []
    observer.begin()
    for now[0], height, takeoffs in (
            (0.0, 1.0, 0), (1.0, 0.2, 0), (1.2, 0.4, 0), (1.4, 0.2, 0), (1.6, 1.0, 0),
            (2.0, 0.2, 0), (2.6, 0.2, 0), (3.0, 0.9, 1)):
        observer._on_truth(SimpleNamespace(position=(0.0, 0.0, height)))
        assert observer.takeoffs == takeoffs
    assert observer.touched == 1.0


def test_the_fault_names_equal_those_of_the_docs():
    text = share_path('docs/faults.md').read_text()
    for name, fault in process_faults.FAULTS.items():
        assert fault.expected in BETTER
        assert f'| `{name}` | ' in text and f'| {fault.expected} |' in text
    with pytest.raises(ParameterError, match='through ROS: supervisor_killed'):
        process_faults.chosen(['rotor_stops'])
