"""
Data of interactive charts in a page; pages/charts.js draws them.

Numbers are stored as 16-bit integers between minimum and maximum of their series, which is finer
than the width of a line. Differences of neighbours are compressed, all series together.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
import gzip
from html import escape
import json

import numpy as np

from beetle_omni_ros.pages.page import shipped

STEPS, ABSENT = 65534, -32768


@dataclass(frozen=True)
class Series:
    """
    One line of a chart.

    Attributes:
        label: text in the legend.
        colour: '#rrggbb'.
        y: (N,) values, NaN for missing ones.
        run: index of its run, whose switch hides the line, or None.
        style: 'line', 'dash', 'dot', 'step' or 'points'.
        band: whether to fill the area to the previous series.

    """

    label: str
    colour: str
    y: np.ndarray
    run: int | None = None
    style: str = 'line'
    band: bool = False


@dataclass(frozen=True)
class Chart:
    """
    Lines over one axis.

    Attributes:
        label: label of the vertical axis, with its unit.
        series: lines of the chart.
        x: (N,) increasing values of the horizontal axis; None: the time of the page.
        xlabel: label of the horizontal axis.
        log: whether the (horizontal, vertical) axis is logarithmic.
        upright: (x, text) of vertical marks.
        level: (y, text) of horizontal marks.
        windows: (from, to, colour) of shaded ranges of the horizontal axis.
        wide: whether the chart has the full width of the page.

    """

    label: str
    series: list[Series]
    x: np.ndarray | None = None
    xlabel: str = ''
    log: tuple[bool, bool] = (False, False)
    upright: list[tuple[float, str]] = field(default_factory=list)
    level: list[tuple[float, str]] = field(default_factory=list)
    windows: list[tuple[float, float, str]] = field(default_factory=list)
    wide: bool = True

    def spec(self, numbers: Numbers) -> dict:
        """Return the data of the chart for the script; adds its series to ``numbers``."""
        return {
            'label': self.label, 'xlabel': self.xlabel, 'log': self.log, 'level': self.level,
            'upright': self.upright, 'windows': self.windows, 'wide': self.wide,
            'x': None if self.x is None else numbers.add(self.x, self.log[0]),
            'series': [{'label': s.label, 'colour': s.colour, 'run': s.run, 'style': s.style,
                        'band': s.band, 'y': numbers.add(s.y, self.log[1])} for s in self.series]}


class Numbers:
    """All series of a page, encoded for the script."""

    def __init__(self):
        self._parts: list[np.ndarray] = []
        self._count = 0

    def add(self, values: np.ndarray, log: bool = False) -> dict:
        """
        Add a series (N,), NaN for missing values; return its position and scale.

        With ``log``, logarithms are stored and only positive values are kept.
        """
        values = np.asarray(values, dtype=float)
        if log:
            values = np.log10(np.where(values > 0, values, np.nan))
        known = values[np.isfinite(values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
        step = (high - low) / STEPS or 1.0
        scaled = np.full(len(values), ABSENT)
        fine = np.isfinite(values)
        scaled[fine] = np.rint((values[fine] - low) / step) - STEPS // 2
        where = {'at': self._count, 'count': len(values), 'low': low, 'step': step, 'log': log}
        # Differences wrap round within 16 bits, and so do their sums in the script.
        self._parts.append(np.diff(scaled, prepend=0).astype('<i8').astype('<i2'))
        self._count += len(values)
        return where

    def blob(self) -> str:
        """Return all series, compressed, in base64."""
        data = np.concatenate([*self._parts, np.zeros(0, '<i2')])
        planes = data.view(np.uint8).reshape(-1, 2).T     # high bytes together: mostly equal
        return base64.b64encode(gzip.compress(planes.tobytes(), 9, mtime=0)).decode()


def data_block(data: dict, numbers: Numbers) -> str:
    """Return the HTML of the data for the script; no text in it can end the block."""
    text = json.dumps(data, separators=(',', ':'), allow_nan=False).replace('<', '\\u003c')
    return (f'<script type="application/json" id="data">{text}</script>\n'
            f'<script type="text/plain" id="numbers">{numbers.blob()}</script>\n')


def place(identifier: str, wide: bool = True) -> str:
    """Return the HTML element that the script fills with a chart."""
    return f'<div class="chart{"" if wide else " part"}" data-chart="{escape(identifier)}"></div>'


def scripts() -> str:
    """Return libraries and script of an interactive page as HTML."""
    libraries = ''.join(f'<script>{shipped(f"vendor/{name}.js")}</script>\n'
                        for name in ('uplot', 'three'))
    return (f'<style>{shipped("vendor/uplot.css")}</style>\n{libraries}'
            f'<script type="module">{shipped("charts.js")}{shipped("scene.js")}</script>\n')
