"""
Tables of a comparison, in the publication's layout where it has them.

A cell is a list of texts and numbers. A number is a path in the JSON, so that page and JSON
cannot differ.
"""

from dataclasses import dataclass, field
from html import escape
from itertools import groupby
from math import isfinite

from beetle_omni_ros.comparison.summary import look, PUBLISHED, task_title
from beetle_omni_ros.control import registry
from beetle_omni_ros.pages import page
from beetle_omni_ros.pages.page import ABSENT

OURS = 'ours, simulated'
GAZEBO = 'published, simulated (Gazebo)'
REAL = 'published, real robot'
PAPER = tuple(PUBLISHED)
GROUP = {'random': GAZEBO, 'force': GAZEBO, 'torque': GAZEBO, 'waypoints': REAL,
         'lemniscate': REAL}
# Key of a pose error -> displayed digits, and its name.
SINGLE = {'U_position_m': 4, 'U_orientation_deg': 2, 'L_position_m': 3, 'L_orientation_deg': 2}
NAMES = {'U_position_m': 'U ‖p error‖ [m]', 'U_orientation_deg': 'U ‖θ error‖ [deg]',
         'L_position_m': 'L ‖p error‖ [m]', 'L_orientation_deg': 'L ‖θ error‖ [deg]'}


@dataclass(frozen=True)
class Number:
    """A number of the results: path of keys and indices; digits None: printed with '%g'."""

    path: tuple
    digits: int | None = None

    def value(self, results: dict) -> float | None:
        """Value in the results; None if absent."""
        for key in self.path:
            try:
                results = results[key]
            except (KeyError, IndexError, TypeError):
                return None
        return results

    def text(self, results: dict) -> str:
        """Printed text."""
        value = self.value(results)
        if value is None or not isfinite(value):
            return ABSENT
        text = f'{value:g}' if self.digits is None else f'{value:.{self.digits}f}'
        return text.removeprefix('-') if float(text) == 0 else text


@dataclass(frozen=True)
class Cell:
    """Main parts, small parts below, each text or Number, and whether it is the row's best."""

    main: list = field(default_factory=lambda: [ABSENT])
    small: list = field(default_factory=list)
    best: bool = False


@dataclass(frozen=True)
class Column:
    """One column: a controller, and the group with the source of its numbers."""

    controller: str
    group: str


@dataclass(frozen=True)
class Grid:
    """
    A table.

    Attributes:
        title: one line.
        columns: controllers, to the right of the column of row names.
        rows: (name, cells).
        notes: sentences below.
        commands: shell lines that fly the table's flights.

    """

    title: str
    columns: list[Column]
    rows: list[tuple[str, list[Cell]]]
    notes: list[str] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)


def text_of(parts: list, results: dict) -> str:
    """Text of a cell's main or small parts."""
    return ''.join(part.text(results) if isinstance(part, Number) else part for part in parts)


def html(grid: Grid, results: dict) -> str:
    """Table, notes and commands as HTML; numbers have their path in ``data-key``."""
    kinds = [_kind(column.group) for column in grid.columns]
    first = [k == 0 or grid.columns[k - 1].group != column.group
             for k, column in enumerate(grid.columns)]
    classes = [kind + (' first' if new else '') for kind, new in zip(kinds, first, strict=True)]
    top = '<th></th>' + ''.join(
        f'<th colspan="{len(list(columns))}" class="group {_kind(group)}">{escape(group)}</th>'
        for group, columns in groupby(grid.columns, lambda column: column.group))
    head = '<th></th>' + ''.join(
        f'<th class="{name}"><i style="background: {look(column.controller).colour}"></i>'
        f'{escape(look(column.controller).label)}</th>'
        for name, column in zip(classes, grid.columns, strict=True))
    body = ''.join(
        f'<tr><th scope="row">{escape(name)}</th>' + ''.join(
            f'<td class="{kind}{" best" if cell.best else ""}">{_html_cell(cell, results)}</td>'
            for kind, cell in zip(classes, cells, strict=True)) + '</tr>\n'
        for name, cells in grid.rows)
    notes, commands = escape(' '.join(grid.notes)), escape('\n'.join(grid.commands))
    return (f'<figure class="table"><figcaption>{escape(grid.title)}</figcaption>'
            f'<div class="scroll"><table><thead><tr class="groups">{top}</tr><tr>{head}</tr>'
            f'</thead>\n<tbody>{body}</tbody></table></div>'
            + (f'<p class="note">{notes}</p>' if notes else '')
            + (f'<pre>{commands}</pre>' if commands else '') + '</figure>\n')


