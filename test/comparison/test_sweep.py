"""Flights of a comparison: plan, both backends, cache, failures."""

import importlib.util
import io
import json
from pathlib import Path
import shutil
import subprocess
import sys

import pytest
from rich.console import Console

from beetle_omni_ros.comparison import command, fingerprint, sweep
from beetle_omni_ros.comparison import flight as flight_module
from beetle_omni_ros.comparison.plan import CONDITIONS, Flight, plan, TASKS
from beetle_omni_ros.comparison.sweep import Store
from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.runs.tasks import make_task

HAS_RAY = importlib.util.find_spec('ray') is not None


@pytest.fixture
def poses(tmp_path):
    """A pose file with one near pose, for a short flight."""
    path = tmp_path / 'poses.csv'
    path.write_text('x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n0.2,0.1,1.1,10,-20,40\n')
    return str(path)


def without_times(result):
    """Return the result of a flight without times that depend on the computer's load."""
    metrics = {key: value for key, value in result['metrics'].items() if key != 'compute_ms'}
    return json.dumps(metrics), {name: values.tolist() for name, values in
                                 result['trace'].items()}


def never(*arguments):
    """Replacement of a flight that must not happen."""
    raise AssertionError('flown again')


def test_a_plan_contains_each_combination_once_longest_first():
    controllers = registry.compared()
    flights = plan(controllers, seeds=(0, 5))
    assert len(flights) == len(set(flights)) == \
        len(controllers) * len(TASKS) * len(CONDITIONS) * 2
    costs = [flight.cost for flight in flights]
    assert costs == sorted(costs, reverse=True)
    assert flights[0].task == 'random100'
    assert len({flight.slug for flight in flights}) == len(flights)


def test_worker_processes_give_the_same_numbers_as_this_process(poses, tmp_path):
    flights = plan(['hover'], [poses], ['published'], [3, 4])
    flown = sweep.sweep(flights, store=Store(tmp_path / 'kept'), jobs=2)
    assert list(flown) == flights
    here = flight_module.fly_flight(flights[1], flights[1].make_task())
    assert without_times(here) == without_times(flown[flights[1]])


@pytest.mark.skipif(not HAS_RAY, reason='ray is not installed')
@pytest.mark.timeout(180)
def test_ray_gives_the_same_numbers_as_processes(poses, tmp_path):
    flights = plan(['hover'], [poses], ['nominal'], [0, 1])
    by_ray = sweep.sweep(flights, store=Store(tmp_path / 'ray'), backend='ray', jobs=2)
    by_processes = sweep.sweep(flights, store=Store(tmp_path / 'processes'), jobs=2)
    assert list(by_ray) == list(by_processes) == flights
    for flight in flights:
        assert by_ray[flight]['failure'] is None
        assert without_times(by_ray[flight]) == without_times(by_processes[flight])
    import ray
    assert not ray.is_initialized()


def test_finished_flights_are_cached_and_only_missing_ones_are_flown(poses, tmp_path, monkeypatch):
    store = Store(tmp_path / 'kept')
    flights = plan(['hover'], [poses], ['nominal'], [0, 1])
    first = sweep.sweep(flights[:1], store=store, jobs=1)
    calls = []

    def interrupt(flight, result, kept):
        calls.append((flight, kept))
        if len(calls) == 2:
            raise KeyboardInterrupt     # which keeps the finished flights

    with pytest.raises(KeyboardInterrupt):
        sweep.sweep(flights, store=store, jobs=1, done=interrupt)
    assert calls == [(flights[0], True), (flights[1], False)]
    monkeypatch.setattr(sweep, 'fly_flight', never)
    both = sweep.sweep(flights, store=store, jobs=1)
    assert without_times(first[flights[0]]) == without_times(both[flights[0]])
    assert both[flights[0]]['metrics']['compute_ms'] == first[flights[0]]['metrics']['compute_ms']
    with pytest.raises(AssertionError, match='flown again'):
        sweep.sweep(flights, store=store, jobs=1, fresh=True)


def test_a_cached_flight_is_reused_for_equal_inputs_only(poses, tmp_path, monkeypatch):
    store, flight = Store(tmp_path / 'kept'), Flight(poses, 'nominal', 'hover', 0)
    store.save(flight, {'failure': None, 'metrics': {}, 'trace': {}})
    assert store.load(flight) is not None
    assert store.load(Flight(poses, 'nominal', 'hover', 1)) is None
    with open(poses, 'a') as file:
        file.write('0,0,1,0,0,0\n')
    assert store.load(flight) is None
    store.save(flight, {'failure': None, 'metrics': {}, 'trace': {}})
    monkeypatch.setattr(fingerprint, 'code_fingerprint', lambda *_: 'other code')
    assert store.load(flight) is None


