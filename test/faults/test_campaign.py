"""The campaign: repeatable flights, correct counts, tables that match the list."""

from dataclasses import asdict, replace
import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from beetle_omni_ros import cli
from beetle_omni_ros.faults import page
from beetle_omni_ros.faults.campaign import healthy_summary, landing_summary, summary
from beetle_omni_ros.faults.command import run_faults
from beetle_omni_ros.faults.landings import (
    attitude,
    fly_healthy,
    fly_landing,
    HealthyTrial,
    LandingTrial,
)
from beetle_omni_ros.faults.trial import fly_to_start, fly_trial, Trial
from beetle_omni_ros.faults.watch import BETTER
from beetle_omni_ros.pages.table import print_grids

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope='module')
def quick(listed):
    """The shipped list with short flights."""
    plan = replace(listed.flight, hover_time=0.5, watch_time=1.0, jitter=0.2, height=1.1,
                   end_time=0.3, turn_time=0.5, landing_time=10.0)
    return replace(listed, flight=plan, healthy=replace(
        listed.healthy, flight_time=1.0, pose_time=1.0, effects={'wind': {'force': [1.0, 0, 0]}}))


@pytest.fixture(scope='module')
def soft(quick, tmp_path_factory):
    """Two equal flights with a harmless fault, the first with a bag."""
    bags = tmp_path_factory.mktemp('bags')
    trial = Trial('commands_lost_for_a_moment')
    return fly_trial(trial, quick, bags), fly_trial(trial, quick)


def test_a_trial_is_deterministic_and_its_bag_is_read_back(soft):
    first, again = soft
    assert first['bag_lost'] is False and again['bag_lost'] is None
    assert {**first, 'bag_lost': None} == again == json.loads(json.dumps(again))
    assert first['outcome'] == 'flies_on' and first['good'] and not first['error']
    assert 0.1 < first['impact_m_s'] < 1.0


def test_lost_commands_end_in_a_crash_outcome(quick):
    flown = fly_trial(Trial('commands_lost'), quick)
    assert flown['broken'] and flown['impact_m_s'] > 2
    assert flown['overrun_s'] == 0.0


def test_an_error_in_a_flight_is_reported_and_the_campaign_continues(quick):
    flown = fly_trial(Trial('gust', controller='none'), quick)
    assert flown['outcome'] == 'error' and not flown['good'] and 'none' in flown['error']


def test_a_landing_and_a_healthy_flight(quick):
    landed = fly_landing(LandingTrial(0), replace(quick, flight=replace(
        quick.flight, height=1.1, turn_time=0.05)))
    assert landed['good'], landed
    assert json.loads(json.dumps(landed)) == landed
    flown = fly_healthy(HealthyTrial(0, 'effects'), quick)
    assert flown['state'] == 'disarmed' and flown['alarms'] == [] and not flown['error']


def test_the_ground_is_detected_although_the_accelerometer_jitters_on_it(listed):
    # Without motion capture the velocity drifts; once this robot stood with idle rotors for 6 s,
    # took off again and fell.
    landed = fly_landing(LandingTrial(3103, 'published', without_mocap=True), listed)
    assert landed['state'] == 'disarmed' and landed['takeoffs'] == 0
    # The drift decides the speed of this touchdown, but the robot must not fall again.
    assert landed['impact_m_s'] < listed.limits.impact_speed and not landed['broken'], landed


def test_every_fourth_landing_begins_upside_down():
    drawn = np.array([attitude(seed) for seed in range(40)])
    np.testing.assert_array_equal(drawn[3::4, :2], np.tile([np.pi, 0.0], (10, 1)))
    assert np.ptp(drawn[::4], axis=0).min() > 3 and np.abs(drawn).max() <= np.pi


def result(case, **values):
    return {'case': case, 'start': 'hover', 'seed': 0, 'conditions': 'nominal',
            'controller': 'nmpc', 'expected': 'lands', 'outcome': 'lands', 'good': True,
            'impact_m_s': 0.3, 'bag_lost': None, 'error': '', 'overrun_s': 0.0,
            'flyaway': False, 'takeoffs': 0, **values}


def test_summary_counts_add_up(listed):
    flown = [result('gust'), result('gust', outcome='flyaway', good=False, flyaway=True,
                                    impact_m_s=None),
             result('impact', named='push', named_s=0.2, impact_m_s=0.5, takeoffs=1),
             result('impact', outcome='error', error='x', good=False, bag_lost=True)]
    totals = summary(flown, listed)
    assert totals['faults']['gust']['outcomes'] == {'lands': 1, 'flyaway': 1}
    assert totals['faults']['gust']['impact_worst_m_s'] == 0.3
    assert totals['faults']['impact']['named_s'] == 0.2
    assert totals['total'] == {'flights': 4, 'good': 2, 'share': 0.5, 'flyaways': 1,
                             'motors_on_after_crash': 0, 'takeoffs': 1, 'errors': 1,
                             'lost_bags': 1}


