"""The campaign: repeatable flights, correct counts, tables that match the list."""

from dataclasses import asdict, replace
import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from beetle_omni_ros.evaluation import campaign
from beetle_omni_ros.faults import command, page
from beetle_omni_ros.faults.flight import fly_trial, HEALTHY, LANDING, LANDING_BLIND, Trial


@pytest.fixture(scope='module')
def quick(listed):
    """The shipped list with short flights."""
    plan = replace(listed.flight, hover_time=0.5, watch_time=1.0, jitter=0.2, height=1.1,
                   end_time=0.3, turn_time=0.05, landing_time=10.0)
    return replace(listed, flight=plan, healthy=replace(
        listed.healthy, flight_time=1.0, pose_time=1.0, effects={'wind': {'force': [1.0, 0, 0]}}))


def test_a_trial_is_deterministic_and_its_bag_is_read_back(quick, tmp_path):
    trial = Trial('commands_lost_for_a_moment')
    first, again = fly_trial(trial, quick, tmp_path), fly_trial(trial, quick)
    assert first['bag_lost'] is False and again['bag_lost'] is None
    assert {**first, 'bag_lost': None} == again == json.loads(json.dumps(again))
    assert first['outcome'] == 'flies_on' and first['good'] and not first['error']
    assert 0.1 < first['impact_m_s'] < 1.0


def test_lost_commands_end_in_a_crash_and_an_error_is_reported(quick):
    flown = fly_trial(Trial('commands_lost'), quick)
    assert flown['broken'] and flown['impact_m_s'] > 2
    assert flown['overrun_s'] == 0.0
    flown = fly_trial(Trial('gust', controller='none'), quick)
    assert flown['outcome'] == 'error' and not flown['good'] and 'none' in flown['error']


def test_a_landing_and_a_healthy_flight(quick):
    landed = fly_trial(Trial(LANDING), quick)
    assert landed['good'] and landed == json.loads(json.dumps(landed)), landed
    flown = fly_trial(Trial(HEALTHY, conditions='effects'), quick)
    assert flown['state'] == 'disarmed' and flown['alarms'] == [] and flown['good']


@pytest.mark.parametrize(('case', 'start'), [
    ('estimator_dead', 'hover'), ('mocap_lost', 'upside_down'), ('joints_lost', 'hover'),
    ('rotor_1_stops', 'moving'), ('servo_jammed', 'hover')])
def test_the_robot_lands_in_spite_of_a_fault(listed, case, start):
    plan = replace(listed.flight, hover_time=1.0, turn_time=4.5, jitter=0.2, watch_time=3.0)
    landed = fly_trial(Trial(case, start), replace(listed, flight=plan))
    assert landed['good'] and landed['state'] == 'disarmed' and not landed['broken'], landed


def test_the_ground_is_detected_although_the_accelerometer_jitters_on_it(listed):
    # Without motion capture the velocity drifts; once this robot stood with idle rotors for 6 s,
    # took off again and fell.
    landed = fly_trial(Trial(LANDING_BLIND, '', 3103, 'published'), listed)
    assert landed['state'] == 'disarmed' and landed['takeoffs'] == 0
    # The drift decides the speed of this touchdown, but the robot must not fall again.
    assert landed['impact_m_s'] < listed.limits.impact_speed and not landed['broken'], landed


def result(case, **values):
    return {**asdict(Trial(case)), 'expected': 'lands', 'outcome': 'lands', 'good': True,
            'impact_m_s': 0.3, 'bag_lost': None, 'error': '', **values}


def results_of(flights, listed):
    return {'flights': flights, 'summary': page.summary(flights, listed), 'meta': {
        'command': 'beetle_omni faults', 'date': '2026-11-25', 'version': '0.1.0',
        'commit': 'abcdef0123', 'limits': asdict(listed.limits)}}


def test_summary_counts_add_up(listed):
    flown = [result('gust'), result('gust', outcome='flyaway', good=False, flyaway=True,
                                    impact_m_s=None),
             result('impact', named='push', named_s=0.2, impact_m_s=0.5, takeoffs=1),
             result('impact', outcome='error', error='x', good=False, bag_lost=True),
             *(result(HEALTHY, outcome='flies_on', flown_s=1800.0, good=False,
                      alarms=[[1.0, 'error', 'y']]) for _ in range(2)),
             result(LANDING_BLIND, inclination_deg=4.0)]
    totals = page.summary(flown, listed)
    assert totals['faults']['gust']['outcomes'] == {'lands': 1, 'flyaway': 1}
    assert totals['faults']['gust']['impact_worst_m_s'] == 0.3
    assert totals['faults']['impact']['named_s'] == 0.2
    healthy = totals['faults']['healthy, nominal']
    assert (healthy['hours'], healthy['alarms'], healthy['good']) == (1.0, {'y': 2}, 0)
    assert totals['faults']['landing_without_mocap, nominal']['inclination_worst_deg'] == 4.0
    assert totals['total'] == {'flights': 7, 'good': 3, 'flyaways': 1, 'takeoffs': 1,
                               'motors_on_after_crash': 0, 'errors': 1, 'lost_bags': 1}
    assert '1 lost bags' in page.total_text({'summary': totals})
    assert 'bag' not in page.total_text(results_of(flown[:1], listed))


def test_the_page_explains_its_outcomes_and_shows_each_flight(listed):
    flights = [result('rotor_1_stops', start=start, bag_lost=False)
               for start in ('hover', 'moving')]
    flights.append(result('gust', seed=4, outcome='crash, motors on', good=False, bag_lost=True,
                          impact_m_s=None, error='<b>'))
    html = page.as_page(results_of(flights, listed), Path('runs_out/faults'))
    for text in ('commit abcdef0123', '2 of 3 as expected', 'below 1 m/s and 30 deg', '&lt;b&gt;',
                 '<summary>3 flights</summary>', 'rotor_1_stops_moving_nominal_nmpc_0',
                 '<td>lost</td>', 'beetle_omni report runs_out/faults/bags/BAG'):
        assert text in html, text
    assert all(f'<dt>{name}</dt>' in html for name in page.OUTCOMES) and 'http' not in html


def test_the_command_writes_its_files_and_a_campaign_continues(listed, tmp_path, monkeypatch):
    flown = []

    def fly(function, calls, *rest):
        flown.append([(call[0].case, call[0].seed) for call in calls])
        yield from ((k, result(call[0].case, seed=call[0].seed))
                    for k, call in enumerate(calls))

    monkeypatch.setattr(campaign, '_fly_all', fly)
    console = Console(file=io.StringIO())

    def run(seeds, **options):
        return command.run_faults(**{'only': ['gust', 'impact'], **options}, starts=['hover'],
                                  seeds=seeds, seed=7, output=tmp_path, console=console)

    run(1)
    both = run(2)
    assert flown == [[('gust', 7), ('impact', 7)], [('gust', 8), ('impact', 8)]]
    assert [(one['case'], one['seed']) for one in both['flights']] == [
        ('gust', 7), ('gust', 8), ('impact', 7), ('impact', 8)]
    assert both['summary'] == run(2)['summary'] and flown[-1] == []
    assert '--seeds 2 --seed 7 ' in both['meta']['command']
    run(1, bags=True)
    run(1, plant='measured')
    assert [len(one) for one in flown[-2:]] == [2, 2]
    assert json.loads((tmp_path / 'faults.json').read_text())['summary']['total']['good'] == 2
    assert '| gust |' in (tmp_path / 'faults.md').read_text()
    assert f"page: {tmp_path / 'faults.html'}\n" in console.file.getvalue()