def test_another_policy_file_is_another_flight(tmp_path):
    flights = []
    for text in ('one', 'two'):
        file = tmp_path / f'{text}.onnx'
        file.write_text(text)
        flights += plan(['rl'], ['hover'], ['nominal'], [0], policy=file)
    keys = [fingerprint.flight_key(flight) for flight in flights]
    assert keys[0] != keys[1]
    (tmp_path / 'two.onnx').write_text('one')
    assert fingerprint.flight_key(flights[1]) == keys[0]


def test_another_plant_is_another_flight_as_far_as_its_values_differ(tmp_path):
    heavy = tmp_path / 'heavy.yaml'
    keys = []
    for text in ('name: same', 'mass: 3.3', 'name: other\nmass: 3.3'):
        heavy.write_text(f'extends: robot.yaml\n{text}\n')
        [flight] = plan(['nmpc'], ['hover'], ['nominal'], [0], plant=heavy)
        keys.append(fingerprint.flight_key(flight))
    assert keys[0] != keys[1] == keys[2]
    assert 'heavy' in flight.name


@pytest.mark.parametrize('name, controller, flies', [
    ('rl.yaml', 'rl', True), ('rl.yaml', 'nmpc', False), ('nmpc.yaml', 'hover', False),
    ('drive.yaml', None, False), ('supervisor.yaml', 'hover', True)])
def test_changes_of_unused_parameters_repeat_no_flight(tmp_path, monkeypatch, name,
                                                       controller, flies):
    copy = Path(shutil.copytree(share_path('params'), tmp_path / 'params'))
    monkeypatch.setattr(fingerprint, 'share_path', lambda _: copy)
    before = fingerprint.code_fingerprint.__wrapped__(controller)
    (copy / name).write_text((copy / name).read_text() + '\n')
    assert (fingerprint.code_fingerprint.__wrapped__(controller) != before) == flies


@pytest.mark.parametrize('controller', ['nmpc', 'rl_memory'])
def test_all_that_a_flight_loads_is_in_its_fingerprint(poses, controller):
    code = f"""if True:
        import sys
        def opened(event, given):
            if event == 'open' and str(given[0]).endswith('.yaml'):
                print(given[0])
        sys.addaudithook(opened)
        from beetle_omni_ros.comparison.flight import fly_flight
        from beetle_omni_ros.comparison.plan import Flight
        flight = Flight({poses!r}, 'published', {controller!r}, 0)
        assert fly_flight(flight, flight.make_task())['metrics']
        print(*(module.__file__ for name, module in list(sys.modules.items())
                if name.startswith('beetle_omni_ros.')), sep='\\n')"""
    loaded = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                            check=True, timeout=200).stdout.split()
    counted = {file.resolve() for file in fingerprint.flown_files(controller)}
    # Neither a flight nor its metrics depend on the fingerprint.
    counted.add(Path(fingerprint.__file__).resolve())
    missing = [file for file in loaded if (path := Path(file).resolve()) not in counted
               and path.name != '__init__.py']
    assert len(loaded) > 50 and not missing


def test_a_flight_with_a_truncated_file_is_repeated(poses, tmp_path):
    store, flight = Store(tmp_path), Flight(poses, 'nominal', 'hover', 0)
    store.save(flight, {'failure': None, 'metrics': {'a': list(range(999))}, 'trace': {}})
    kept, = tmp_path.glob('*.npz')
    kept.write_bytes(kept.read_bytes()[:200])
    assert store.load(flight) is None


def test_a_failed_flight_is_a_result_with_its_reason_and_not_cached(poses, tmp_path, monkeypatch):
    def fly(controller, *arguments, **options):
        if controller == 'nmpc':
            raise ZeroDivisionError('no way\nout')
        return real(controller, *arguments, **options)

    real = flight_module.fly
    monkeypatch.setattr(flight_module, 'fly', fly)
    results = command.run_compare(
        output=tmp_path / 'out', controllers=['nmpc', 'hover'], tasks=[poses],
        conditions=['nominal'], seeds=[0], jobs=1, console=Console(file=io.StringIO()))
    failed, flown = sorted(results['flights'], key=lambda entry: entry['failure'] is None)
    assert (failed['controller'], failed['failure']) == ('nmpc', 'ZeroDivisionError: no way out')
    assert flown['failure'] is None and flown['metrics']['poses']
    assert 'ZeroDivisionError: no way out' in (tmp_path / 'out' / 'comparison.html').read_text()
    assert len(list((tmp_path / 'out' / '.flights').glob('*.npz'))) == 1


def test_a_worker_with_different_code_is_refused(monkeypatch):
    monkeypatch.setattr(flight_module, 'fly', never)
    flight = Flight('hover', 'nominal', 'hover', 0)
    result = flight_module.fly_flight(flight, make_task('hover'), code='another')
    assert 'another version of the code' in result['failure']