def campaign_of(flights, listed):
    """Results of a campaign with these flights."""
    return {'flights': flights, 'summary': summary(flights, listed), 'meta': {
        'command': 'beetle_omni faults', 'date': '2026-11-25', 'version': '0.1.0',
        'commit': 'abcdef0123', 'limits': asdict(listed.limits)}}


def terminal(results):
    """Tables and summary on a terminal of 80 columns."""
    console = Console(file=io.StringIO(), width=80)
    print_grids(page.terminal_grids(results), console)
    return console.file.getvalue()


def test_no_name_and_no_header_is_cut_at_80_columns(listed):
    flights = [result(name, expected=case.expected, outcome=outcome, named_s=12.34, named='x',
                      impact_m_s=12.34) for name, case in listed.cases.items()
               for outcome in ('flies_on', 'crash, motors on', 'does not land')]
    landings = [{'conditions': 'published', 'without_mocap': lost, 'good': lost,
                 'outcome': outcome, 'impact_m_s': 10.3, 'inclination_deg': 124.0}
                for lost in (True, False) for outcome in ('lands', 'crash, motors on')]
    printed = terminal({**campaign_of(flights, listed),
                        'landings': {'summary': landing_summary(landings)}})
    words = printed.split()
    assert {*listed.cases, 'expected', 'good', 'outcomes', 'impact', '[m/s]', 'named', '[s]',
            'conditions', 'MoCap', 'inclination', '[deg]', 'flies_on', '12.34'} <= {*words}
    assert '…' not in printed and max(map(len, printed.splitlines())) <= 80


def test_bags_are_counted_only_if_recorded(listed):
    without = page.total_text(campaign_of([result('gust')], listed))
    assert 'bag' not in without and '1 of 1 flights' in without
    assert '0 lost bags' in page.total_text(campaign_of([result('gust', bag_lost=False)], listed))


def test_the_page_explains_its_columns_and_outcomes_and_shows_each_flight(listed):
    said = 'rotor 1 gives less thrust than asked'
    flights = [result('rotor_1_stops', start=start, said=said, bag_lost=False)
               for start in ('hover', 'moving')]
    flights.append(result('gust', seed=4, outcome='crash, motors on', good=False, bag_lost=True,
                          impact_m_s=None))
    html = page.as_page(campaign_of(flights, listed), Path('runs_out/faults'))
    assert html.count('<h1>Faults</h1>') == 1 and '<h2>Faults</h2>' not in html
    for text in ('2026-11-25', 'version 0.1.0, commit abcdef0123', 'as expected: ',
                 'named after: ', '2 of 3 as expected'):
        assert text in html
    assert {*BETTER, 'flyaway', 'takes off', 'crash, motors on', 'hard', 'tilted',
            'does not land', 'error'} == {*page.OUTCOMES}
    assert all(f'</i>{name}</dt>' in html for name in page.OUTCOMES)
    assert 'below 1 m/s and 30 deg' in html and '0.6 m/s' in html
    each = html.split('<h2>Each flight</h2>')[1]
    assert '<summary>3 flights</summary>' in each and each.count(said) == 2
    assert 'href="bags/rotor_1_stops_moving_nominal_nmpc_0/"' in each and '<td>lost</td>' in each
    assert 'beetle_omni report runs_out/faults/bags/NAME' in each
    assert html.count('<svg') == 2 and html.count('<circle') == 2 and html.count('<rect') == 2


def test_a_long_table_of_flights_is_folded(listed):
    flights = [result(name) for name in listed.cases]
    each = page.as_page(campaign_of(flights, listed)).split('<h2>Each flight</h2>')[1]
    assert f'<details><summary>{len(flights)} flights</summary>' in each and 'bags' not in each


def test_landings_and_healthy_flights_are_summed_by_conditions():
    landings = [{'conditions': 'nominal', 'without_mocap': lost, 'good': lost, 'outcome': 'lands',
                 'impact_m_s': 0.3, 'inclination_deg': 4.0} for lost in (True, True, False)]
    assert [(row['mocap'], row['landings'], row['good']) for row in landing_summary(landings)] \
        == [(True, 1, 0), (False, 2, 2)]
    flights = [{'conditions': 'nominal', 'flown_s': 1800.0, 'alarms': [[1.0, 'error', 'x']],
                'state': 'disarmed', 'error': ''}] * 2
    assert healthy_summary(flights) == [{'conditions': 'nominal', 'flights': 2, 'hours': 1.0,
                                         'alarms': {'x': 2}, 'not_landed': 0, 'errors': []}]


