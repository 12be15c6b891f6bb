"""The comparison as one self-contained HTML page, and as Markdown with pictures."""

from base64 import b64encode
from io import BytesIO

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
import numpy as np
from PIL import Image

from beetle_omni_ros.bags.metrics import L_WINDOW, U_WINDOW
from beetle_omni_ros.control.tasks import make_task, POSE_DURATION, RISING, TILTS
from beetle_omni_ros.flight import summary
from beetle_omni_ros.show import figures
from beetle_omni_ros.show.figures import FAINT, INK, legend, panels
from beetle_omni_ros.show.page import ABSENT, Grid, number
from beetle_omni_ros.show.table import TEXTS

# --- figures of the results of one task under one set of conditions ------------------------------

FLOOR = {'position': 2e-4, 'orientation': 1e-2}  # of logarithmic errors [m], [deg]
UNITS = {'position': 'm', 'orientation': 'deg'}
STEP = 0.05  # [s] between points of a folded curve
BEFORE = 2.0  # [s] of hover shown before the first disturbance
LEVELS = {'force': 'force [N]', 'torque': 'torque [N m]', 'wind': 'wind [m/s]',
          'pushes': 'number of the push', 'payload': 'payload [kg]'}     # on the right axis
SHOWN = {'position': 2.0, 'orientation': 180.0}  # largest limit of a disturbance's axes [m], [deg]

Groups = dict[str, list[dict]]      # controller -> one result with a trace for each seed


def convergence(groups: Groups, task: str) -> Figure:
    """Errors in the 8 s of a pose: median and 10 to 90 % band over all poses."""
    figure, axes = panels(1, 2, height=2.8)
    grid = np.arange(0.0, POSE_DURATION, STEP)
    for k, (name, results) in enumerate(groups.items()):     # the first is on top
        style = summary.look(name)
        for panel, (what, floor) in zip(axes[0], FLOOR.items(), strict=True):
            folded = _folded(results, f'{what}_error', grid)
            if not len(folded):
                continue
            low, middle, high = np.maximum(np.percentile(folded, (10, 50, 90), axis=0), floor)
            panel.fill_between(grid, low, high, color=style.colour, alpha=0.13, lw=0)
            panel.plot(grid, middle, color=style.colour, ls=style.dashes, lw=1.7,
                       label=style.label, zorder=3 - k / len(groups))
    for panel, what in zip(axes[0], FLOOR, strict=True):
        for window, colour, name in ((L_WINDOW, '#eef1f5', 'L'), (U_WINDOW, '#d5e6d9', 'U')):
            panel.axvspan(*window, color=colour, lw=0, zorder=0)
            panel.text(np.mean(window), 0.985, name, transform=panel.get_xaxis_transform(),
                       va='top', ha='center', color=FAINT, fontsize=8)
        panel.set_yscale('log')
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
        panel.set_xlim(0, POSE_DURATION)
        panel.set_ylabel(f'{what} error [{UNITS[what]}]')
        panel.set_xlabel('time since the pose was asked for [s]')
    legend(figure, axes[0, 0])
    return figure


def _folded(results, key, grid):
    """(P, len(grid)) errors of each pose that was flown to its end."""
    rows = []
    for result in results:
        t, values = result['trace']['t'], result['trace'][key]
        for k in range(len(result['metrics']['poses'])):
            inside = (t >= k * POSE_DURATION - 1e-3) & (t < (k + 1) * POSE_DURATION - 1e-3)
            if np.any(inside) and t[inside][-1] >= k * POSE_DURATION + U_WINDOW[1]:
                rows.append(np.interp(grid, t[inside] - k * POSE_DURATION, values[inside]))
    return np.array(rows)


