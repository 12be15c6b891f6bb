"""Flights of a comparison: plan, stored results, failures."""

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from beetle_omni_ros.flight import campaign
from beetle_omni_ros.flight import compare as command
from beetle_omni_ros.flight.campaign import Store
from beetle_omni_ros.flight.compare import ComparedFlight, fly_flight, plan


@pytest.fixture
def poses(tmp_path):
    """A pose file with one near pose, for a short flight."""
    path = tmp_path / 'poses.csv'
    path.write_text('x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n0.2,0.1,1.1,10,-20,40\n')
    return str(path)


def without_times(result):
    """Return the result of a flight without times that depend on the computer's load."""
    metrics = {key: value for key, value in result['metrics'].items() if key != 'compute_ms'}
    return json.dumps(metrics), {name: values.tolist() for name, values in result['trace'].items()}


def sweep(flights, **options):
    return campaign.sweep(fly_flight, [(flight, flight.make_task()) for flight in flights],
                          **options)


def test_workers_give_the_numbers_of_this_process_and_are_flown_once(poses, tmp_path, monkeypatch):
    store, lines = Store(tmp_path / 'kept'), []
    flights = plan(['hover'], [poses], ['published'], [3, 4])

    def interrupt(flight, result, kept):
        lines.append((flight.seed, kept))
        if len(lines) == 2:
            raise KeyboardInterrupt     # which keeps the finished flights
        return ''

    first = sweep(flights[:1], store=store, jobs=2)
    assert without_times(fly_flight(flights[0], flights[0].make_task())) == without_times(first[0])
    with pytest.raises(KeyboardInterrupt):
        sweep(flights, store=store, jobs=1, line=interrupt)
    assert lines == [(3, True), (4, False)]
    monkeypatch.setattr(command, 'fly', None)    # all are kept
    both = sweep(flights, store=store, jobs=1)
    assert without_times(first[0]) == without_times(both[0])
    assert both[1]['metrics']['poses'] and not both[1]['failure']
    assert both[0]['metrics']['mean'] != both[1]['metrics']['mean']     # of another seed


def test_a_stored_flight_is_reused_for_equal_inputs_only(poses, tmp_path, monkeypatch):
    store, flight = Store(tmp_path / 'kept'), ComparedFlight(poses, 'nominal', 'hover', 0)
    store.save(flight, {'failure': None, 'metrics': {'a': list(range(999))}, 'trace': {}})
    assert store.load(flight) is not None
    assert store.load(ComparedFlight(poses, 'nominal', 'hover', 1)) is None
    with monkeypatch.context() as patch:
        patch.setattr(campaign, 'code_fingerprint', lambda *_: 'other code')
        assert store.load(flight) is None
    with open(poses, 'a') as file:
        file.write('0,0,1,0,0,0\n')
    assert store.load(flight) is None
    store.save(flight, {'failure': None})
    kept, = (tmp_path / 'kept').glob('*.npz')       # in place of the old one
    kept.write_bytes(kept.read_bytes()[:200])
    assert store.load(flight) is None


def test_a_failed_flight_is_a_result_with_its_reason_and_not_stored(poses, tmp_path, monkeypatch):
    def fly(controller, *arguments, **options):
        if controller == 'nmpc':
            raise ZeroDivisionError('no way\nout')
        return real(controller, *arguments, **options)

    real = command.fly
    monkeypatch.setattr(command, 'fly', fly)
    results = command.run_compare(
        output=tmp_path / 'out', controllers=['nmpc', 'hover'], tasks=[poses],
        conditions=['nominal'], seeds=[0], jobs=1, console=Console(file=io.StringIO()))
    failed, flown = sorted(results['flights'], key=lambda entry: entry['failure'] is None)
    assert (failed['controller'], failed['failure']) == ('nmpc', 'ZeroDivisionError: no way out')
    assert flown['failure'] is None and flown['metrics']['poses']
    assert 'ZeroDivisionError: no way out' in (tmp_path / 'out' / 'comparison.html').read_text()
    assert len(list((tmp_path / 'out' / '.flights').glob('*.npz'))) == 1


@pytest.mark.parametrize(('file', 'decides'), [
    ('sim/faults.py', True), ('flight/loop.py', True), ('bags/metrics.py', True),
    ('flight/faults.py', False), ('flight/comparison_page.py', False)])
def test_the_key_of_a_flight_covers_the_code_that_decides_it(file, decides, monkeypatch):
    key, read = campaign.code_fingerprint.__wrapped__, Path.read_bytes
    before = key(__file__)
    monkeypatch.setattr(Path, 'read_bytes', lambda path: read(path) + b'#' * (
        path == campaign.SOURCE / file))
    assert (key(__file__) != before) is decides