def _kind(group):
    return {GAZEBO: 'gazebo', REAL: 'real'}.get(group, 'ours')


def _html_cell(cell, results):
    main, small = (''.join(
        f'<span data-key="{escape("/".join(map(str, part.path)))}">{part.text(results)}</span>'
        if isinstance(part, Number) else escape(part) for part in parts)
        for parts in (cell.main, cell.small))
    return main + (f'<small>{small}</small>' if small else '')


def markdown(grid: Grid, results: dict) -> str:
    """Table, notes and commands as GitHub Markdown."""
    several = len({column.group for column in grid.columns}) > 1
    head = [f'{look(column.controller).label}'
            + (f' ({column.group})' if column.group != OURS and several else '')
            for column in grid.columns]
    rows = [[name, *(_markdown_cell(cell, results) for cell in cells)]
            for name, cells in grid.rows]
    lines = [f'**{grid.title}**', '', page.markdown(['', *head], rows, numeric=True).rstrip()]
    lines += ['', ' '.join(grid.notes)] if grid.notes else []
    lines += ['', '```sh', *grid.commands, '```'] if grid.commands else []
    return '\n'.join(lines) + '\n'


def _markdown_cell(cell, results):
    main, small = text_of(cell.main, results), text_of(cell.small, results)
    main = f'**{main}**' if cell.best else main
    return f'{main} {small}'.strip()


