"""Lines of charts: every sample of a flight of two minutes, extremes and gaps of a long one."""

import base64
import json
import re

import numpy as np
from synthetic_flights import write_truth

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.show.charts import html, MOST, Run


def lines_of(page):
    """(times, values) of each line of a run in a page."""
    figure = json.JSONDecoder().raw_decode(re.search(r'{data, layout, times} = (.*)',
                                                     page).group(1))[0]
    floats = [np.frombuffer(base64.b64decode(text), 'f4') for text in figure['times']]
    return [(floats[trace['x']], np.frombuffer(base64.b64decode(trace['y']['bdata']), 'f4'))
            for trace in figure['data'] if isinstance(trace['x'], int)]


def test_an_oscillation_in_a_flight_of_two_minutes_keeps_its_form():
    log, frequency, level = LogRecorder(), 5.0, np.array([0, 0, 0, 1.0])
    for t in np.arange(0, 100, 0.005):
        height = 1 + 0.1 * np.sin(2 * np.pi * frequency * t)
        write_truth(log, t, np.array([0, 0, height]), level, np.zeros(3), np.zeros(3))
    log = log.log()
    lines = lines_of(html([Run('a', '#123456', log, {})]))
    times, values = max(lines, key=lambda line: np.ptp(line[1]))
    t = log.begin + np.arange(10, 12, 0.001)
    shown = np.interp(t - log.begin, times, values)
    # Straight lines between samples at 200 Hz leave a sine by (2 pi f dt)^2 / 8 = 0.3 %.
    assert np.max(np.abs(shown - 1 - 0.1 * np.sin(2 * np.pi * frequency * t))) < 0.1 * 0.01


def test_a_line_is_bounded_and_keeps_extremes_and_gaps():
    t = np.arange(0, 800, 0.005)
    t = t[(t < 40) | (t > 45)]
    values = np.random.default_rng(0).normal(size=len(t))
    values[7001], values[9001] = 50.0, -60.0
    line = Run('a', '#123456', LogRecorder().log(), {}).line(t, values)
    assert len(line.x) < 1.6 * MOST and np.all(np.diff(line.x) >= 0)
    assert np.nanmax(line.y) == 50 and np.nanmin(line.y) == -60
    missing = line.x[np.isnan(line.y)]
    assert len(missing) and np.all((missing >= 39.9) & (missing <= 45.1))
