"""The margins of a loop are those of its closed form."""

from pathlib import Path
import runpy

import numpy as np
import pytest

MARGINS = runpy.run_path(str(Path(__file__).parents[1] / 'benchmarks/margins.py'))


@pytest.mark.parametrize(('gain', 'delay'), [(2.0, 0.05), (8.0, 0.02)])
def test_an_integral_with_a_delay_has_its_known_margins(gain, delay):
    w = 2 * np.pi * MARGINS['FREQUENCIES']
    loop = -gain / (1j * w) * np.exp(-1j * w * delay)
    found = MARGINS['margins_of'](loop[:, None, None] * np.diag([1.0, 0.1]), w)
    assert found['phase_deg'] == pytest.approx(90 - np.degrees(gain * delay), rel=0.01)
    assert found['delay_ms'] == pytest.approx(1e3 * (np.pi / 2 / gain - delay), rel=0.01)
    assert found['gain'] == pytest.approx(np.pi / 2 / gain / delay, rel=0.01)
    assert found['gain_down'] is None
