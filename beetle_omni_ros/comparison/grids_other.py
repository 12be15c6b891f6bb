"""More tables: payload, hover, compute times, everything at a glance, and all flights."""

from __future__ import annotations

from html import escape

from beetle_omni_ros.comparison.grid import Cell, Column, Grid, Number, OURS, REAL
from beetle_omni_ros.comparison.grids import lost, PAPER, reached, Task
from beetle_omni_ros.comparison.style import task_title


def payload(results: dict, conditions: str) -> Grid:
    """Steady errors against the mass attached."""
    task = Task(results, 'payload', conditions)
    entries = task.first('payload')
    rows = []
    for k, entry in enumerate(entries):
        mass = f"{entry['payload_kg']:g} kg"
        rows.append(task.row(f'{mass}: height error [m]', _signed(task, k),
                             best=('payload', k, 'height_error_m', 'mean')))
    rows += [task.row(f"{entry['payload_kg']:g} kg: orientation error [deg]",
                      task.mean_range('payload', k, 'orientation_deg', digits=2),
                      best=('payload', k, 'orientation_deg', 'mean'))
             for k, entry in enumerate(entries)]
    return task.grid(
        'Payload attached below the body, steady errors', rows,
        ['Mean over 7.0 to 7.5 s after the mass was attached [least, largest of the seeds]; '
         'positive: above the target. The publication shows its real robot in a figure without '
         'numbers, with 1.0 kg for RL only.'])


def _signed(task, k):
    keys = ('payload', k, 'height_error_m')

    def cell(name):
        if task.value(name, *keys, 'mean') is None:
            return Cell()
        low, high = (task.number(name, *keys, end, digits=4) for end in ('min', 'max'))
        several = low.value(task.results) != high.value(task.results)
        return Cell([task.number(name, *keys, 'mean', digits=4)],
                    ['[', low, ', ', high, ']'] if several else [])
    return cell


def hover(results: dict, conditions: str) -> Grid:
    """How still and how smooth a hover of one minute is."""
    task = Task(results, 'hover', conditions)
    rows = [task.row('position error ± std [m]',
                     task.mean_std('hover', 'position_m', digits=4),
                     best=('hover', 'position_m', 'mean')),
            task.row('orientation error ± std [deg]',
                     task.mean_std('hover', 'orientation_deg', digits=3),
                     best=('hover', 'orientation_deg', 'mean')),
            task.row('tilt command change in 10 ms, RMS [rad]',
                     task.plain('command_change_rms', 'joint_rad', digits=5),
                     best=('command_change_rms', 'joint_rad')),
            task.row('thrust command change in 10 ms, RMS [N]',
                     task.plain('command_change_rms', 'thrust_N', digits=4),
                     best=('command_change_rms', 'thrust_N'))]
    return task.grid('Steady hover at [0, 0, 1] m', rows,
                     ['Errors from 8 s to the end of 60 s; command changes from 7.0 to 7.5 s.'])


def compute(results: dict) -> Grid:
    """CPU time of a step of each controller."""
    ours = [name for name in results['meta']['controllers']
            if name in results['summary']['compute']]

    def number(name, key, digits):
        return Number(('summary', 'compute', name, key), digits)

    rows = []
    for text, key, digits in (('median [ms]', 'median', 3), ('99th percentile [ms]', 'p99', 2),
                              ('largest [ms]', 'max', 2), ('over 10 ms', 'deadline_misses', 0),
                              ('steps', 'steps', 0)):
        published = {'median': ['"0.3 on average"', '"typically within 10"'],
                     'deadline_misses': ['–', '"occasionally"']}.get(key, ['–', '–'])
        rows.append((text, [*(Cell([number(name, key, digits)]) for name in ours),
                            *(Cell([part]) for part in published)]))
    columns = [*(Column(name, 'ours, on this computer') for name in ours),
               *(Column(name, REAL) for name in PAPER)]
    machine = results['meta'].get('machine', {})
    return Grid('CPU time of one controller step', columns, rows, [
        'Everything a controller does for one command, over all flights of this page: median of '
        "the flights' medians, otherwise the worst flight. One core each, while the other cores "
        f"fly too ({machine.get('processor', 'unknown processor')}). Published times: on the "
        "robot's ARM board; its RL number is the inference alone."])


def glance(results: dict) -> Grid:
    """Every experiment in one table."""
    tasks = results['summary']['tasks']
    ours = results['meta']['controllers']
    columns = [*(Column(name, OURS) for name in ours),
               *(Column(name, 'published') for name in PAPER)]
    rows = []
    for name, by_conditions in tasks.items():
        for conditions in (c for c in by_conditions if c != 'paper'):
            task = Task(results, name, conditions)
            for text, cell, real in _glance_rows(task, conditions):
                cells = [cell(c) if c in task.ours else Cell() for c in ours]
                for column in PAPER:
                    known = conditions == 'nominal'
                    published = cell(column) if column in task.paper and known else Cell()
                    if real and column in task.paper and known:
                        published = Cell(published.main, [*published.small, ' real robot'])
                    cells.append(published)
                rows.append((f'{task_title(name)}, {conditions}: {text}', cells))
    return Grid('All experiments', columns, rows, [
        'Published numbers are of Gazebo, or of the real robot where marked; ours are '
        'simulated. The tables below say more.'])


def _glance_rows(task, conditions):
    """(text, cell builder, whether published on the real robot) for a task."""
    if task.task == 'lemniscate':
        return [('mean error [m] / [deg]', _pair(
            task, ('trajectory', 'position_m', 'mean'),
            ('trajectory', 'orientation_deg', 'mean')), True)]
    if task.task in ('force', 'torque'):
        unit = 'N' if task.task == 'force' else 'N m'
        return [('control lost at', lost(task, task.task, unit), False)]
    if task.task == 'payload':
        return [('largest height error up to 1 kg [m]',
                 task.plain('payload_height_max_m', digits=4), False)]
    if task.task == 'hover':
        return [('command change in 10 ms, RMS [rad] / [N]', _pair(
            task, ('command_change_rms', 'joint_rad'), ('command_change_rms', 'thrust_N')),
            False)]
    real = task.task == 'waypoints'
    made = [('U, mean [m] / [deg]', _pair(task, ('U_position_m', 'mean'),
                                          ('U_orientation_deg', 'mean')), real)]
    if not real:
        made += [('L, mean [m] / [deg]', _pair(task, ('L_position_m', 'mean'),
                                               ('L_orientation_deg', 'mean')), False),
                 ('poses reached', reached(task), False)]
    return made


def _pair(task, first, second):
    def cell(name):
        if task.value(name, *first) is None:
            return Cell()
        return Cell([task.number(name, *first, digits=4), ' / ',
                     task.number(name, *second, digits=2 if 'deg' in ''.join(map(str, second))
                                 else 4)])
    return cell


def flights(results: dict) -> str:
    """Every flight as rows of HTML: what, how it ended, how long it took."""
    rows = []
    for k, flight in enumerate(results['flights']):
        end = flight['failure'] or ('touched the ground' if flight['metrics']['crashed']
                                    else 'flown')
        rows.append((k, flight, end))
    return ''.join(
        f"<tr><td>{escape(flight['task'])}</td><td>{escape(flight['conditions'])}</td>"
        f"<td>{escape(flight['controller'])}</td><td>{flight['seed']}</td>"
        f"<td>{escape(end)}</td><td><span data-key=\"flights/{k}/cpu_s\">"
        f"{Number(('flights', k, 'cpu_s'), 1).text(results)}</span></td></tr>\n"
        for k, flight, end in rows)
