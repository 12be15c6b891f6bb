"""Colours: a controller has one, in figures, pages and scenes."""

from made_flights import made
from synthetic_flights import fly

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.comparison_page import convergence, in_time
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


def test_in_a_figure_of_the_comparison_rl_is_on_top_and_the_legend_is_a_block():
    names = sorted(LINES, key=lambda name: name != 'rl')
    for draw, task in ((convergence, 'random1'), (in_time, 'wind')):
        figure = draw({name: [made(task)] for name in names}, task)
        heights = {line.get_color(): line.get_zorder() for line in figure.axes[0].lines}
        assert max(heights, key=heights.get) == LINES['rl'][0]
        block, = figure.legends
        assert -(-len(block.get_texts()) // block._ncols) == 2
        assert len(block.get_texts()) % block._ncols in (0, block._ncols - 1)
