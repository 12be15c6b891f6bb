"""Result tables: one content, shown in the terminal, as Markdown and as HTML."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

from rich.console import Console
from rich.table import Table

from beetle_omni_ros.runs import published

MANY_POSES = 20  # above, only the summary is shown
ABSENT = '–'


@dataclass(frozen=True)
class Grid:
    """
    A table of text.

    Attributes:
        title: one line.
        header: of the columns.
        rows: their cells.
        faint: indices of rows that are not ours but published.

    """

    title: str
    header: list[str]
    rows: list[list[str]]
    faint: frozenset[int] = frozenset()


def grids(results: dict, *, with_poses: bool | None = None) -> list[Grid]:
    """
    Tables of a result as INTERFACES lays it out: ``meta`` and one key for each controller.

    Args:
        results: of ``evaluate``, ``fly`` or ``report``; keys other than ``meta`` are labels.
        with_poses: show every pose; by default where there are no more than 20.

    """
    task = str(results.get('meta', {}).get('task', ''))
    judged = {name: result for name, result in results.items() if name != 'meta'}
    made = [_summary(judged, task), _effort(judged, task)]
    if any('trajectory' in result for result in judged.values()):
        made.append(_tracking(judged, task))
    for kind, unit in (('force', 'N'), ('torque', 'N_m')):
        if any(kind in result for result in judged.values()):
            made.append(_levels(judged, kind, unit))
    if any('payload' in result for result in judged.values()):
        made.append(_payloads(judged))
    if any('hover' in result for result in judged.values()):
        made.append(_hover(judged))
    most = max((len(result['poses']) for result in judged.values()), default=0)
    if with_poses or (with_poses is None and 1 < most <= MANY_POSES):
        made.append(_poses(judged))
    return made


def _summary(judged, task):
    header = ['', 'U position [m]', 'U orientation [deg]', 'L position [m]',
              'L orientation [deg]', 'reached', 'crashed']
    rows = []
    for name, result in judged.items():
        reached = [pose['reached'] for pose in result['poses']]
        rows.append([name, *_error_cells(result), f'{sum(reached)} of {len(reached)}',
                     'yes' if result['crashed'] else 'no'])
    ours = len(rows)
    rows += [[f'published {name}', *_error_cells(result), ABSENT, ABSENT]
             for name, result in published.pose_results(task).items()]
    return Grid('Pose errors, mean (max): U hovering at 7.0 to 7.5 s, L on the way at 1.0 to 7.0 s',
                header, rows, frozenset(range(ours, len(rows))))


def _error_cells(result):
    cells = []
    for key, digits in (('U_position_m', 4), ('U_orientation_deg', 2), ('L_position_m', 3),
                        ('L_orientation_deg', 2)):
        mean = _number(result['mean'].get(key), digits)
        worst = _number(result['max'].get(key), digits)
        cells.append(ABSENT if mean == ABSENT else f'{mean} ({worst})')
    return cells


def _effort(judged, task):
    header = ['', '|q* - q| [rad]', 'thrust [N]', 'hover |v| [m/s]', 'hover |w| [rad/s]',
              'command change [rad], [N]', 'CPU median / p99 / max [ms]', 'deadline misses']
    rows = []
    for name, result in judged.items():
        change = result['hover_command_change_rms']
        compute = result['compute_ms']
        times = ' / '.join(_number(compute[key], 2) for key in ('median', 'p99', 'max'))
        misses = compute['deadline_misses']
        rows.append([name, *_effort_cells(result),
                     f"{_number(change['joint_rad'], 4)}, {_number(change['thrust_N'], 3)}",
                     times, ABSENT if misses is None else str(misses)])
    ours = len(rows)
    rows += [[f'published {name}', *_effort_cells(result), ABSENT, ABSENT, ABSENT]
             for name, result in published.pose_results(task).items() if 'thrust_mean_N' in result]
    return Grid('Effort and timing', header, rows, frozenset(range(ours, len(rows))))


def _effort_cells(result):
    return [_number(result.get(key), 3) for key in
            ('joint_error_mean_rad', 'thrust_mean_N', 'hover_speed_mean_m_s',
             'hover_angular_speed_mean_rad_s')]


def _tracking(judged, task):
    header = ['', 'round', 'position mean ± std (max) [m]', 'orientation mean ± std (max) [deg]']
    rows = []
    for name, result in judged.items():
        tracking = result.get('trajectory')
        if not tracking:
            continue
        for k, part in enumerate(tracking['rounds']):
            rows.append([name, str(k + 1), *_tracking_cells(part)])
        rows.append([name, 'all', *_tracking_cells(tracking)])
    ours = len(rows)
    rows += [[f'published {name}', 'all', *_tracking_cells(part)]
             for name, part in published.tracking_results(task).items()]
    return Grid('Trajectory tracking', header, rows, frozenset(range(ours, len(rows))))


def _tracking_cells(part):
    cells = []
    for name, unit, digits in (('position', 'm', 3), ('orientation', 'deg', 2)):
        mean, std, worst = (_number(part.get(f'{name}_{what}_{unit}'), digits)
                            for what in ('mean', 'std', 'max'))
        cells.append(f'{mean} ± {std} ({worst})' if worst != ABSENT else f'{mean} ± {std}')
    return cells


def _levels(judged, kind, unit):
    text = unit.replace('_', ' ')
    header = [f'{kind} [{text}]'] + [f'{name}: {what}' for name in judged
                                     for what in ('peak position [m]', 'peak orientation [deg]')]
    steps = sorted({entry[f'level_{unit}'] for result in judged.values()
                    for entry in result.get(kind, {}).get('levels', [])})
    rows = []
    for step in steps:
        row = [f'{step:g}']
        for result in judged.values():
            entry = next((e for e in result.get(kind, {}).get('levels', [])
                          if e[f'level_{unit}'] == step), None)
            row += [_number(entry['peak_position_m'], 3) + (' lost' if entry['lost'] else ''),
                    _number(entry['peak_orientation_deg'], 1)] if entry else [ABSENT, ABSENT]
        rows.append(row)
    lost = [result.get(kind, {}).get(f'lost_at_{unit}') for result in judged.values()]
    rows.append(['lost at'] + [cell for level in lost for cell in
                               ('never' if level is None else f'{level:g} {text}', '')])
    return Grid(f'Disturbance: {kind}', header, rows)


def _payloads(judged):
    header = ['payload [kg]'] + [f'{name}: {what}' for name in judged
                                 for what in ('height error [m]', 'orientation [deg]')]
    count = max(len(result.get('payload', [])) for result in judged.values())
    rows = []
    for k in range(count):
        entries = [result['payload'][k] if k < len(result.get('payload', [])) else None
                   for result in judged.values()]
        mass = next(entry['payload_kg'] for entry in entries if entry)
        rows.append([f'{mass:g}'] + [cell for entry in entries for cell in (
            [_number(entry['height_error_m'], 4), _number(entry['orientation_deg'], 2)]
            if entry else [ABSENT, ABSENT])])
    return Grid('Payload, steady errors', header, rows)


def _hover(judged):
    header = ['', 'position mean ± std (max) [m]', 'orientation mean ± std (max) [deg]']
    rows = [[name, *_tracking_cells(result['hover'])] for name, result in judged.items()
            if 'hover' in result]
    return Grid('Hover after 8 s', header, rows)


def _poses(judged):
    header = ['', 'x, y, z [m]', 'roll, pitch, yaw [deg]'] + [
        f'{name}: {what}' for name in judged for what in ('U [m]', 'U [deg]')]
    rows = []
    for k in range(max(len(result['poses']) for result in judged.values())):
        poses = [result['poses'][k] if k < len(result['poses']) else None
                 for result in judged.values()]
        target = next(pose['target'] for pose in poses if pose)
        row = [str(k + 1), ', '.join(f'{v:.2f}' for v in target[:3]),
               ', '.join(f'{v:.0f}' for v in target[3:])]
        for pose in poses:
            mark = '' if not pose or pose['reached'] else ' ✗'
            row += [_number(pose['U_position_m'], 4) + mark,
                    _number(pose['U_orientation_deg'], 2)] if pose else [ABSENT, ABSENT]
        rows.append(row)
    return Grid('Poses', header, rows)


def _number(value, digits):
    return ABSENT if value is None else f'{value:.{digits}f}'


def print_results(results: dict, console: Console | None = None) -> None:
    """Print the tables of a result to the terminal."""
    console = console or Console()
    meta = results.get('meta', {})
    known = [f'{key} {meta[key]}' for key in ('task', 'conditions', 'seed')
             if meta.get(key) is not None]
    if known:
        console.print(', '.join(known), style='bold', highlight=False)
    for grid in grids(results):
        console.print(_rich(grid))


def _rich(grid):
    table = Table(title=grid.title, title_justify='left', title_style='', box=None,
                  header_style='dim', padding=(0, 2, 0, 0))
    for k, name in enumerate(grid.header):
        table.add_column(name, justify='left' if k == 0 else 'right', overflow='fold')
    for k, row in enumerate(grid.rows):
        table.add_row(*row, style='dim' if k in grid.faint else None)
    return table


def markdown(results: dict) -> str:
    """Tables of a result as GitHub Markdown."""
    parts = []
    for grid in grids(results):
        lines = [f'**{grid.title}**', '', '| ' + ' | '.join(_escape(c) for c in grid.header) + ' |',
                 '| --- |' + ' ---: |' * (len(grid.header) - 1)]
        lines += ['| ' + ' | '.join(_escape(c) for c in row) + ' |' for row in grid.rows]
        parts.append('\n'.join(lines))
    return '\n\n'.join(parts) + '\n'


def _escape(cell):
    return cell.replace('|', '\\|')


def html(grid: Grid) -> str:
    """One table as HTML."""
    head = ''.join(f'<th>{escape(cell)}</th>' for cell in grid.header)
    body = ''
    for k, row in enumerate(grid.rows):
        kind = ' class="published"' if k in grid.faint else ''
        body += f'<tr{kind}>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>\n'
    return (f'<figure class="table"><figcaption>{escape(grid.title)}</figcaption>'
            f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
            f'<tbody>{body}</tbody></table></div></figure>\n')
