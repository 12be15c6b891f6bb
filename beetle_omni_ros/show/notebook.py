"""A flight in a notebook: metrics, charts, table, page; times start at 0."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from beetle_omni_ros.bags.log import FlightLog, hold, motion, SERIES, Series, target_errors
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control.tasks import Task
from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.show import charts, table
from beetle_omni_ros.show.figures import colours_of
from beetle_omni_ros.show.page import number
from beetle_omni_ros.show.report import make_page, make_runs, results_of

PARTS = {0: ('',), 3: 'xyz', 4: '1234'}      # of a channel by its width


@dataclass(repr=False, eq=False)
class NotebookLog(FlightLog):
    """
    A :class:`~beetle_omni_ros.bags.log.FlightLog` whose times start at 0, its first sample.

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

        def moved(**series):    # UNIX time as a float has a resolution of 0.24 us
            return {name: np.round(values - start, 6) if name in ('t', 'received', 'state_t')
                    else values for name, values in series.items()}

        return cls(**{
            **moved(**vars(log)),
            **{name: Series(**moved(**vars(getattr(log, name)))) for name in SERIES},
            'requests': {name: Series(**moved(**vars(one))) for name, one in log.requests.items()},
            'targets': [target.delayed(-start) for target in log.targets],
            'compute_history': {name: [(t - start, report) for t, report in reports]
                                for name, reports in log.compute_history.items()},
            'diagnostics': [replace(entry, t=entry.t - start) for entry in log.diagnostics]},
            task=task, epoch=start)

    def metrics(self) -> dict:
        """Return the numbers of a controller in `evaluate --json` (docs/reference/metrics.md)."""
        return metrics(self, self.task)

    def plot(self, *names: str) -> Any:
        """Return a plotly figure of all charts, or of those whose titles begin with a name."""
        return charts.figure([charts.Run(self._name(), *colours_of([self]), self, {})], *names)

    def to_pandas(self) -> Any:
        """
        Return a pandas.DataFrame over the time ``t`` [s]; needs the extra ``notebook``.

        A row for each sample of ``truth``, without it of ``odom``. Columns such as
        ``odom_position_x`` have the newest value of each series, ``state`` that of the supervisor;
        ``error_m`` and ``error_deg`` are the distances from the target.
        """
        import pandas
        found = {'state': (self.state_t, np.array(list(map(str, self.states)), dtype=object))}
        for name, (_, channels) in SERIES.items():
            series = getattr(self, name)
            for channel, width in channels.items():
                parts = 'xyzw' if channel == 'quaternion' else PARTS[width]
                values = np.atleast_2d(getattr(series, channel).T)
                found |= {'_'.join(filter(None, (name, channel, part))): (series.t, column)
                          for part, column in zip(parts, values, strict=True)}
        t, *errors = target_errors(self)
        found |= {f'error_{unit}': (t, error) for unit, error in zip(('m', 'deg'), errors)}
        rows = motion(self).t
        return pandas.DataFrame({
            name: np.where(rows >= times[0], hold(times, values, rows), np.nan)
            for name, (times, values) in found.items() if len(times)},
            index=pandas.Index(rows, name='t'))

    def report(self, path: str | Path) -> Path:
        """Write the page of `beetle_omni report`, and return its path."""
        runs = make_runs({self._name(): self})
        write_text(Path(path), make_page(runs, results_of(runs)), 'report')
        return Path(path)

    def _name(self):
        return Path(self.source).name or ', '.join(self.controllers()) or 'flight'

    def __repr__(self) -> str:
        """Describe the flight in five lines."""
        found = self.metrics()
        path, ended = found.get('trajectory'), found.get('ended')
        result = 'path error {} m, {} deg'.format(
            number(path['position_mean_m'], 4), number(path['orientation_mean_deg'], 2)) if path \
            else 'poses reached {}; U {} m, {} deg; L {} m, {} deg'.format(
                table.reached(found), *map(number, found['mean'].values(), (4, 2, 3, 2)))
        return '\n'.join((
            f"flight of {', '.join(self.controllers())}: {table.title(self.meta)}",
            f'{self.end:.1f} s from {datetime.fromtimestamp(self.epoch, timezone.utc):%F %T} UTC, '
            f"{self.source or 'in memory'}",
            result + f'; ended early: {ended}' * bool(ended),
            f"alarms {table.alarms(found)}; warnings {'; '.join(self.warnings) or 'none'}",
            'series ' + ', '.join(f'{name} {len(getattr(self, name))}' for name in SERIES
                                  if len(getattr(self, name)))))
