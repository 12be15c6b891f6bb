"""The campaign: repeatable flights, correct counts, tables that match the list."""

from dataclasses import asdict, replace
import io
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.flight import campaign
from beetle_omni_ros.flight import faults as command
from beetle_omni_ros.flight.fault_flights import (
    FaultFlight,
    fly_case,
    HEALTHY,
    LANDING,
    LANDING_BLIND,
    PLAN,
    Watcher,
)
from beetle_omni_ros.sim.faults import load_cases
from beetle_omni_ros.sim.sensors import Impact, Truth

TICK = 0.005
QUICK = replace(PLAN, hover_time=0.5, watch_time=1.0, jitter=0.2, height=1.1, end_time=0.3,
                turn_time=0.05, landing_time=10.0, healthy_time=1.0, pose_time=1.0)
CASES = load_cases() | {case.name: case for case in (HEALTHY, LANDING, LANDING_BLIND)}


def flown(case, start='hover', plan=QUICK, bags=None, **options):
    return fly_case(FaultFlight(case, start, **options), CASES[case], bags, plan)


def test_a_trial_is_deterministic_and_its_bag_is_read_back(tmp_path):
    case = 'commands_lost_for_a_moment'
    first, again = flown(case, bags=tmp_path), flown(case)
    assert {**first, 'bag': ''} == again == json.loads(json.dumps(again))
    assert len(read_bag(tmp_path / first['bag']).truth.t)
    assert first['outcome'] == 'flies_on' and first['good'] and not first['error']
    assert 0.1 < first['impact_m_s'] < 1.0


def test_lost_commands_end_in_a_crash_and_an_error_is_reported():
    crashed = flown('commands_lost')
    assert crashed['broken'] and crashed['impact_m_s'] > 2
    assert crashed['overrun_s'] == 0.0
    failed = flown('gust', controller='none')
    assert failed['outcome'] == 'error' and not failed['good'] and 'none' in failed['error']


def test_a_landing_and_a_healthy_flight():
    landed = flown('landing', '')
    assert landed['good'] and landed == json.loads(json.dumps(landed)), landed
    healthy = flown('healthy', '', conditions='effects')
    assert healthy['state'] == 'disarmed' and healthy['alarms'] == [] and healthy['good']


def test_the_robot_lands_with_a_stopped_rotor_on_the_move():
    landed = flown('rotor_1_stops', 'moving', replace(PLAN, jitter=0.2, watch_time=3.0))
    assert landed['good'] and landed['state'] == 'disarmed' and not landed['broken'], landed


def test_the_ground_is_detected_although_the_accelerometer_jitters_on_it():
    # Without motion capture the velocity drifts; once this robot stood with idle rotors for 6 s,
    # took off again and fell.
    landed = flown('landing_without_mocap', '', PLAN, seed=3103, conditions='published')
    assert landed['state'] == 'disarmed' and landed['takeoffs'] == 0
    # The drift decides the speed of this touchdown, but the robot must not fall again.
    assert landed['impact_m_s'] < PLAN.impact_speed and not landed['broken'], landed


def result(case, **values):
    return {**asdict(FaultFlight(case)), 'expected': 'lands', 'outcome': 'lands', 'good': True,
            'impact_m_s': 0.3, 'bag': '', 'error': '', **values}


def results_of(flights):
    return {'flights': flights, 'summary': command.summary(flights, CASES), 'meta': {
        'command': 'beetle_omni faults', 'date': '2026-11-25', 'version': '0.1.0',
        'commit': 'abcdef0123'}}


def test_summary_counts_add_up():
    flights = [result('gust'), result('gust', outcome='flyaway', good=False, flyaway=True,
                                    impact_m_s=None),
             result('impact', named='push', named_s=0.2, impact_m_s=0.5, takeoffs=1),
             result('impact', outcome='error', error='x', good=False),
             *(result('healthy', start='', outcome='flies_on', flown_s=1800.0, good=False,
                      alarms=[[1.0, 'error', 'y']]) for _ in range(2)),
             result('landing_without_mocap', start='', inclination_deg=4.0)]
    totals = command.summary(flights, CASES)
    assert totals['faults']['gust']['outcomes'] == {'lands': 1, 'flyaway': 1}
    assert totals['faults']['gust']['impact_worst_m_s'] == 0.3
    assert totals['faults']['impact']['named_s'] == 0.2
    healthy = totals['faults']['healthy, nominal']
    assert (healthy['hours'], healthy['alarms'], healthy['good']) == (1.0, {'y': 2}, 0)
    assert totals['faults']['landing_without_mocap, nominal']['inclination_worst_deg'] == 4.0
    assert totals['total'] == {'flights': 7, 'good': 3, 'flyaways': 1, 'takeoffs': 1,
                               'motors_on_after_crash': 0, 'errors': 1}


