"""Result tables of flights."""

from collections.abc import Callable

from rich.console import Console

from beetle_omni_ros.bags.metrics import at
from beetle_omni_ros.model.schema import parse_yaml, shortened
from beetle_omni_ros.show.page import ABSENT, Grid, number, print_grids, shipped, Terminal

FILES, SHIPPED_ROBOT = ('robot', 'plant'), 'params/robot.yaml'    # keys in the metadata

POSE = '{:5.2f} {:5.2f} {:4.2f} {:4.0f} {:4.0f} {:4.0f}'
NOTE = 'Means over the poses. U: 7.0 to 7.5 s after each target; L: 1 to 7 s after it.'
ERROR_ROWS = (  # text, path in the metrics, digits
    ('error at the target, U [m]', 'mean.U_position_m', 4),
    ('error at the target, U [deg]', 'mean.U_orientation_deg', 2),
    ('error on the way, L [m]', 'mean.L_position_m', 3),
    ('error on the way, L [deg]', 'mean.L_orientation_deg', 2))
LARGEST_ROWS = [(f'largest {text}', path.replace('mean', 'max'), digits)
                for text, path, digits in ERROR_ROWS]
EFFORT_ROWS = (
    ('|q* - q| [rad]', 'joint_error_mean_rad', 4),
    ('thrust [N]', 'thrust_mean_N', 2),
    ('hover speed [m/s]', 'hover_speed_mean_m_s', 4),
    ('hover rate [rad/s]', 'hover_angular_speed_mean_rad_s', 4),
    ('hover tilt change [rad/10 ms]', 'hover_command_change_rms.joint_rad', 4),
    ('hover thrust change [N/10 ms]', 'hover_command_change_rms.thrust_N', 3),
    ('CPU of a step, median [ms]', 'compute_ms.median', 2),
    ('CPU of a step, 99 % [ms]', 'compute_ms.p99', 2),
    ('CPU of a step, max [ms]', 'compute_ms.max', 2),
    ('deadline misses', 'compute_ms.deadline_misses', 0))

TEXTS = parse_yaml(shipped('comparison.yaml'))      # published results and texts of comparisons
PUBLISHED = TEXTS['published']
POSES = {'random100': PUBLISHED['random'], 'waypoints': PUBLISHED['waypoints']}     # of a task


# Columns of a table: heading, path in a part, digits. {} stands for mean, std and max of an error.
SPREADS = (('position mean ± std (max) [m]', 'position_{}_m', 3),
           ('orientation mean ± std (max) [deg]', 'orientation_{}_deg', 2))
PEAKS = (('peak position [m]', 'peak_position_m', 3),
         ('peak orientation [deg]', 'peak_orientation_deg', 2))
RECOVERY = *PEAKS, ('recovery [s]', 'recovery_s', 2)
# Key of a result -> title of its table, heading and names of its parts, and columns.
KINDS: dict[str, tuple[str, str, Callable, tuple]] = {
    'trajectory': ('Trajectory tracking', 'round', lambda found: [
        *_numbered(found['rounds']), ('all', found)], SPREADS),
    'force': ('Disturbance: force', 'force [N]', lambda found: _levels(found, 'N'), PEAKS),
    'torque': ('Disturbance: torque', 'torque [N m]', lambda found: _levels(found, 'N_m'),
               RECOVERY),
    'payload': ('Payload, steady errors', 'payload [kg]', lambda found: [
        (f"{part['payload_kg']:g}", part) for part in found], (
            ('height error [m]', 'height_error_m', 4),
            ('orientation [deg]', 'orientation_deg', 2))),
    'hover': ('Hover after 8 s', 'part', lambda found: [('all', found)], SPREADS),
    'wind': ('Hover before a fan', 'wind', lambda found: [
        (f"{part['speed_m_s']:g} m/s", part) for part in found], SPREADS),
    'pushes': ('Stick pushes', 'push', lambda found: [
        *_numbered(found['pushes']), ('all', found)], (
            *RECOVERY, ('mean speed [m/s]', 'speed_mean_m_s', 3),
            ('mean rate [rad/s]', 'angular_speed_mean_rad_s', 3))),
    'steps': ('Step responses', 'step', lambda found: [(step['axis'], step) for step in found], (
        ('rise [s]', 'rise_s', 2), ('settling [s]', 'settling_s', 2),
        ('overshoot [%]', 'overshoot_percent', 1)))}


def grids(results: dict, *, full: bool = False) -> list[Grid]:
    """
    Make the tables of a result.

    Args:
        results: JSON of ``evaluate``, ``fly`` or ``report``; keys other than ``meta`` are labels.
        full: with largest errors, effort, CPU times, all parts of a task and all poses.

    """
    task = str(results.get('meta', {}).get('task', ''))
    by_label = {name: result for name, result in results.items() if name != 'meta'}
    made = [_summary(by_label, task, full)]
    for key, (title, heading, parts, columns) in KINDS.items():
        # The last part is that of all, or the level with the largest errors.
        found = [(label, *part) for label, result in by_label.items() if key in result
                 for part in parts(result[key])[0 if full or key == 'steps' else -1:]]
        if found:
            others = PUBLISHED.get(task if key == 'trajectory' else key, {})
            printed = [(f'published {name}', 'all', part)
                       for name, part in _in_order(others, by_label).items()]
            if key == 'steps':
                printed = [('published NMPC', axis, {'rise_s': rise})
                           for axis, rise in PUBLISHED['rise'].items()]
            rows = [[label, name, *(_cell(part, path, digits) for _, path, digits in columns)]
                    for label, name, part in found + printed]
            made.append(Grid(title, ['', heading, *(text for text, *_ in columns)], rows,
                             frozenset(range(len(found), len(rows)))))
    groups: dict[tuple, dict] = {}      # results with equal targets, which one table compares
    for label, result in by_label.items() if full else ():
        targets = tuple(round(v, 6) for pose in result['poses'] for v in pose['target'])
        groups.setdefault(targets, {})[label] = result['poses']
    return made + [_poses(group) for targets, group in groups.items() if targets]


