"""A flight in a notebook: metrics, charts, table, page; times start at 0."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from beetle_omni_ros.bags.log import FlightLog, motion, SERIES, Series, target_errors
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control.tasks import Task
from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.show import charts, table
from beetle_omni_ros.show.figures import COLOURS
from beetle_omni_ros.show.page import number
from beetle_omni_ros.show.report import make_page, make_runs, results_of

PARTS = {3: 'xyz', 4: '1234'}       # of a channel by its width
DIGITS = 6      # of times [s]: UNIX time as a float has a resolution of 0.24 us


@dataclass(repr=False, eq=False)
class NotebookLog(FlightLog):
    """
    A flight whose times start at 0, its first sample.

    ``metrics()``, ``plot()``, ``to_pandas()`` and ``report(path)`` evaluate and show it; the
    series are those of :class:`~beetle_omni_ros.bags.log.FlightLog`.

    Attributes:
        task: the flown task; None: that of ``meta``, if it is a named one.
        epoch: time 0 on the clock of the flight, in seconds since 1970-01-01 UTC.

    """

    task: Task | None = None
    epoch: float = 0.0

    @classmethod
    def of(cls, log: FlightLog, task: Task | None = None) -> NotebookLog:
        """Return a flight with times from 0."""
        start = log.start

        def moved(series):
            return Series(**{name: np.round(values - start, DIGITS) if name in ('t', 'received')
                             else values for name, values in vars(series).items()})

        return cls(**{
            **vars(log), **{name: moved(getattr(log, name)) for name in SERIES},
            'requests': {name: moved(series) for name, series in log.requests.items()},
            'targets': [target.delayed(-start) for target in log.targets],
            'state_t': np.round(log.state_t - start, DIGITS),
            'compute_history': {name: [(t - start, report) for t, report in reports]
                                for name, reports in log.compute_history.items()},
            'diagnostics': [replace(entry, t=entry.t - start) for entry in log.diagnostics]},
            task=task, epoch=start)

    def metrics(self) -> dict:
        """Return the numbers of a controller in `evaluate --json` (docs/reference/metrics.md)."""
        return metrics(self, self.task)

    def plot(self, *names: str) -> Any:
        """
        Return a plotly figure over the time since the first target.

        Args:
            names: begins of the titles of charts, such as 'position error'; none: all charts.

        """
        return charts.figure([charts.Run(self._name(), COLOURS[0], self, {})], *names)

    def to_pandas(self, series: str | None = None) -> Any:
        """
        Return a pandas.DataFrame with the time [s] as index; needs the extra ``notebook``.

        Args:
            series: name of a series, or of the controller of ``requests``, as recorded. None: all
                series at the times of ``truth`` (without it ``odom``), each with its newest value,
                the state of the supervisor, and the errors from the target [m], [deg].

        """
        try:
            import pandas
        except ModuleNotFoundError:
            raise ModuleNotFoundError('to_pandas needs pandas: '
                                      "pip install 'beetle_omni_ros[notebook]'") from None
        known = {**self.requests, **{name: getattr(self, name) for name in SERIES}}
        if series is not None and series not in known:
            raise ParameterError(f"series '{series}': expected {', '.join(known)}")

        def frame(times, columns):
            return pandas.DataFrame(columns, index=pandas.Index(times, name='t'))

        def recorded(one):
            columns = {}
            for channel, values in vars(one).items():
                if channel in ('t', 'received'):
                    continue
                if values.ndim == 1:
                    columns[channel] = values
                    continue
                parts = 'xyzw' if channel == 'quaternion' else PARTS[values.shape[1]]
                columns |= {f'{channel}_{part}': values[:, k] for k, part in enumerate(parts)}
            return frame(one.t, columns)

        if series is not None:
            return recorded(known[series])
        t, distance, angle = target_errors(self)
        made = frame(motion(self).t, {})
        for each in (*(recorded(getattr(self, name)).add_prefix(f'{name}_') for name in SERIES
                       if len(getattr(self, name))),
                     frame(self.state_t, {'state': list(map(str, self.states))}),
                     frame(t, {'error_m': distance, 'error_deg': angle})):
            made = pandas.merge_asof(made, each, left_index=True, right_index=True)
        return made

    def report(self, path: str | Path) -> Path:
        """Write the page of `beetle_omni report`, and return its path."""
        runs = make_runs({self._name(): self})
        write_text(Path(path), make_page(runs, results_of(runs)), 'report')
        return Path(path)

    def _name(self):
        """Label of the flight; a ParameterError refuses one without poses."""
        if not len(motion(self)):
            raise ParameterError(f'{self.source}: no pose of the robot; expected '
                                 'ground_truth/odom or odom')
        return Path(self.source).name or ', '.join(self.controllers()) or 'flight'

    def __repr__(self) -> str:
        """Describe the flight in five lines."""
        found, meta = self.metrics(), self.meta
        began = datetime.fromtimestamp(self.epoch, timezone.utc)
        errors = [number(value, digits) for value, digits in zip(
            found['mean'].values(), (4, 2, 3, 2), strict=True)]
        result = 'poses reached {}; U {} m, {} deg; L {} m, {} deg'.format(
            table.reached(found), *errors)
        if path := found.get('trajectory'):
            result = 'path error {} m, {} deg'.format(
                number(path['position_mean_m'], 4), number(path['orientation_mean_deg'], 2))
        ended = f"; ended early: {found['ended']}" if 'ended' in found else ''
        return '\n'.join((
            f"flight of {', '.join(self.controllers())}: {table.title(meta) or 'no metadata'}",
            f"{self.end:.1f} s from {began:%Y-%m-%d %H:%M:%S} UTC, {self.source or 'in memory'}",
            result,
            f"alarms {table.alarms(found)}; warnings {'; '.join(self.warnings) or 'none'}{ended}",
            'series ' + ', '.join(f'{name} {len(getattr(self, name))}' for name in SERIES
                                  if len(getattr(self, name)))))