def in_time(groups: Groups, task: str) -> Figure:
    """Errors of the first flights over time, with the disturbance dashed as in the publication."""
    flown = make_task(task)
    figure, axes = panels(2, height=2.1, sharex=True)
    for panel, what in zip(axes[:, 0], SHOWN, strict=True):
        if flown.kind in LEVELS:
            _levels(panel, flown)
        highest = max(_error_curve(panel, results[0], what, name, 3 - k / len(groups))
                      for k, (name, results) in enumerate(groups.items()))
        panel.set_ylim(0, min(1.08 * highest, SHOWN[what]) or 1)
        panel.set_ylabel(f'{what} error [{UNITS[what]}]')
    axes[1, 0].set_xlim(POSE_DURATION - BEFORE, flown.duration)
    axes[1, 0].set_xlabel('time since the hover was asked for [s]')
    legend(figure, axes[0, 0])
    return figure


def _levels(panel, task):
    """Plot the level of the disturbance on an axis to the right."""
    right, name = panel.twinx(), LEVELS[task.kind]
    levels = [segment.level for segment in task.segments]
    style = {'color': INK, 'lw': 1.1, 'ls': (0, (4, 2.5))}
    right.step([0.0, *task.ends], [*levels, levels[-1]], where='post', **style)
    right.set_ylim(0, max(levels) * 1.15)
    right.set_ylabel(name)
    right.grid(False)
    right.spines['right'].set_visible(True)
    panel.plot([], [], label=f'{name} (right axis)', **style)
    panel.set_zorder(right.get_zorder() + 1)
    panel.patch.set_visible(False)


def _error_curve(panel, result, what, name, height):
    """Plot one flight's errors, mark lost control, and return the largest error."""
    style, trace = summary.look(name), result['trace']
    t, values = trace['t'], trace[f'{what}_error']
    panel.plot(t, values, color=style.colour, ls=style.dashes, lw=1.5, label=style.label,
               zorder=height)
    if any(result['metrics'].get(kind, {}).get(f'lost_at_{unit}') is not None
           for kind, unit in (('force', 'N'), ('torque', 'N_m'))):
        last = np.flatnonzero(np.isfinite(values))[-1:]
        panel.plot(t[last], np.minimum(values[last], SHOWN[what] * 0.98), marker='X', ms=8,
                   color=style.colour, mec='white', mew=0.8, ls='', zorder=6, clip_on=False)
    shown = values[(t > POSE_DURATION - BEFORE) & np.isfinite(values)]
    return float(np.max(shown)) if shown.size else 0.0


_POSES = [('convergence', 'Errors after a pose was asked for: median and 10 to 90 % band',
           convergence)]
_TIME = [('errors', 'Errors in time in the first flight, the disturbance dashed; × where control '
          'was lost', in_time)]
# Kind of a task -> name, caption and function of each figure.
DRAWN = {'random': _POSES, 'poses': _POSES, **dict.fromkeys(
    (*RISING, *TILTS, 'wind', 'pushes', 'payload'), _TIME)}


# --- page ----------------------------------------------------------------------------------------

DOTS = 180  # per inch
COLOURS = 128  # of a picture; enough for thin lines with smooth edges
TITLE = 'RL and NMPC under one architecture'
COMPUTED = ('"0.3 on average"', '"typically within 10"')    # published times of a step
NOTES = {**TEXTS['notes'], **{
    name: TEXTS['notes']['rising'].format(
        kind.capitalize(), 'xyz'[int(np.flatnonzero(direction)[0]) % 3], *times)
    for name, (kind, direction, _, *times) in RISING.items()}}


def interval(entry: dict, digits: int) -> str:
    """Text of a mean and its interval."""
    text = number(entry['mean'], digits)
    return text if entry['low'] is None else \
        f"{text} [{number(entry['low'], digits)}, {number(entry['high'], digits)}]"


