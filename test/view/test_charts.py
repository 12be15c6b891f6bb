"""Lines of charts: few points, extremes and gaps kept."""

import numpy as np

from beetle_omni_ros.runs.log import LogRecorder
from beetle_omni_ros.view.charts import POINTS, Run


def test_a_line_has_few_points_and_keeps_extremes_and_gaps():
    t = np.arange(0, 100, 0.005)
    t = t[(t < 40) | (t > 45)]
    values = np.random.default_rng(0).normal(size=len(t))
    values[7001], values[9001] = 50.0, -60.0
    line = Run('a', '#123456', LogRecorder().log(), {}).line(t, values)
    assert len(line.x) < 1.6 * POINTS and np.all(np.diff(line.x) >= 0)
    assert np.nanmax(line.y) == 50 and np.nanmin(line.y) == -60
    missing = line.x[np.isnan(line.y)]
    assert len(missing) and np.all((missing >= 39.9) & (missing <= 45.1))