def _in_order(others, by_label):
    """Published results in the order of the controllers that flew, the rest behind them."""
    flown = [*(result.get('controller', name) for name, result in by_label.items()), 'rl', 'nmpc']
    return dict(sorted(others.items(),
                       key=lambda item: flown.index(item[0].lower().partition(',')[0])))


def _cell(part, path, digits):
    if '{}' not in path:
        return number(at(part, path), digits)
    mean, std, worst = (number(part.get(path.format(what)), digits)
                        for what in ('mean', 'std', 'max'))
    return f'{mean} ± {std} ({worst})' if worst != ABSENT else f'{mean} ± {std}'


def _levels(found, unit):
    return [(f"{level[f'level_{unit}']:g}" + (' lost' if level['lost'] else ''), level)
            for level in found['levels']]


def _numbered(parts):
    return [(str(k + 1), part) for k, part in enumerate(parts)]


def _summary(by_label, task, full):
    """Table with a column for each controller and published result, a row for each metric."""
    others = _in_order(POSES.get(task, {}), by_label)
    columns = [*by_label.values(), *others.values()]
    # The only pose of a trajectory is its start: to reach it says nothing about the path.
    posed = not all('trajectory' in result for result in by_label.values())
    shown: list[tuple] = [('poses reached', reached), *ERROR_ROWS] if posed else []
    if any('landing' in column for column in columns):
        shown.append(('landing [m/s]', lambda column: 'fell, ' * bool(at(column, 'landing.fell'))
                      + _cell(column, 'landing.speed_m_s', 2)))
    shown.append(('alarms', alarms))
    if any(column.get('crashed') or 'ended' in column for column in columns):
        shown.append(('ended early', lambda column: '; '.join(filter(None, (
            'crashed' * bool(column.get('crashed')), column.get('ended')))) or ABSENT))
    if full:
        shown += [*(LARGEST_ROWS if posed else ()), *EFFORT_ROWS,
                  ('guidance', lambda column: column.get('guidance') or ABSENT)]
    rows = [[text, *(what[0](column) if callable(what[0]) else _cell(column, *what)
                     for column in columns)] for text, *what in shown]
    first = len(by_label) + 1
    return Grid('', ['', *by_label, *(f'published {name}' for name in others)], rows,
                faint_columns=frozenset(range(first, first + len(others))),
                note=NOTE if posed else '')


def alarms(column: dict) -> str:
    """Return the first faults that the supervisor named, and the number of the others."""
    if 'alarms' not in column:
        return ABSENT
    first, others = list(column['alarms'])[:2], len(column['alarms']) - 2
    return ', '.join(map(shortened, first)) + f' +{others}' * (others > 0) or 'none'


def reached(column: dict) -> str:
    """Return the number of reached poses, and of those in fallback."""
    if 'poses' not in column:
        return ABSENT
    poses = column['poses']
    text = f"{sum(pose['reached'] for pose in poses)} of {len(poses)}"
    hovered = sum('fallback' in pose for pose in poses)
    return f'{text}, {hovered} in fallback' if hovered else text


def _poses(by_label):
    """Table with a row for each pose, a column for each result."""
    def cell(pose):
        distance, angle = pose['U_position_m'], pose['U_orientation_deg']
        return f'{number(distance, 4)} {number(angle, 2 if (angle or 0.0) < 10 else 0)}' \
            + ' ✗' * (not pose['reached'])

    rows = [[str(k + 1), POSE.format(*poses[0]['target']), *map(cell, poses)]
            for k, poses in enumerate(zip(*by_label.values(), strict=True))]
    return Grid('Poses: U [m] and [deg]', ['', 'x y z [m] roll pitch yaw [deg]', *by_label], rows,
                unbroken=2)


def title(meta: dict) -> str:
    """Task, conditions, seed, and the robot files that are not the shipped ones."""
    return ', '.join(f'{key} {meta[key]}' for key in ('task', 'conditions', 'seed', *FILES)
                     if meta.get(key) not in (None, 'None')
                     and (key not in FILES or str(meta[key]) != SHIPPED_ROBOT))


def print_results(results: dict, console: Console | None = None, *, full: bool = False) -> None:
    """Print the tables of a result to the terminal; ``full`` as of :func:`grids`."""
    console = console or Terminal()
    if known := title(results.get('meta', {})):
        console.print(known, style='bold', highlight=False, markup=False, soft_wrap=True)
    print_grids(grids(results, full=full), console)
