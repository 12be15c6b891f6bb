"""
The comparison as one self-contained HTML page, and as Markdown with pictures.

A cell is a text with numbers in braces: ``{path:digits}`` is the number at a path in the summary
of a controller, ``{range path:digits}`` the mean there with minimum and maximum.
"""

from base64 import b64encode
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
import re

import matplotlib
from matplotlib.figure import Figure
from PIL import Image

from beetle_omni_ros.comparison import plots
from beetle_omni_ros.comparison.summary import CONDITIONS, look, PUBLISHED, task_title
from beetle_omni_ros.pages import figures
from beetle_omni_ros.pages.page import ABSENT, at, Grid, number, rendered
from beetle_omni_ros.runs.metrics import POSE_KEYS

DOTS = 180  # per inch
COLOURS = 128  # of a picture; enough for thin lines with smooth edges
TITLE = 'RL and NMPC under one architecture'
SOURCE = {'random': 'published, simulated (Gazebo)', 'force': 'published, simulated (Gazebo)',
          'torque': 'published, simulated (Gazebo)', 'waypoints': 'published, real robot',
          'lemniscate': 'published, real robot'}
NUMBER = re.compile(r'\{(range )?([\w.]+):(\d?)\}')
# Key of a pose error -> displayed digits, and its name.
DIGITS = dict(zip(POSE_KEYS, (4, 2, 3, 2), strict=True))
NAMES = dict(zip(POSE_KEYS, ('U ‖p error‖ [m]', 'U ‖θ error‖ [deg]', 'L ‖p error‖ [m]',
                             'L ‖θ error‖ [deg]'), strict=True))
TEXTS = {
    'random': 'One pose after the other, 8 s each, x and y within 2 m, z from 0.6 to 2 m, any '
              'attitude, upside down included.',
    'waypoints': 'The five poses of the real-world experiment, 8 s each, three rounds.',
    'lemniscate': 'Position, roll, pitch and yaw follow a figure of eight in space, five rounds; '
                  'the policies were trained for poses, not for trajectories.',
    'force': 'A vertical force that rises until control is lost.',
    'torque': 'Torque impulses that rise until control is lost.',
    'payload': 'Masses attached while hovering, unknown to estimator and controllers.',
    'hover': 'How still the robot stands, and how smooth its commands are.'}
NOTES = {
    'poses': 'U: mean over 7.0 to 7.5 s of the 8 s of a pose; L: over 1.0 to 7.0 s; both '
             'averaged over the poses flown to the end, because a crash ends a flight. Reached: '
             'U below 0.10 m and 10 deg. Bold: least of ours.',
    'random': 'The published poses are drawn from the same ranges, not the same; whether their '
              '|q* − q| counts the whole flight or the hover is not stated.',
    'waypoints': 'Ours is simulated, the published columns are measured on the real robot: not '
                 'the same experiment. Means over the rounds and seeds.',
    'lemniscate': 'Ours is simulated, the published columns are measured on the real robot. The '
                  "curve is that of the authors' code.",
    'levels': '{what}, while hovering at [0, 0, 1.5] m with 25 deg of roll. Cells: largest '
              'position [m] / orientation error [deg] in the 2 s, mean over the seeds. × marks '
              'a lost control: more than 1.5 m away, on the ground, or turned by more than 90 '
              'deg when the next level is due. That ends the flight.',
    'force': 'Upward force for 2 s at each level, without a pause',
    'torque': 'Torque about x for 0.05 s at each level, one every 2 s',
    'published torque': 'Published: RL "loses stability rapidly" between 15 and 25 N m, neither '
                        'recovers above 25 N m.',
    'payload': 'Mean over 7.0 to 7.5 s after the mass was attached [least, largest of the '
               'seeds]; positive: above the target. The publication shows its real robot in a '
               'figure without numbers, with 1.0 kg for RL only.',
    'hover': 'Errors from 8 s to the end of 60 s; command changes from 7.0 to 7.5 s.',
    'glance': 'Published numbers are of Gazebo, or of the real robot where marked; ours are '
              'simulated. The tables below say more.',
    'compute': 'Everything a controller does for one command, over all flights of this page: '
               "median of the flights' medians, otherwise the worst flight. One core each, while "
               "the other cores fly too ({processor}). Published times: on the robot's ARM "
               'board; its RL number is the inference alone.'}
