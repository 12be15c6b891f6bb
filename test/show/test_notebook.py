"""A flight in a notebook: time from 0, the numbers of its bag, charts, table, page."""

from flown_once import flight
import numpy as np
import pytest

import beetle_omni_ros
from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.log import target_errors
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.model.schema import ParameterError


@pytest.fixture(scope='module')
def log():
    """A flight of two poses."""
    return beetle_omni_ros.read_run(flight('calm'))


def test_times_start_at_0_and_the_numbers_are_those_of_the_bag(log):
    bag = read_bag(flight('calm'))
    assert log.start == 0 < log.begin == pytest.approx(bag.begin - bag.start)
    for moved, given in ((log.command.received, bag.command.received), (log.state_t, bag.state_t),
                         (log.requests['hover'].t, bag.requests['hover'].t)):
        assert np.allclose(moved + log.epoch, given, rtol=0, atol=1e-6)
    assert log.diagnostics[-1].t == bag.diagnostics[-1].t - bag.start
    assert log.metrics()['mean'] == pytest.approx(metrics(bag)['mean'], rel=1e-6)


def test_five_lines_describe_a_flight(log):
    lines = repr(log).splitlines()
    assert len(lines) == 5 and max(map(len, lines[:4])) < 120
    assert lines[0].startswith('flight of hover: task own poses') and ' s from 20' in lines[1]
    assert lines[2].startswith('poses reached 2 of 2; U 0.') and lines[3].startswith('alarms none')


def test_charts_are_chosen_by_the_begin_of_their_titles(log):
    titles = [note.text for note in log.plot('position error', 'tilt').layout.annotations]
    assert titles == ['position error [m]', 'tilt command [rad]']
    with pytest.raises(ParameterError, match='charts speed: expected the begin of one of pos'):
        log.plot('speed')


def test_a_table_has_the_newest_value_of_each_series_and_the_error(log):
    pytest.importorskip('pandas')
    table = log.to_pandas()
    assert len(table) == len(log.truth)
    assert table['truth_quaternion_w'].iloc[0] == log.truth.quaternion[0, 3]
    newest = np.searchsorted(log.mocap.t, table.index[2000], side='right') - 1
    assert table['mocap_position_z'].iloc[2000] == log.mocap.position[newest, 2]
    assert table['state'].iloc[2000] == 'flying:hover'
    assert np.isnan(table['error_m'][:log.begin - 0.01]).all()
    t, distance, _ = target_errors(log)
    assert table['error_m'][t[-1]] == distance[-1]
