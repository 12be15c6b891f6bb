"""`beetle_omni report`: a page with several runs side by side; a flight in a notebook."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
import sys
from typing import Any

import numpy as np
from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.bags.bag import read_flights
from beetle_omni_ros.bags.log import FlightLog, hold, motion, SERIES, Series, target_errors
from beetle_omni_ros.bags.metrics import metrics, metrics_by_controller
from beetle_omni_ros.control.tasks import Task
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.schema import shortened
from beetle_omni_ros.show import charts, table
from beetle_omni_ros.show.charts import MAX_RUNS, Run
from beetle_omni_ros.show.figures import colours_of
from beetle_omni_ros.show.page import Grid, number, print_end, rendered, Terminal
from beetle_omni_ros.show.recorded import recorded_scene

MOST_ROWS = 40      # of states, faults and warnings
LEVELS = {1: 'warning', 2: 'error', 3: 'stale'}     # of diagnostics


def run_report(paths: list[Path], output: Path, *, json_path: Path | None = None,
               full: bool = False, console: Console | None = None) -> dict:
    """
    Read runs, print their result table, write the page; return :func:`results_of` the runs.

    ``paths`` are bags, or folders of bags. A ParameterError reports a run that cannot be read, too
    many runs, or a page that cannot be written.
    """
    console = console or Terminal()
    runs = make_runs(read_flights(paths, MAX_RUNS))
    results = results_of(runs)
    page = make_page(runs, results)
    for run in runs:
        for warning in run.log.warnings:
            print(f'{run.log.source}: {warning}', file=sys.stderr)
    table.print_results(results, console, full=full)
    write_text(output, page, 'report')
    write_json(json_path, results)
    print_end(console, [output, json_path], f'open {output} in a browser', ('view', *paths))
    return results


def make_runs(logs: dict[str, FlightLog]) -> list[Run]:
    """Compute the metrics of flights; give each the colour of its controller."""
    runs = []
    for (name, log), colour in zip(logs.items(), colours_of(logs.values()), strict=True):
        found = metrics_by_controller(log)
        runs.append(Run(name, colour, log, {
            f'{name}: {key}' if len(found) > 1 else name: result
            for key, result in found.items()}))
    return runs


def results_of(runs: list[Run]) -> dict:
    """Return the results of all runs as in ``evaluate --json``; meta: their common metadata."""
    first, *others = [run.log.meta for run in runs]
    shared = {key: value for key, value in first.items()
              if all(meta.get(key) == value for meta in others)}
    results: dict = {'meta': {**shared, 'version': __version__}}
    for run in runs:
        results.update(run.results)
    return results


def make_page(runs: list[Run], results: dict) -> str:
    """Return the HTML of the page."""
    grids, meta = table.grids(results, full=True), results['meta']
    return rendered(
        'report.html', title='Flight report', cards=map(_card, runs), charts=charts.html(runs),
        subtitle=', '.join(filter(None, [table.title(meta),
                                         f"beetle_omni_ros {meta['version']}"])),
        tables=[grid for grid in grids if not grid.title.startswith('Poses')],
        poses=[grid for grid in grids if grid.title.startswith('Poses')],
        scene=recorded_scene({run.label: run.log for run in runs}),
        faults=[grid for run in runs for grid in _faults(run) if grid.rows])


def _card(run):
    """The run, facts about it and warnings."""
    log, meta = run.log, run.log.meta
    facts = [', '.join(log.controllers()), *(f'{key} {meta[key]}' for key in
             ('task', 'conditions', 'seed', 'robot', 'plant') if meta.get(key) is not None),
             f'{log.end - log.start:.0f} s', log.source]
    injected = meta.get('faults') or []
    injected = injected if isinstance(injected, list) else [injected]
    named = [f'fault: {shortened(name)} at {at - log.begin:.2f} s'
             for name, at in log.named_faults().items()]
    return run, facts, [*(f'injected: {shortened(str(fault))}' for fault in injected[:MOST_ROWS]),
                        *named[:MOST_ROWS], *log.warnings]


def _faults(run):
    """Tables of warnings of the nodes, and of rejected messages."""
    told: dict[tuple, list] = {}
    last: dict[str, dict] = {}
    for entry in run.log.diagnostics:
        last[entry.name] = entry.values
        if entry.level > 0:
            told.setdefault((entry.name, entry.level, entry.message), []).append(entry.t)
    warnings = [[name, LEVELS.get(level, str(level)), message,
                 f'{times[0] - run.log.begin:.1f}', str(len(times))]
                for (name, level, message), times in told.items()]
    rejected = [[name, key, value] for name, values in last.items()
                for key, value in values.items()
                if ('reject' in key or 'refused' in key) and value not in ('0', '0.0', '', '{}')]
    return (Grid(f'{run.label}: warnings and errors',
                 ['node', 'level', 'text', 'first at [s]', 'reports'], warnings[:MOST_ROWS]),
            Grid(f'{run.label}: rejected', ['node', 'reason', 'count'], rejected[:MOST_ROWS]))


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