CHANGES = (('tilt command change in 10 ms, RMS [rad]', 'command_change_rms.joint_rad', 5),
           ('thrust command change in 10 ms, RMS [N]', 'command_change_rms.thrust_N', 4))


@dataclass(frozen=True)
class Picture:
    """A drawing as PNG, with its file name and caption."""

    name: str
    caption: str
    data: bytes

    @property
    def source(self) -> str:
        """The data as a source of an <img>."""
        return f'data:image/png;base64,{b64encode(self.data).decode()}'


@dataclass(frozen=True)
class Section:
    """A heading, a paragraph, and pictures and tables in their order."""

    title: str
    text: str
    blocks: list[Grid | Picture] = field(default_factory=list)


class Numbers:
    """Numbers of a task under one set of conditions: columns of ours, then of the publication."""

    def __init__(self, results: dict, task: str, conditions: str):
        self.task, self.conditions = task, conditions
        self.kind = 'random' if task.startswith('random') else task
        numbers = results['summary']['tasks'][task]
        self._of = {**numbers.get('paper', {}), **numbers.get(conditions, {})}
        self.ours = [name for name in results['meta']['controllers']
                     if name in numbers.get(conditions, {})]
        self.paper = [name for name in PUBLISHED if name in numbers.get('paper', {})]
        self.seeds = sorted({seed for name in self.ours for seed in self._of[name]['seeds']})

    def value(self, name: str, path: str):
        """Value at a path of keys and indices; None if absent."""
        return at(self._of[name], path)

    def cell(self, name: str, text: str) -> str:
        """Text of a cell; ABSENT if its first number is absent."""
        def shown(found):
            wide, path, digits = found.groups()
            digits = None if name in self.paper or not digits else int(digits)
            if not wide:
                return number(self.value(name, path), digits)
            mean, low, high = (self.value(name, f'{path}.{end}') for end in ('mean', 'min', 'max'))
            spread = '' if low == high else f' [{number(low, digits)}, {number(high, digits)}]' \
                if low is not None else f' max {number(high, digits)}'
            return number(mean, digits) + spread

        wide, path, _ = NUMBER.search(text).groups()
        known = self.value(name, f'{path}.mean' if wide else path) is not None
        return NUMBER.sub(shown, text) if known else ABSENT

    def first(self, path: str) -> list:
        """List that all own controllers share, from the first that has it."""
        return next((found for name in self.ours if (found := self.value(name, path))), [])

    def grid(self, title: str, rows: list[tuple], *notes: str) -> Grid:
        """Table of rows: name, text or function of the controller, path of a marked number."""
        names, cells, best = [*self.ours, *self.paper], [], set()
        for k, (text, content, *path) in enumerate(rows):
            cells.append([text, *(content(name) if callable(content) else self.cell(name, content)
                                  for name in names)])
            known = {column: abs(value) for column, name in enumerate(self.ours, 1) for value in
                     [self.value(name, *path) if path else None] if value is not None}
            if len(self.ours) > 1 and known:
                best.add((k, min(known, key=known.__getitem__)))
        seeds = f"Seed{'s' * (len(self.seeds) > 1)} {', '.join(map(str, self.seeds))}."
        return Grid(f'{title}, {self.conditions} conditions',
                    ['', *(look(name).label for name in self.ours),
                     *(f'{look(name).label} ({SOURCE[self.kind]})' for name in self.paper)],
                    cells, note=' '.join([seeds, *notes]), best=frozenset(best),
                    faint_columns=frozenset(range(len(self.ours) + 1, len(names) + 1)))

    def lost(self, name: str) -> str:
        """Text of the level at which control was lost over all flights."""
        found, unit = self.value(name, self.kind), 'N' if self.kind == 'force' else 'N m'
        if found is None:
            return ABSENT
        low, high = found['lost_min'], found['lost_max']
        if low is None:
            return 'never'
        return f'{low:g} {unit}' if low == high else \
            f'{low:g} {unit} or never' if high is None else f'{low:g} to {high:g} {unit}'