def test_the_command_writes_page_markdown_and_json(listed, tmp_path, monkeypatch):
    monkeypatch.setattr('beetle_omni_ros.faults.command.campaign.fly_all',
                        lambda function, trials, *rest, jobs: (
                            result(trial.case, start=trial.start, seed=trial.seed,
                                   outcome='<b>') for trial in trials))
    docs = tmp_path / 'safety.md'
    docs.write_text(f'before\n{page.BEGIN}\nold\n{page.END}\nafter\n')
    console = Console(file=io.StringIO())
    totals = run_faults(only=['gust', 'impact'], starts=['hover'], seeds=2, seed=7, docs=docs,
                        output=tmp_path / 'out', console=console)
    assert f"page: {tmp_path / 'out' / 'faults.html'}\n" in console.file.getvalue()
    run_faults(only=['gust'], starts=['hover'], console=console)
    assert console.file.getvalue().endswith('no page written; --output DIR writes one\n')
    assert [(one['case'], one['seed']) for one in totals['flights']] == [
        ('gust', 7), ('gust', 8), ('impact', 7), ('impact', 8)]
    assert '--seeds 2 --seed 7 ' in totals['meta']['command']
    html = (tmp_path / 'out' / 'faults.html').read_text()
    assert '&lt;b&gt;' in html and 'http' not in html
    assert json.loads((tmp_path / 'out' / 'faults.json').read_text())['summary']['total']['good']
    assert '| gust |' in (tmp_path / 'out' / 'faults.md').read_text()
    assert docs.read_text().startswith('before\n') and docs.read_text().endswith('\nafter\n')
    assert 'old' not in docs.read_text() and '| impact |' in docs.read_text()


def test_an_interrupted_campaign_continues_and_more_seeds_extend_it(tmp_path, monkeypatch):
    flown, code = [], 'one'

    def fly_all(function, trials, *rest, jobs):
        flown.append([(trial.case, trial.seed) for trial in trials])
        yield from (result(trial.case, start=trial.start, seed=trial.seed) for trial in trials)

    monkeypatch.setattr('beetle_omni_ros.faults.command.campaign.fly_all', fly_all)
    monkeypatch.setattr('beetle_omni_ros.faults.command.code_fingerprint', lambda **_: code)

    def run(seeds, **options):
        return run_faults(**{'only': ['gust', 'impact'], **options}, starts=['hover'], seeds=seeds,
                          output=tmp_path, console=Console(file=io.StringIO()))['flights']

    run(1)
    with open(tmp_path / 'flights.jsonl', 'r+') as stored:
        stored.truncate(stored.seek(0, 2) - 5)      # interrupted while it was written
    both = run(2)
    assert flown == [[('gust', 0), ('impact', 0)], [('gust', 1), ('impact', 0), ('impact', 1)]]
    assert both == run(2) and flown[-1] == []
    assert len(run(1, only=['gust'])) == 1 and flown[-1] == []      # the others are kept
    run(1, bags=True)
    assert len(flown[-1]) == 2
    run(1, plant='measured')
    assert len(flown[-1]) == 2
    code = 'another'
    run(1)
    assert len(flown[-1]) == 2


def test_the_table_in_the_docs_agrees_with_the_list(listed):
    table = (ROOT / 'docs' / 'safety.md').read_text().split(page.BEGIN)[1].split(page.END)[0]
    rows = [[cell.strip() for cell in line.strip('| ').split(' | ')[:3]]
            for line in table.strip().splitlines()[2:]]
    assert rows == [[case.name, case.what, case.expected] for case in listed.cases.values()]


@pytest.mark.parametrize(('arguments', 'named'), [
    (['--only', 'gust,gost'], "'gost' is unknown, a name of the list is expected; near: gust"),
    (['--only', 'rotor_9_stops'], 'near: rotor_4_stops, rotor_3_stops'),
    (['--only', '7'], 'for example rotor_1'), (['--from', 'floor'], 'hover, moving, upside_down'),
    (['--controller', 'pid'], 'pid'), (['--conditions', 'windy'], 'windy'),
    (['--faults', 'none.yaml'], 'no such file'), (['--without-mocap'], '--landings'),
    (['--bags'], '--output'), (['--json', 'no/x.json'], 'x.json'), (['--seeds', '0'], '--seeds'),
    (['--docs', 'none.md'], 'none.md')])
def test_unusable_input_is_refused_in_one_line(capsys, arguments, named):
    assert cli.main(['faults', *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and named in lines[0]


def test_random_fault_times_cover_the_time_of_a_pose(listed):
    class Recorded:
        """Record the requested targets."""

        def __init__(self, seed):
            self.random, self.asked = np.random.default_rng(seed), []

        def aim_randomly(self, plan):
            self.asked.append('pose')

        def fly(self, duration):
            self.asked.append(duration)

    flights = [Recorded(seed) for seed in range(40)]
    for flight in flights:
        fly_to_start(flight, 'random', listed.flight)
    whole = listed.flight.pose_time
    assert all(flight.asked[:3] == ['pose', whole, 'pose'] for flight in flights)
    moments = np.array([flight.asked[3] for flight in flights]) / whole
    assert 0 <= moments.min() < 0.2 and 0.8 < moments.max() <= 1


def test_a_flight_waits_for_an_estimator_that_noisy_poses_delay(listed):
    """With this seed the estimator starts after more than the usual half second."""
    short = replace(listed, healthy=replace(listed.healthy, flight_time=0.5))
    flown = fly_healthy(HealthyTrial(7202, 'published'), short)
    assert (flown['error'], flown['alarms'], flown['state']) == ('', [], 'disarmed')