class Task:
    """Numbers of a table: a task under one set of conditions."""

    def __init__(self, results: dict, task: str, conditions: str):
        self.results, self.task, self.conditions = results, task, conditions
        self.numbers = results['summary']['tasks'][task]
        self.ours = [name for name in results['meta']['controllers']
                     if name in self.numbers.get(conditions, {})]
        kind = 'random' if task.startswith('random') else task
        self.paper = [name for name in PAPER if name in self.numbers.get('paper', {})]
        self.columns = [*(Column(name, OURS) for name in self.ours),
                        *(Column(name, GROUP[kind]) for name in self.paper)]

    def path(self, controller, *keys):
        """Path of a number in one column."""
        conditions = 'paper' if controller in PAPER else self.conditions
        return ('summary', 'tasks', self.task, conditions, controller, *keys)

    def number(self, controller, *keys, digits=None):
        """Number of one column; published numbers keep their digits."""
        return Number(self.path(controller, *keys), None if controller in PAPER else digits)

    def value(self, controller, *keys):
        """Value of a number in one column."""
        return Number(self.path(controller, *keys)).value(self.results)

    def first(self, *keys):
        """List that all own controllers share, from the first that has it."""
        return next((found for name in self.ours if (found := self.value(name, *keys))), [])

    def row(self, name, cell, best=None):
        """
        One row.

        Args:
            name: name of the row.
            cell: function from controller to Cell.
            best: keys of the number whose least absolute value is marked as best; None: no mark.

        """
        cells = {column.controller: cell(column.controller) for column in self.columns}
        if best and len(self.ours) > 1:
            values = {name: self.value(name, *best) for name in self.ours}
            known = {name: abs(value) for name, value in values.items() if value is not None}
            if known:
                winner = min(known, key=known.get)
                cells[winner] = Cell(cells[winner].main, cells[winner].small, best=True)
        return name, list(cells.values())

    def mean_range(self, *keys, digits):
        """Cells of a mean with minimum and maximum."""
        def cell(name):
            if self.value(name, *keys, 'mean') is None:
                return Cell()
            small = []
            ends = [self.value(name, *keys, end) for end in ('min', 'max')]
            if ends[0] != ends[1]:
                low = self.number(name, *keys, 'min', digits=digits)
                high = self.number(name, *keys, 'max', digits=digits)
                small = ['[', low, ', ', high, ']'] if low.value(self.results) is not None \
                    else ['max ', high]
            return Cell([self.number(name, *keys, 'mean', digits=digits)], small)
        return cell

    def cells(self, *main, small=()):
        """Cells of texts and numbers (*keys, digits); empty where the first number is absent."""
        def parts(name, given):
            return [part if isinstance(part, str) else
                    self.number(name, *part[:-1], digits=part[-1]) for part in given]

        return lambda name: Cell(parts(name, main), parts(name, small)) \
            if self.value(name, *main[0][:-1]) is not None else Cell()

    def mean_std(self, *keys, digits):
        """Cells of a mean with its standard deviation."""
        return self.cells((*keys, 'mean', digits), small=['± ', (*keys, 'std', digits)])

    def plain(self, *keys, digits=None, unit=''):
        """Cells of one number."""
        return self.cells((*keys, digits), unit)

    def seeds(self):
        """Seeds of the table's flights."""
        return sorted({seed for name in self.ours
                       for seed in self.numbers[self.conditions][name]['seeds']})

    def commands(self):
        """Shell lines that fly the table's flights."""
        meta = self.results['meta']
        policy = meta['policy_file'] if registry.owner('--policy') in self.ours else None
        ours = [meta.get('specs', {}).get(name, name) for name in self.ours]
        return [f"beetle_omni evaluate --controllers {','.join(ours)} --task {self.task} "
                f'--conditions {self.conditions} --seed {seed}'
                + (f' --policy {policy}' if policy else '') for seed in self.seeds()]

    def grid(self, title, rows, notes=()):
        """Grid of these rows."""
        seeds = self.seeds()
        text = f"Seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}."
        return Grid(f'{title}, {self.conditions} conditions', self.columns, rows,
                    [text, *notes], self.commands())


def reached(task: Task):
    """Cells of the number of reached poses."""
    return task.cells(('reached', 0), ' of ', ('poses', 0))


def poses(results: dict, name: str, conditions: str) -> Grid:
    """Poses: the publication's table of 100 random poses, with further rows."""
    task = Task(results, name, conditions)
    rows = [task.row(f'{NAMES[key]}, mean [min, max]', task.mean_range(key, digits=digits),
                     best=(key, 'mean')) for key, digits in SINGLE.items()]
    rows += [
        task.row('‖v‖ at the target ± std [m/s]',
                 task.mean_std('hover_speed_m_s', digits=4), best=('hover_speed_m_s', 'mean')),
        task.row('‖ω‖ at the target ± std [rad/s]',
                 task.mean_std('hover_angular_speed_rad_s', digits=4),
                 best=('hover_angular_speed_rad_s', 'mean')),
        task.row('|q* − q| ± std [rad]', task.mean_std('joint_error_rad', digits=4),
                 best=('joint_error_rad', 'mean')),
        task.row('the same, at the target only', task.plain('joint_error_hover_rad', 'mean',
                                                            digits=4)),
        task.row('thrust f* ± std [N]', task.mean_std('thrust_N', digits=2),
                 best=('thrust_N', 'mean')),
        task.row('tilt command change in 10 ms at the target, RMS [rad]',
                 task.plain('command_change_rms', 'joint_rad', digits=4),
                 best=('command_change_rms', 'joint_rad')),
        task.row('poses reached', reached(task)),
        task.row('poses flown to the end', task.plain('flown', digits=0)),
        task.row('flights that touched the ground',
                 task.cells(('crashed', 0), ' of ', ('flights', 0)))]
    notes = ['U: mean over 7.0 to 7.5 s of the 8 s of a pose; L: over 1.0 to 7.0 s; both '
             'averaged over the poses flown to the end, because a crash ends a flight. Reached: '
             'U below 0.10 m and 10 deg. Bold: least of ours.']
    if name.startswith('random'):
        notes.append('The published poses are drawn from the same ranges, not the same; whether '
                     'its |q* − q| counts the whole flight or the hover is not stated.')
    return task.grid(task_title(name), rows, notes)


