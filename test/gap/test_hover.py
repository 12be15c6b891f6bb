"""Flights at rest: the controller answers noise, and its answer is no effect of the robot."""

from rich.console import Console

import beetle_omni_ros
from beetle_omni_ros.identify.flights.command import gap_results


def test_two_calm_hovers_show_only_means_and_name_nothing(tmp_path):
    bags = [tmp_path / f'{seed}' for seed in (1, 2)]
    for seed, bag in enumerate(bags, 1):
        beetle_omni_ros.simulate('nmpc', 'hover', seed=seed, bag=bag)
    result = gap_results(bags, console=Console(quiet=True))
    assert not result['effects'] and result['false_alarm_probability'] > 0.05
    for kind in ('force', 'acceleration', 'rate'):
        assert 'only means' in result['groups'][kind]['reason']
    assert 'only means' not in result['groups']['joint'].get('reason', '')
