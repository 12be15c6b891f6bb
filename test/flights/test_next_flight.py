"""The next flight: what measurements are expected to decide, and flights that follow a motion."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.experiment import Experiments
from beetle_omni_ros.identify.flights import next_flight
from beetle_omni_ros.identify.flights.evidence import Judge, log_prior, normal
from beetle_omni_ros.identify.flights.keys import Entry
from beetle_omni_ros.identify.flights.next_flight import (
    Explanation,
    flat_flight,
    information,
    log_density,
    Outlook,
    Planner,
    posterior_of,
    Sight,
)
from beetle_omni_ros.identify.flights.results import Weighed
from beetle_omni_ros.identify.flights.spectrum import spectrum
from beetle_omni_ros.identify.flights.table_flight import TableFlight
from beetle_omni_ros.identify.flights.verdict import judged_tables, load_tables
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.identify.recording.table import Format
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path

KEYS = 4        # two candidates, a nuisance, and one that differs from flight to flight
MANY = 2000     # blocks, so that the scatter of few does not count


def hypotheses():
    means = np.array([[0.8, 0, 0, 0], [0, 0.8, 0, 0]])
    spread = np.diag([0.1, 0.1, 0.5, 0.1])**2
    return [Explanation(label, (k,), 0.0, means[k], spread + 0.2**2 * np.diag(np.eye(KEYS)[k]))
            for k, label in enumerate('ab')]


def outlook():
    engine = SimpleNamespace(
        names=list('abcd'), narrow=np.full(KEYS, 0.1), typical=np.array([1.0, 1.0, 0.0, 0.0]),
        flight=np.array([0.0, 0.0, 0.0, 0.5]), alpha=0.05, entries=[0, 1])
    solution = SimpleNamespace(spectra=[SimpleNamespace(residual=np.zeros(MANY))])
    return Outlook(engine, solution, hypotheses())


def gram(*rows):
    slopes = np.array(rows, dtype=float)
    return slopes.T @ slopes


def test_what_a_nuisance_or_the_flight_explains_as_well_decides_little():
    view = outlook()
    clean, hidden, both, apart = (view.chances([gram(row)])[:, 0].mean() for row in (
        [3.0, 0, 0, 0], [3.0, 0, 0, 3e3], [3.0, 3.0, 0, 0], [3.0, -3.0, 0, 0]))
    assert hidden < 0.5 * clean
    assert both < 0.5 * apart       # the sum of the candidates does not tell them apart


def test_the_probability_of_a_decision_is_that_of_simulated_measurements():
    view, slopes = outlook(), np.array([[2.0, -2.0, 0, 0]])
    chances = view.chances([gram(*slopes)])
    densities = [multivariate_normal(slopes @ h.mean, slopes @ h.covariance @ slopes.T + np.eye(1))
                 for h in hypotheses()]
    for k in (0, 1):
        z = densities[k].rvs(100_000, random_state=2)[:, None]
        ratio = densities[k].logpdf(z) - densities[1 - k].logpdf(z)
        assert chances[k] == pytest.approx([(ratio > np.log(20)).mean(),
                                            (ratio < -np.log(20)).mean()], abs=0.03)


def test_a_density_that_is_very_wide_in_one_direction_has_the_noise_in_the_others():
    wide, across = np.linalg.qr(np.random.default_rng(3).normal(size=(30, 2)))[0].T
    covariance = 1e12 * np.outer(wide, wide) + np.eye(30)
    found = log_density(np.array([np.zeros(30), 3 * across, 1e6 * wide]), np.zeros(30), covariance)
    assert found - found[0] == pytest.approx([0, -4.5, -0.5], abs=1e-3)


@pytest.mark.parametrize('verdict', ['named', 'no_gap', 'unknown'])
def test_after_a_decision_there_is_no_task(verdict, tmp_path):
    path = tmp_path / 'next.yaml'
    found = Planner(None, None, None, path)(None, {'verdict': verdict})['next_flight']
    assert found['task'] is None and not path.exists()
    assert found['sentence'].startswith(f'{verdict}: there is nothing to decide')


def test_the_most_decisive_poses_that_keep_their_margins_with_all_candidates_are_written(
        monkeypatch, tmp_path):
    view, own = outlook(), hypotheses()
    sizes = {3: 3.0, 4: 4.0, 5: None}       # seed -> information; None: margin lost
    monkeypatch.setattr(next_flight, 'hypotheses_of', lambda weighed: own)
    monkeypatch.setattr(next_flight, 'Outlook', lambda *_: view)
    monkeypatch.setattr(next_flight, 'plant_of', lambda weighed, one, robot: one.label)
    monkeypatch.setattr(next_flight, 'grams_of', lambda engine, solution, flight: [
        gram([flight.size, -flight.size, 0, 0])])
    monkeypatch.setattr(Planner, '_flown', lambda self, engine, poses, plant: None if sizes[
        poses[0, 0]] is None else SimpleNamespace(usable=plant == 'a', size=sizes[poses[0, 0]]))
    written = {}
    experiments = SimpleNamespace(
        duration=56.0, poses=lambda seed, level: np.full((1, 6), seed),
        flown=lambda poses, plant: None if (poses[0, 0], plant) == (4, 'b') else 'a log',
        write=lambda path, poses, level, head: written.update(poses=poses, level=level, head=head))
    found = Planner(None, None, experiments, tmp_path / 'next.yaml')(
        Weighed(SimpleNamespace(flights=[0]), None, {}, starts={}), {'verdict': 'named_set'}
    )['next_flight']
    assert found['poses'] == written['poses'].tolist() == [[3.0] * 6]
    right = view.chances([gram([3.0, -3.0, 0, 0])])
    assert found['probability'] == pytest.approx(right[:, 0].mean())
    assert [each['name'] for each in found['hypotheses']] == ['a', 'b']
    assert found['sentence'] in written['head'] and not written['level']


def test_an_undecided_flight_of_a_table_is_followed_by_level_poses(crazyflie, tmp_path):
    robot, path = crazyflie.robot, tmp_path / 'next.yaml'
    table = replace(crazyflie.table, values={
        name: rows[:len(crazyflie.time) // 3] for name, rows in crazyflie.table.values.items()})
    short = TableFlight(table, robot, crazyflie.body, crazyflie.keys)
    found = judged_tables([short], [], robot, GapParameters.load(None), Format.load('nanobench'),
                          then=Planner(robot, None, Experiments(robot), path))
    assert found['verdict'] == 'not_decidable'
    assert 0.2 < found['next_flight']['probability'] < 0.8
    assert make_task(str(path)).duration == pytest.approx(56.0)


def test_a_flight_of_level_rotors_obeys_the_body_equations(crazyflie):
    position, yaw = Experiments.level_motion(Experiments.poses(0, level=True), crazyflie.period)
    flight = flat_flight(crazyflie, position, yaw)
    assert flight.channels == crazyflie.channels
    inside = (flight.time > 9.0) & (flight.time < 23.0)
    linear = flight.linear({}, [])
    for name, measured, left in zip(flight.channels, flight.measured({}).T,
                                    linear.residual.T, strict=True):
        if name.startswith(('force', 'torque')):
            assert np.std(left[inside]) < 0.1 * max(np.std(measured[inside]), 0.05), name


@pytest.fixture(scope='module')
def crazyflie():
    robot = RobotParameters.load(share_path('params') / 'crazyflie.yaml')
    path = sorted((Path(__file__).parents[1] / 'data/nanobench').glob('*.csv.gz'))[0]
    return load_tables([path], robot, Format.load('nanobench'))[0]


def test_an_effect_is_named_with_the_probability_that_its_evidence_suffices():
    """A key alone: the threshold of its evidence is one of the size of the estimate."""
    rng, names = np.random.default_rng(3), ['one', 'two']
    slopes = rng.normal(size=(1600, 1, 2))
    found = spectrum(-slopes @ [0.0, 0.0], slopes, np.ones((1600, 1), dtype=bool), 0.01,
                     np.full(1, 1e-6), np.inf, [np.arange(1)])
    found.noise[:] = 16.0
    engine = SimpleNamespace(
        names=names, narrow=np.array([0.01, 1e-6]), typical=np.array([0.3, 0.3]), alpha=0.05,
        flight=np.zeros(2), entries=[Entry(name, (name,)) for name in names],
        indices=lambda chosen: list(chosen))
    solution = SimpleNamespace(spectra=[found])
    sight = Sight(engine, solution, ['one', 'of a balance'])
    assert sight.labels == ['one']
    more = [gram([30.0, 0.0])]
    info = found.grams()[0].sum(axis=(0, 1))[0, 0] + information(engine, solution, more)[0, 0]
    null = 1 / info + 0.01**2
    wide = null + 0.3**2
    # ln B > least for an estimate beyond a limit
    least = np.log(20) + log_prior(0, 2) - log_prior(1, 2)
    limit = np.sqrt((least + 0.5 * np.log(wide / null)) * 2 / (1 / null - 1 / wide))
    expected = 2 * norm.sf(limit / np.sqrt(wide))
    assert 0.2 < expected < 0.9
    assert sight.chances(more)[0] == pytest.approx([expected, 0.0], abs=0.03)
    assert sight.chances([0 * more[0]])[0, 0] < expected


def test_a_limit_that_acts_has_a_factor_of_one_in_a_set_with_it_and_of_zero_in_others():
    rng, narrow, typical = np.random.default_rng(4), np.full(2, 0.03), np.array([1.0, 0.3])
    slopes = rng.normal(size=(1600, 1, 2))
    found = spectrum(-slopes @ [1.0, 0.0], slopes, np.ones((1600, 1), dtype=bool), 0.01,
                     np.full(1, 1e-6), np.inf, [np.arange(1)])
    found.noise[:] = 16.0
    engine = SimpleNamespace(narrow=narrow, typical=typical, indices=list)
    equations, no = normal([found], ['limit', 'other'], np.zeros(2)), np.zeros(2, dtype=bool)
    judge = Judge(equations, narrow, typical, np.array([[0.0, np.inf], [-np.inf, np.inf]]), no,
                  np.arange(2), 0.05, no, np.array([True, False]))
    solution = SimpleNamespace(spectra=[found], banned={}, judge=judge)
    acting, without = (posterior_of(engine, solution, equations, (k,))[0] for k in (0, 1))
    assert acting[0] == pytest.approx(1.0, abs=0.005)
    assert without[0] < 0.5     # the data alone would have 0.1 as standard deviation
