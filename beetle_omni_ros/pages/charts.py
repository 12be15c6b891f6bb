"""
Charts that a reader can zoom, as data of a page; pages/charts.js draws them.

Numbers travel as 16-bit integers between the least and the greatest of their series, which is far
finer than a line is wide. The differences of neighbours are compressed, all series together.
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
        label: in the legend.
        colour: '#rrggbb'.
        y: (N,) values, NaN where there are none.
        run: index of the run that it belongs to, or None; its switch hides the line.
        style: 'line', 'dash', 'dot', 'step' or 'points'.
        band: fill to the series before this one.

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
        label: of the vertical axis, with its unit.
        series: its lines.
        x: (N,) rising values of the horizontal axis; None: the time of the page.
        xlabel: of that axis.
        log: (horizontal, vertical) axis logarithmic.
        upright: (x, text) vertical marks.
        level: (y, text) horizontal marks.
        windows: (from, to, colour) shaded stretches of the horizontal axis.
        wide: over the whole width of the page, or a part of it.

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
        """Return what the script reads."""
        return {
            'label': self.label, 'xlabel': self.xlabel, 'log': self.log, 'level': self.level,
            'upright': self.upright, 'windows': self.windows, 'wide': self.wide,
            'x': None if self.x is None else numbers.add(self.x, self.log[0]),
            'series': [{'label': s.label, 'colour': s.colour, 'run': s.run, 'style': s.style,
                        'band': s.band, 'y': numbers.add(s.y, self.log[1])} for s in self.series]}


class Numbers:
    """All series of a page, as the script reads them."""

    def __init__(self):
        self._parts: list[np.ndarray] = []
        self._count = 0

    def add(self, values: np.ndarray, log: bool = False) -> dict:
        """
        Take in a series.

        Args:
            values: (N,), NaN where there are none.
            log: resolve their logarithm evenly; only positive ones are kept.

        Returns:
            where the script finds them.

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
        """All of them, compressed, in base64."""
        data = np.concatenate([*self._parts, np.zeros(0, '<i2')])
        planes = data.view(np.uint8).reshape(-1, 2).T     # high bytes together: mostly equal
        return base64.b64encode(gzip.compress(planes.tobytes(), 9, mtime=0)).decode()


def data_block(data: dict, numbers: Numbers) -> str:
    """What the script of the page reads; nothing in it can end the block."""
    text = json.dumps(data, separators=(',', ':'), allow_nan=False).replace('<', '\\u003c')
    return (f'<script type="application/json" id="data">{text}</script>\n'
            f'<script type="text/plain" id="numbers">{numbers.blob()}</script>\n')


def place(identifier: str, wide: bool = True) -> str:
    """Where a chart goes; the script finds it by its name."""
    return f'<div class="chart{"" if wide else " part"}" data-chart="{escape(identifier)}"></div>'


def scripts() -> str:
    """Libraries and script of an interactive page, as HTML."""
    libraries = ''.join(f'<script>{shipped(f"vendor/{name}.js")}</script>\n'
                        for name in ('uplot', 'three'))
    return (f'<style>{shipped("vendor/uplot.css")}</style>\n{libraries}'
            f'<script type="module">{shipped("charts.js")}{shipped("scene.js")}</script>\n')