def both(prefix: str, error: str = 'U') -> str:
    """Text of U or L of position and orientation."""
    return f'{{{prefix}{error}_position_m.mean:4}} / {{{prefix}{error}_orientation_deg.mean:2}}'


def marked(text: str, path: str, digits: int, std: bool = True) -> tuple:
    """Row of a mean with its standard deviation, of which the least is marked."""
    return (text, f'{{{path}.mean:{digits}}}' + f' ± {{{path}.std:{digits}}}' * std,
            f'{path}.mean')


def poses(numbers: Numbers) -> Grid:
    """Poses: the publication's table of 100 random poses, with further rows."""
    tilt = 'command_change_rms.joint_rad'
    return numbers.grid(task_title(numbers.task), [
        *((f'{NAMES[key]}, mean [min, max]', f'{{range {key}:{digits}}}', f'{key}.mean')
          for key, digits in DIGITS.items()),
        marked('‖v‖ at the target ± std [m/s]', 'hover_speed_m_s', 4),
        marked('‖ω‖ at the target ± std [rad/s]', 'hover_angular_speed_rad_s', 4),
        marked('|q* − q| ± std [rad]', 'joint_error_rad', 4),
        ('the same, at the target only', '{joint_error_hover_rad.mean:4}'),
        marked('thrust f* ± std [N]', 'thrust_N', 2),
        ('tilt command change in 10 ms at the target, RMS [rad]', f'{{{tilt}:4}}', tilt),
        ('poses reached', '{reached:0} of {poses:0}'),
        ('poses flown to the end', '{flown:0}'),
        ('flights that touched the ground', '{crashed:0} of {flights:0}')],
        NOTES['poses'], NOTES['random'] if numbers.kind == 'random' else '')


def waypoints(numbers: Numbers) -> Grid:
    """Five waypoints, one row for each pose, as the publication's table of the real robot."""
    rows = [('[{:g}, {:g}, {:g}] m, [{:g}, {:g}, {:g}] deg'.format(*entry['target']),
             both(f'by_pose.{k}.')) for k, entry in enumerate(numbers.first('by_pose'))]
    return numbers.grid('Five waypoints, three rounds: U position [m] / orientation [deg]', [
        *rows, ('mean', both(''), 'U_position_m.mean'),
        *((f'{NAMES[key]}, mean [min, max]', f'{{range {key}:{DIGITS[key]}}}')
          for key in POSE_KEYS[2:]), ('poses reached', '{reached:0} of {poses:0}')],
        NOTES['waypoints'])


def lemniscate(numbers: Numbers) -> Grid:
    """Tracking errors over all rounds."""
    rows: list[tuple] = []
    for text, path, digits in (('position error [m]', 'trajectory.position_m', 4),
                               ('orientation error [deg]', 'trajectory.orientation_deg', 2)):
        rows += [marked(f'{text}, mean ± std', path, digits),
                 ('range of the means of the rounds',
                  f'{{{path}.round_min:{digits}}} to {{{path}.round_max:{digits}}}'),
                 ('largest', f'{{{path}.max:{digits}}}')]
    return numbers.grid('3D lemniscate, five rounds', [
        *rows, ('rounds', '{trajectory.rounds:0}')], NOTES['lemniscate'])


def disturbance(numbers: Numbers) -> Grid:
    """Peak errors at each level, and the level of lost control."""
    kind, unit = numbers.kind, 'N' if numbers.kind == 'force' else 'N m'
    levels = sorted({entry['level'] for name in numbers.ours
                     for entry in numbers.value(name, f'{kind}.levels') or []})

    def level(wanted):
        def cell(name):
            for entry in numbers.value(name, f'{kind}.levels') or []:
                if entry['level'] == wanted:
                    return (f"{number(entry['peak_position_m']['mean'], 3)} / "
                            f"{number(entry['peak_orientation_deg']['mean'], 1)}"
                            + f" × lost in {entry['lost']} of {entry['flown']}"
                            * bool(entry['lost']))
            return ABSENT if name in numbers.ours else ''
        return cell
    return numbers.grid(task_title(kind), [
        *((f'{step:g} {unit}', level(step)) for step in levels),
        ('control lost at', numbers.lost),
        ('withstood in every flight', f'{{{kind}.withstood_min:}} {unit}')],
        NOTES['levels'].format(what=NOTES[kind]), NOTES['published torque'] * (kind == 'torque'))


