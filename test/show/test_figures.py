"""Colours: a controller has one, in figures, pages and scenes."""

from made_flights import made
from synthetic_flights import fly

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.comparison_page import convergence, in_time
from beetle_omni_ros.flight.summary import look
from beetle_omni_ros.show.figures import LINES
from beetle_omni_ros.show.report import make_runs


def flown(controller):
    recorder = LogRecorder()
    fly(recorder, make_task('random1'), controller=controller, duration=3.0)
    return recorder.log()


def test_runs_of_a_report_have_the_colours_of_their_controllers_in_any_order():
    logs = {name: flown(name) for name in ('nmpc', 'rl')}
    for order in (list(logs), list(logs)[::-1]):
        for run in make_runs({name: logs[name] for name in order}):
            assert run.colour == look(run.label).colour
    again = [run.colour for run in make_runs({str(k): logs['nmpc'] for k in range(6)})]
    assert again[0] == look('nmpc').colour and len(set(again)) == 6
    assert not {line[0] for line in LINES.values()} & set(again[1:])
    assert set(LINES) == set(registry.SHIPPED)


def test_in_a_figure_of_the_comparison_rl_is_on_top_and_the_legend_is_a_block():
    names = list(LINES)[::-1]
    names.sort(key=lambda name: name != 'rl')
    for draw, task in ((convergence, 'random1'), (in_time, 'wind')):
        figure = draw({name: [made(task)] for name in names}, task)
        for axes in figure.axes:
            heights = {line.get_label(): line.get_zorder() for line in axes.lines}
            if look('rl').label in heights:
                assert max(heights, key=heights.get) == look('rl').label
        block, = figure.legends
        rows, left = divmod(len(block.get_texts()), block._ncols)
        assert left in (0, block._ncols - 1) and rows + bool(left) == 2