def table(results: dict, task: str, conditions: str, brief: bool = False) -> Grid:
    """Every metric of a task: mean with interval, unless brief also differences and ranges."""
    numbers = results['summary']['tasks'][task][conditions]
    ours = [name for name in results['meta']['controllers'] if name in numbers['flights']]
    kind = summary.kind_of(task)
    paper = list(summary.PUBLISHED) if kind in summary.PRINTED else []
    rows: list[list[str]] = []
    best: set[tuple[int, int]] = set()
    for key, metric in summary.METRICS[kind].items():
        of = numbers['metrics'][key]
        given = [summary.printed(task, metric, name) for name in paper]
        most = max(of[name]['count'] for name in ours)
        best |= {(len(rows), column) for column, name in enumerate(ours, 1) if of[name]['best']}
        rows.append([metric.title, *(
            interval(of[name], metric.digits)
            + f" of {of[name]['count']}" * (0 < of[name]['count'] < most) for name in ours),
            *(number(entry.get('mean'), None)
              + (f" ± {number(entry['std'], None)}" if entry.get('std') else '')
              for entry in given)])
        if len(ours) > 1 and not brief:
            rows.append(['difference to the best', *(
                ABSENT if of[name]['difference'] is None
                else interval(of[name]['difference'], metric.digits) for name in ours),
                *(ABSENT for _ in paper)])
        if kind in ('random', 'poses') and most > len(numbers['flights'][ours[0]]['seeds']) \
                and not metric.more and not brief:
            rows.append(['least to largest', *(
                f"{number(entry.get('min'), digits)} to {number(entry.get('max'), digits)}"
                if entry.get('min') is not None else ABSENT for entry, digits in (
                    *((of[name], metric.digits) for name in ours),
                    *((entry, None) for entry in given)))])
    if kind not in RISING:
        rows.append(['flights that crashed', *(
            '{} of {}'.format(numbers['flights'][name]['lost'],
                              len(numbers['flights'][name]['seeds'])) for name in ours),
            *(ABSENT for _ in paper)])
    seeds = sorted({seed for name in ours for seed in numbers['flights'][name]['seeds']})
    real = 'real robot' if summary.PRINTED.get(kind, (0, False))[1] else 'Gazebo'
    return Grid(
        f'{summary.task_title(task)}, {conditions} conditions',
        ['', *(summary.look(name).label for name in ours),
         *(f'{summary.look(name).label} (published, {real})' for name in paper)],
        rows, best=frozenset(best), faint_columns=frozenset(range(len(ours) + 1, len(rows[0]))),
        note=' '.join([f"Seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}.",
                       *([] if brief else [NOTES['intervals'].format(
                           ' and pose' * (kind in ('random', 'poses')))]), NOTES[kind]]))


def glance(results: dict) -> Grid:
    """Every experiment in one table."""
    ours = results['meta']['controllers']
    rows: list[list[str]] = []
    best = set()
    for task, by_conditions in results['summary']['tasks'].items():
        real = ' *' * summary.PRINTED.get(summary.kind_of(task), (0, False))[1]
        for conditions, numbers in by_conditions.items():
            for key, metric in summary.METRICS[summary.kind_of(task)].items():
                if not metric.glance:
                    continue
                of = numbers['metrics'][key]
                best |= {(len(rows), k) for k, name in enumerate(ours, 1)
                         if name in of and of[name]['best']}
                given = [summary.printed(task, metric, name) if conditions == 'nominal' else {}
                         for name in summary.PUBLISHED]
                rows.append([f'{summary.task_title(task)}, {conditions}: {metric.title}', *(
                    number(of[name]['mean'], metric.digits) if name in of else ABSENT
                    for name in ours), *(
                    number(entry.get('mean'), None) + real * bool(entry) for entry in given)])
    rows.append(['CPU time of a step: median [ms]', *(
        number(results['summary']['compute_ms'].get(name), 3) for name in ours),
        *(f'{text} *' for text in COMPUTED)])
    return Grid('All experiments', [
        '', *(summary.look(name).label for name in ours),
        *(f'{summary.look(name).label} (published)' for name in summary.PUBLISHED)], rows,
        note=NOTES['glance'], best=frozenset(best),
        faint_columns=frozenset(range(len(ours) + 1, len(ours) + len(summary.PUBLISHED) + 1)))