def payload(numbers: Numbers) -> Grid:
    """Steady errors against the attached mass."""
    masses = [f"{entry['payload_kg']:g} kg" for entry in numbers.first('payload')]
    return numbers.grid('Payload attached below the body, steady errors', [
        (f'{mass}: {text}', f'{{range payload.{k}.{key}:{digits}}}', f'payload.{k}.{key}.mean')
        for text, key, digits in (('height error [m]', 'height_error_m', 4),
                                  ('orientation error [deg]', 'orientation_deg', 2))
        for k, mass in enumerate(masses)], NOTES['payload'])


def hover(numbers: Numbers) -> Grid:
    """Errors and command changes in a hover of one minute."""
    return numbers.grid('Steady hover at [0, 0, 1] m', [
        marked('position error ± std [m]', 'hover.position_m', 4),
        marked('orientation error ± std [deg]', 'hover.orientation_deg', 3),
        *((text, f'{{{path}:{digits}}}', path) for text, path, digits in CHANGES)],
        NOTES['hover'])


def compute(results: dict) -> Grid:
    """CPU time of a step of each controller."""
    times = results['summary']['compute']
    ours = [name for name in results['meta']['controllers'] if name in times]
    rows = []
    for text, key, digits, *published in (
            ('median [ms]', 'median', 3, '"0.3 on average"', '"typically within 10"'),
            ('99th percentile [ms]', 'p99', 2), ('largest [ms]', 'max', 2),
            ('over 10 ms', 'deadline_misses', 0, ABSENT, '"occasionally"'), ('steps', 'steps', 0)):
        rows.append([text, *(number(times[name][key], digits) for name in ours),
                     *(published or [ABSENT] * len(PUBLISHED))])
    machine = results['meta'].get('machine', {})
    return Grid('CPU time of one controller step', [
        '', *(look(name).label for name in ours),
        *(f'{look(name).label} (published, real robot)' for name in PUBLISHED)], rows,
        note=NOTES['compute'].format(processor=machine.get('processor', 'unknown processor')),
        faint_columns=frozenset(range(len(ours) + 1, len(ours) + len(PUBLISHED) + 1)))


GLANCE: dict[str, list[tuple[str, str]]] = {
    'random': [('U, mean [m] / [deg]', both('')), ('L, mean [m] / [deg]', both('', 'L')),
               ('poses reached', '{reached:0} of {poses:0}')],
    'waypoints': [('U, mean [m] / [deg]', both(''))],
    'lemniscate': [('mean error [m] / [deg]',
                    '{trajectory.position_m.mean:4} / {trajectory.orientation_deg.mean:2}')],
    'force': [('control lost at', '')], 'torque': [('control lost at', '')],
    'payload': [('largest height error up to 1 kg [m]', '{payload_height_max_m:4}')],
    'hover': [('command change in 10 ms, RMS [rad] / [N]',
               '{command_change_rms.joint_rad:4} / {command_change_rms.thrust_N:4}')]}


def glance(results: dict) -> Grid:
    """Every experiment in one table."""
    ours, paper, rows = results['meta']['controllers'], list(PUBLISHED), []
    for task, by_conditions in results['summary']['tasks'].items():
        for conditions in (c for c in by_conditions if c != 'paper'):
            numbers = Numbers(results, task, conditions)
            there = [*numbers.ours, *(numbers.paper if conditions == 'nominal' else ())]
            real = SOURCE.get(numbers.kind, '').endswith('real robot')
            for text, content in GLANCE.get(numbers.kind, GLANCE['random']):
                cells = {name: numbers.cell(name, content) if content else numbers.lost(name)
                         for name in there}
                rows.append([f'{task_title(task)}, {conditions}: {text}', *(
                    cells.get(name, ABSENT)
                    + ' real robot' * (real and name in paper and name in cells)
                    for name in (*ours, *paper))])
    return Grid('All experiments', [
        '', *(look(name).label for name in ours),
        *(f'{look(name).label} (published)' for name in paper)], rows, note=NOTES['glance'],
        faint_columns=frozenset(range(len(ours) + 1, len(ours) + len(paper) + 1)))


