"""Colours: a controller has one, in figures, pages and scenes."""

from synthetic_flights import fly

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.show.figures import LINES
from beetle_omni_ros.show.report import make_runs


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
