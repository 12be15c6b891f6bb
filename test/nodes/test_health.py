"""Diagnostics: quantiles in constant memory, missed targets of the motor board."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.drivers.motor_board import FLIES, Sent
from beetle_omni_ros.nodes import bridge_nodes
from beetle_omni_ros.nodes.bridge_nodes import RotorBridgeNode
from beetle_omni_ros.nodes.node import Distribution


def test_quantiles_agree_with_sorting_within_two_percent():
    distribution = Distribution()
    assert np.isnan(distribution.quantile(0.5))
    samples = 1e-3 * np.exp(np.random.default_rng(1).normal(0, 2.0, 5000))
    for sample in samples:
        distribution.add(float(sample))
    for fraction in (0.5, 0.9, 0.99):
        assert distribution.quantile(fraction) == pytest.approx(
            np.quantile(samples, fraction), rel=0.02)
    assert distribution.max == samples.max() and distribution.count == 5000


@pytest.mark.parametrize(('gaps', 'cycles', 'missed'), [
    ([0.007, 0.003, 0.0051], 3, 0),     # nearer to one period than to two
    ([0.005, 0.0076, 0.005], 4, 1),
    ([0.005, 0.021, 0.005], 6, 3),
    ([0.001, 0.0, 0.004], 1, 0)])
def test_a_period_without_a_target_is_missed(monkeypatch, gaps, cycles, missed):
    node = SimpleNamespace(
        _command=Command(0.0, np.zeros(4), np.zeros(4)), now=lambda: 0.0, _period=0.005,
        _arming=SimpleNamespace(phase=FLIES), parameters=SimpleNamespace(stamp_age_limit=0.1),
        _board=SimpleNamespace(send=lambda *_: Sent('', np.zeros(4, bool), np.zeros(4))),
        _last_target=None, _cycles=0, _missed=0, _saturated=np.zeros(4, int))
    for now in 100 + np.cumsum([0.0, *gaps]):
        monkeypatch.setattr(bridge_nodes.time, 'monotonic', lambda now=now: now)
        assert RotorBridgeNode._send(node)
    assert (node._cycles, node._missed) == (cycles, missed)