TABLES: dict[str, Callable[[Numbers], Grid]] = {
    'waypoints': waypoints, 'lemniscate': lemniscate, 'force': disturbance,
    'torque': disturbance, 'payload': payload, 'hover': hover}


def sections(results: dict, flown: dict) -> list[Section]:
    """
    Pictures and tables of all flights.

    Args:
        results: content of the JSON file.
        flown: flights and their results with traces.

    """
    made = [Section('At a glance', '', [glance(results)])]
    with matplotlib.rc_context(figures.STYLE):
        for task, by_conditions in results['summary']['tasks'].items():
            blocks: list[Grid | Picture] = []
            for conditions in (c for c in by_conditions if c in CONDITIONS):
                numbers = Numbers(results, task, conditions)
                blocks.append(TABLES.get(numbers.kind, poses)(numbers))
                groups = plots.of(flown, task, conditions)
                for name, caption, draw in plots.DRAWN.get(numbers.kind, plots.DRAWN['random']):
                    if groups and (figure := draw(groups, task)):
                        blocks.append(Picture(f'{Path(numbers.kind).stem}_{name}_{conditions}',
                                              f'{caption} ({conditions} conditions)',
                                              png(figure)))
            made.append(Section(task_title(task), TEXTS.get(
                'random' if task.startswith('random') else task, ''), blocks))
    made.append(Section('Compute time', '', [compute(results)]))
    return made


def pictures(made: list[Section]) -> list[Picture]:
    """All pictures of all sections."""
    return [block for section in made for block in section.blocks if isinstance(block, Picture)]


def png(figure: Figure) -> bytes:
    """Figure as PNG with few colours, a third of the full size."""
    buffer, small = BytesIO(), BytesIO()
    figure.savefig(buffer, format='png', dpi=DOTS)
    Image.open(buffer).convert('RGB').quantize(COLOURS, dither=Image.Dither.NONE).save(
        small, format='png', optimize=True)
    return small.getvalue()


def _content(results, made):
    """What both forms of the page show: terms with their meaning, facts, sections, flights."""
    meta = results['meta']
    terms = []
    for name in meta['controllers']:
        moved = meta.get('guidance', {}).get(name)
        terms.append((look(name).label, '; '.join(filter(None, [
            look(name).text or meta.get('specs', {}).get(name, ''),
            f'guidance: {moved}' if moved else '']))))
    terms += [(f'{name} conditions', CONDITIONS[name]) for name in meta['conditions']]
    terms += [(f'{name}: not flown', reason) for name, reason in meta['skipped'].items()]
    failed = sum(bool(flight['failure']) for flight in results['flights'])
    facts = [f"beetle_omni_ros {meta['version']}"
             + (f", commit {meta['commit']}" if meta.get('commit') else ''),
             f"{len(results['flights'])} flights, {failed} failed; seeds "
             f"{', '.join(map(str, meta['seeds']))}",
             f"{meta['cpu_s'] / 60:.1f} core minutes on {meta['machine']['processor']}",
             *(f'simulated plant: {plant}' for plant in [meta.get('plant')] if plant),
             *(f'{look(name).label}: policy {digest}'
               for name, digest in meta['policies'].items())]
    flights = Grid('', ['task', 'conditions', 'controller', 'seed', 'end', 'core s'], [
        [flight['task'], flight['conditions'], flight['controller'], str(flight['seed']),
         flight['failure'] or flight['metrics'].get('ended')
         or ('touched the ground' if flight['metrics']['crashed'] else 'flown'),
         number(flight['cpu_s'], 1)] for flight in results['flights']])
    return {'title': TITLE, 'terms': terms, 'facts': facts, 'sections': made, 'flights': flights,
            'command': meta['command']}


def as_page(results: dict, made: list[Section]) -> str:
    """The self-contained HTML page."""
    return rendered('comparison.html', **_content(results, made))


def as_markdown(results: dict, made: list[Section], how: str = '') -> str:
    """The page as Markdown; ``how`` is a link to the how-to page, or ''."""
    return rendered('comparison.md', how=how, **_content(results, made))