def waypoints(results: dict, conditions: str) -> Grid:
    """Five waypoints, one row for each pose, as the publication's table of the real robot."""
    task = Task(results, 'waypoints', conditions)
    targets = task.first('by_pose')
    rows = []
    for k, entry in enumerate(targets):
        pose = '[{:g}, {:g}, {:g}] m, [{:g}, {:g}, {:g}] deg'.format(*entry['target'])
        rows.append(task.row(pose, _both(task, 'by_pose', k)))
    rows.append(task.row('mean', _both(task), best=('U_position_m', 'mean')))
    rows += [task.row(f'{NAMES[key]}, mean [min, max]', task.mean_range(key, digits=SINGLE[key]))
             for key in ('L_position_m', 'L_orientation_deg')]
    rows.append(task.row('poses reached', reached(task)))
    return task.grid(
        'Five waypoints, three rounds: U position [m] / orientation [deg]', rows,
        ['Ours is simulated, the published columns are measured on the real robot: not the same '
         'experiment. Means over the rounds and seeds.'])


def _both(task, *keys, error='U'):
    """U or L of position and orientation in one cell."""
    return task.cells((*keys, f'{error}_position_m', 'mean', 4), ' / ',
                      (*keys, f'{error}_orientation_deg', 'mean', 2))


def lemniscate(results: dict, conditions: str) -> Grid:
    """Tracking errors over all rounds."""
    task = Task(results, 'lemniscate', conditions)
    rows = []
    for text, key, digits in (('position error [m]', 'position_m', 4),
                              ('orientation error [deg]', 'orientation_deg', 2)):
        rows += [task.row(f'{text}, mean ± std', task.mean_std('trajectory', key, digits=digits),
                          best=('trajectory', key, 'mean')),
                 task.row('range of the means of the rounds', task.cells(
                     ('trajectory', key, 'round_min', digits), ' to ',
                     ('trajectory', key, 'round_max', digits))),
                 task.row('largest', task.plain('trajectory', key, 'max', digits=digits))]
    rows.append(task.row('rounds', task.plain('trajectory', 'rounds', digits=0)))
    return task.grid(
        '3D lemniscate, five rounds', rows,
        ['Ours is simulated, the published columns are measured on the real robot. The curve is '
         "that of the authors' code."])


def disturbance(results: dict, kind: str, conditions: str) -> Grid:
    """Peak errors at each level, and the level of lost control."""
    task = Task(results, kind, conditions)
    unit = 'N' if kind == 'force' else 'N m'
    levels = sorted({entry['level'] for name in task.ours
                     for entry in task.value(name, kind, 'levels') or []})
    rows = [task.row(f'{level:g} {unit}', _level(task, kind, level)) for level in levels]
    rows += [task.row('control lost at', lost(task, kind, unit)),
             task.row('withstood in every flight',
                      task.plain(kind, 'withstood_min', unit=f' {unit}'))]
    what = 'Upward force for 2 s at each level, without a pause' if kind == 'force' else \
        'Torque about x for 0.05 s at each level, one every 2 s'
    notes = [f'{what}, while hovering at [0, 0, 1.5] m with 25 deg of roll. Cells: largest '
             'position [m] / orientation error [deg] in the 2 s, mean over the seeds. × marks a '
             'lost control: more than 1.5 m away, on the ground, or turned by more than 90 deg '
             'when the next level is due. That ends the flight.']
    if kind == 'torque':
        notes.append('Published: RL "loses stability rapidly" between 15 and 25 N m, neither '
                     'recovers above 25 N m.')
    return task.grid(task_title(kind), rows, notes)