def sections(results: dict, flown: dict) -> list[dict]:
    """
    Pictures and tables of all flights.

    Args:
        results: content of the JSON file.
        flown: flights and their results with traces.

    Returns:
        Sections with ``title``, ``text`` and ``blocks``, tables and pictures in their order. A
        picture is the ``data`` of a PNG, its ``name`` and ``caption``, and ``source`` of an <img>.

    """
    made = [{'title': 'At a glance', 'text': '', 'blocks': [glance(results)]}]
    with matplotlib.rc_context(figures.STYLE):
        for task, by_conditions in results['summary']['tasks'].items():
            blocks: list[Grid | dict] = []
            for conditions in by_conditions:
                blocks.append(table(results, task, conditions))
                groups: Groups = {}
                for flight, result in flown.items():
                    if (flight.task, flight.conditions) == (task, conditions) and result['trace']:
                        groups.setdefault(flight.controller, []).append(result)
                for name, caption, draw in DRAWN.get(summary.kind_of(task), ()):
                    if groups and (figure := draw(groups, task)):
                        data = png(figure)
                        blocks.append({
                            'name': f'{summary.kind_of(task)}_{name}_{conditions}', 'data': data,
                            'caption': f'{caption} ({conditions} conditions)',
                            'source': f'data:image/png;base64,{b64encode(data).decode()}'})
            made.append({'title': summary.task_title(task), 'blocks': blocks,
                         'text': TEXTS['texts'].get(summary.kind_of(task), '')})
    return made


def png(figure: Figure) -> bytes:
    """Figure as PNG with few colours, a third of the full size."""
    buffer, small = BytesIO(), BytesIO()
    figure.savefig(buffer, format='png', dpi=DOTS)
    Image.open(buffer).convert('RGB').quantize(COLOURS, dither=Image.Dither.NONE).save(
        small, format='png', optimize=True)
    return small.getvalue()


def content(results: dict, made: list[dict]) -> dict:
    """What the pages show: sections, brief tables by title, terms, facts, flights."""
    meta = results['meta']
    terms = []
    for name in meta['controllers']:
        what = summary.look(name).text or meta['specs'].get(name, '')
        terms.append((summary.look(name).label, f"{what}; guidance: {meta['guidance'][name]}"))
    terms += [(f'{name} conditions', TEXTS['conditions'][name]) for name in meta['conditions']]
    terms += [(f'{name}: not flown', reason) for name, reason in meta['skipped'].items()]
    failed = sum(bool(flight['failure']) for flight in results['flights'])
    facts = [f"beetle_omni_ros {meta['version']}"
             + (f", commit {meta['commit']}" if meta.get('commit') else ''),
             f"{len(results['flights'])} flights, {failed} failed; seeds "
             f"{', '.join(map(str, meta['seeds']))}",
             f"{meta['cpu_s'] / 60:.1f} core minutes on {meta['processor']}",
             *([f"simulated plant: {meta['plant']}"] if meta['plant'] else []),
             *(f'{summary.look(name).label}: policy {digest}'
               for name, digest in meta['policies'].items())]
    flights = Grid('', ['task', 'conditions', 'controller', 'seed', 'end', 'core s'], [
        [flight['task'], flight['conditions'], flight['controller'], str(flight['seed']),
         flight['failure'] or flight['metrics'].get('ended')
         or ('touched the ground' if flight['metrics']['crashed'] else 'flown'),
         number(flight['cpu_s'], 1)] for flight in results['flights']])
    brief = [table(results, task, conditions, brief=True)
             for task, shown in results['summary']['tasks'].items() for conditions in shown]
    return {'title': TITLE, 'terms': terms, 'facts': facts, 'sections': made, 'flights': flights,
            'brief': {grid.title: grid for grid in brief}, 'command': meta['command']}