def test_the_page_explains_its_outcomes_and_shows_each_flight():
    flights = [result('rotor_1_stops', start=start, bag=f'bag_of_{start}')
               for start in ('hover', 'moving')]
    flights.append(result('gust', seed=4, outcome='crash, motors on', good=False,
                          impact_m_s=None, error='<b>'))
    html = command.as_page(results_of(flights), Path('runs_out/faults'))
    for text in ('commit abcdef0123', '2 of 3 as expected', 'below 1 m/s and 30 deg', '&lt;b&gt;',
                 'bag_of_moving',
                 'beetle_omni report runs_out/faults/bags/BAG'):
        assert text in html, text
    assert all(f'<li>{name}: ' in html for name in command.OUTCOMES) and 'http' not in html


def test_the_command_writes_its_files_and_a_campaign_continues(tmp_path, monkeypatch):
    flights = []

    def fly(function, calls, *rest):
        flights.append([(call[0].case, call[0].seed) for call in calls])
        yield from ((k, result(call[0].case, seed=call[0].seed)) for k, call in enumerate(calls))

    monkeypatch.setattr(campaign, '_fly_all', fly)
    console = Console(file=io.StringIO())

    def run(seeds, **options):
        return command.run_faults(**{'only': ['gust', 'impact'], **options}, starts=['hover'],
                                  seeds=seeds, seed=7, output=tmp_path, console=console)

    run(1)
    both = run(2)
    assert flights == [[('gust', 7), ('impact', 7)], [('gust', 8), ('impact', 8)]]
    assert [(one['case'], one['seed']) for one in both['flights']] == [
        ('gust', 7), ('gust', 8), ('impact', 7), ('impact', 8)]
    assert both['summary'] == run(2)['summary'] and flights[-1] == []
    run(1, bags=True)
    run(1, plant='measured')
    assert [len(one) for one in flights[-2:]] == [2, 2]
    assert json.loads((tmp_path / 'faults.json').read_text())['summary']['total']['good'] == 2
    assert '| gust |' in (tmp_path / 'faults.md').read_text()
    assert f"files: {tmp_path / 'faults.html'}\n" in console.file.getvalue()


# --- outcome of a flight from the truth ----------------------------------------------------------

def truth(t, height=1.0, x=0.0, contact=False, impact=None, broken=False):
    return Truth(t, np.array([x, 0.0, height]), np.zeros(3), np.array([0, 0, 0, 1.0]), np.zeros(3),
                 np.zeros(4), np.zeros(4), np.zeros(4), contact, impact, broken)


@pytest.fixture
def watch():
    return Watcher(SimpleNamespace(
        simulator=SimpleNamespace(truth=truth(0.0, 0.0), time=0.0), refusals=[], events=[],
        supervisor=SimpleNamespace(faults={}, state='disarmed')), PLAN)


def soft(t=1.0, speed=0.3, inclination=0.05):
    return Impact(t, speed, inclination)


def judged(watch, asked=True, state='disarmed', refusals=()):
    watch._loop.supervisor.state, watch._loop.refusals = state, refusals
    return watch.outcome(asked)


def test_a_soft_landing_counts_as_flies_on_lands_or_refused(watch):
    watch.step(truth(1.0, 0.15, contact=True, impact=soft()), 0.0, TICK)
    assert judged(watch) == 'flies_on'
    assert judged(watch, asked=False) == 'lands'
    assert judged(watch, refusals=['far']) == 'refused'
    assert judged(watch, state='flying') == 'does not land'


def test_a_hard_or_tilted_touchdown_is_not_a_landing(watch):
    watch.step(truth(1.0, impact=soft(inclination=1.1 * PLAN.inclination)), 0.0, TICK)
    assert judged(watch) == 'tilted'
    watch.step(truth(2.0, impact=soft(2.0, speed=1.1 * PLAN.impact_speed)), 0.0, TICK)
    assert judged(watch) == 'hard'


@pytest.mark.parametrize(('late', 'outcome'), [(0.2, 'stops'), (0.5, 'crash, motors on')])
def test_motors_must_stop_soon_after_a_crash(watch, late, outcome):
    for k in range(300):
        t = k * TICK
        watch.step(truth(t, 0.1, contact=True, impact=soft(0.1, 3.0), broken=t >= 0.1),
                   20.0 if t <= 0.1 + late else 0.0, TICK)
    assert judged(watch) == outcome
    assert np.isclose(watch.overrun, late, atol=2 * TICK)
    assert judged(watch, state='flying') == 'crash, motors on'


def test_a_flyaway_is_a_position_far_outside(watch):
    fence = watch._fence[0] + PLAN.fence_margin
    watch.step(truth(1.0, x=fence - 0.1), 20.0, TICK)
    assert judged(watch) != 'flyaway'
    watch.step(truth(1.0, x=fence + 0.1), 20.0, TICK)
    assert judged(watch) == 'flyaway'


def test_rising_after_rest_is_a_takeoff_and_bouncing_is_not(watch):
    for k in range(200):
        watch.step(truth(k * TICK, 0.15, contact=k % 40 > 0), 0.0, TICK)
    watch.step(truth(1.1, 1.0), 20.0, TICK)
    assert watch.takeoffs == 0
    for k in range(200):
        watch.step(truth(2 + k * TICK, 0.15, contact=True), 0.0, TICK)
    for height in (0.3, 0.7, 1.0):
        watch.step(truth(4.0, height), 20.0, TICK)
    assert watch.takeoffs == 1
    assert judged(watch) == 'takes off'
