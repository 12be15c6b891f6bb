"""The report of flights without targets or with an early end, and the colours of its runs."""

import io

import numpy as np
from rich.console import Console
from synthetic_flights import (
    fly,
    write_diagnostic,
    write_odom,
    write_state,
    write_target,
    write_truth,
)

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.show.figures import LINES
from beetle_omni_ros.show.report import make_runs, run_report

LEVEL = np.array([0, 0, 0, 1.0])


def record(folder, *, task, body='truth', targets=0):
    """An intact bag of 4 s at rest, with ``targets`` poses in it."""
    with BagWriter(folder, {'task': task, 'seed': 0}) as writer:
        for k in range(80):
            t = 10 + 0.05 * k
            write = write_truth if body == 'truth' else write_odom
            write(writer, t, np.zeros(3), LEVEL, np.zeros(3), np.zeros(3))
            write_state(writer, t, 'flying:nmpc')
        for k in range(targets):
            write_target(writer, PoseTarget(np.array([0, 0, 1.0]), LEVEL, 10.5 + k))
    return folder


def test_flights_with_and_without_targets_share_one_page(tmp_path):
    bags = [record(tmp_path / 'none', task='hover', body='odom'),
            *(record(tmp_path / f'_{task}', task=task, targets=1)
              for task in ('waypoints', 'lemniscate', 'payload', 'force', ''))]
    page = tmp_path / 'page.html'
    results = run_report(bags, page, console=Console(file=io.StringIO()))
    assert results['meta']['seed'] == 0
    text = page.read_text()
    assert '>In time<' in text and all(str(bag) in text for bag in bags)
    run_report(bags[:1], page, console=Console(file=io.StringIO()))
    assert 'x [m]' in page.read_text() and 'position error [m]' not in page.read_text()


def test_the_outcome_and_faults_are_on_the_page_and_in_the_table(tmp_path):
    meta = {'task': 'waypoints', 'seed': 0, 'plant': 'used.yaml', 'robot': 'params/robot.yaml',
            'faults': ['rotor_stops at=5 rotor=2']}
    with BagWriter(tmp_path / 'bag', meta) as writer:
        for k in range(80):
            t = 10 + 0.05 * k
            write_truth(writer, t, np.array([0, 0, 1.0]), LEVEL, np.zeros(3), np.zeros(3))
            write_state(writer, t, 'flying:nmpc' if k < 30 else 'fallback:joint1_astray' if k < 40
                        else 'landing:rotor2_lost' if k < 70 else 'disarmed:<b>')
        write_target(writer, PoseTarget(np.array([0, 0, 1.0]), LEVEL, 10.5))
        write_diagnostic(writer, 13.0, 'supervisor_node: supervisor', {
            'fault.joint3_slipped': '12.5', 'nmpc.refused.stale stamp': '7'}, 1, 'landing')
    log = read_bag(tmp_path / 'bag')
    assert log.controllers() == ['nmpc']        # a fallback counts for the replaced controller
    assert [name for _, name in log.active_controller()] == ['nmpc', None]
    assert list(log.named_faults().items()) == [
        ('joint1_astray', 11.5), ('rotor2_lost', 12.0), ('joint3_slipped', 13.0),
        ('<b>', 13.5)]
    printed, page = io.StringIO(), tmp_path / 'page.html'
    run_report([tmp_path / 'bag'], page, console=Console(file=printed, width=200))
    assert printed.getvalue().startswith('task waypoints, seed 0, plant used.yaml')
    text = page.read_text()
    for expected in ('fault: rotor2_lost at', '"landing:rotor2_lost"', 'fault: &lt;b&gt; at',
                     'fault: joint3_slipped at', 'nmpc.refused.stale stamp',
                     'injected: rotor_stops at=5 rotor=2', 'plant used.yaml'):
        assert expected in text, expected
    assert 'landing: rotor2_lost at 1.5 s' in text and 'rotor2_lost at' in printed.getvalue()


def test_runs_of_a_report_have_the_colours_of_their_controllers_in_any_order():
    logs = {}
    for name in ('nmpc', 'rl'):
        fly(recorder := LogRecorder(), make_task('random1'), controller=name, duration=3.0)
        logs[name] = recorder.log()
    for order in (logs, reversed(logs)):
        for run in make_runs({name: logs[name] for name in order}):
            assert run.colour == LINES[run.label][0]
    first, *again = (run.colour for run in make_runs({str(k): logs['nmpc'] for k in range(6)}))
    assert first == LINES['nmpc'][0] and len(set(again)) == 5
    assert not {line[0] for line in LINES.values()} & set(again)
    assert set(LINES) == set(registry.SHIPPED)