def _level(task, kind, level):
    def cell(name):
        entries = task.value(name, kind, 'levels') or []
        for k, entry in enumerate(entries):
            if entry['level'] == level:
                main = [task.number(name, kind, 'levels', k, 'peak_position_m', 'mean', digits=3),
                        ' / ', task.number(name, kind, 'levels', k, 'peak_orientation_deg',
                                           'mean', digits=1)]
                small = []
                if entry['lost']:
                    small = ['× lost in ', task.number(name, kind, 'levels', k, 'lost', digits=0),
                             ' of ', task.number(name, kind, 'levels', k, 'flown', digits=0)]
                return Cell(main, small)
        return Cell([''] if name not in task.ours else ['–'])
    return cell


def lost(task: Task, kind: str, unit: str):
    """Cells of the level of lost control over all flights."""
    def cell(name):
        low, high = (task.number(name, kind, f'lost_{end}') for end in ('min', 'max'))
        first, last = low.value(task.results), high.value(task.results)
        if task.value(name, kind) is None:
            return Cell()
        if first is None:
            return Cell(['never'])
        if first == last:
            return Cell([low, f' {unit}'])
        return Cell([low, ' to ', high, f' {unit}'] if last is not None
                    else [low, f' {unit} or never'])
    return cell


def payload(results: dict, conditions: str) -> Grid:
    """Steady errors against the attached mass."""
    task = Task(results, 'payload', conditions)
    entries = task.first('payload')
    rows = []
    for k, entry in enumerate(entries):
        mass = f"{entry['payload_kg']:g} kg"
        rows.append(task.row(f'{mass}: height error [m]',
                             task.mean_range('payload', k, 'height_error_m', digits=4),
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


def hover(results: dict, conditions: str) -> Grid:
    """Errors and command changes in a hover of one minute."""
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
        return [('mean error [m] / [deg]', task.cells(
            ('trajectory', 'position_m', 'mean', 4), ' / ',
            ('trajectory', 'orientation_deg', 'mean', 2)), True)]
    if task.task in ('force', 'torque'):
        unit = 'N' if task.task == 'force' else 'N m'
        return [('control lost at', lost(task, task.task, unit), False)]
    if task.task == 'payload':
        return [('largest height error up to 1 kg [m]',
                 task.plain('payload_height_max_m', digits=4), False)]
    if task.task == 'hover':
        return [('command change in 10 ms, RMS [rad] / [N]', task.cells(
            ('command_change_rms', 'joint_rad', 4), ' / ',
            ('command_change_rms', 'thrust_N', 4)), False)]
    real = task.task == 'waypoints'
    made = [('U, mean [m] / [deg]', _both(task), real)]
    if not real:
        made += [('L, mean [m] / [deg]', _both(task, error='L'), False),
                 ('poses reached', reached(task), False)]
    return made


def flights(results: dict) -> str:
    """HTML rows of all flights: task, end and CPU time."""
    def end(flight):
        if flight['failure']:
            return flight['failure']
        metrics = flight['metrics']
        return metrics.get('ended') or ('touched the ground' if metrics['crashed'] else 'flown')

    return ''.join(
        f"<tr><td>{escape(flight['task'])}</td><td>{escape(flight['conditions'])}</td>"
        f"<td>{escape(flight['controller'])}</td><td>{flight['seed']}</td>"
        f"<td>{escape(end(flight))}</td><td><span data-key=\"flights/{k}/cpu_s\">"
        f"{Number(('flights', k, 'cpu_s'), 1).text(results)}</span></td></tr>\n"
        for k, flight in enumerate(results['flights']))
