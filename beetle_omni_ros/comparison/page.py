"""The comparison as one self-contained HTML page, and as Markdown with pictures."""

from base64 import b64encode
from dataclasses import dataclass, field
from html import escape
from io import BytesIO
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
from PIL import Image

from beetle_omni_ros.comparison import grid, grids, plots
from beetle_omni_ros.comparison.grid import Grid
from beetle_omni_ros.comparison.style import CONDITIONS, look, task_title
from beetle_omni_ros.pages import figures
from beetle_omni_ros.pages.page import frame, shipped

DOTS = 180  # per inch
COLOURS = 128  # of a picture; enough for thin lines with smooth edges
TITLE = 'RL and NMPC under one architecture'


@dataclass(frozen=True)
class Picture:
    """A drawing as PNG, with its file name and caption."""

    name: str
    caption: str
    data: bytes


@dataclass(frozen=True)
class Section:
    """A heading, a paragraph, and pictures and tables in their order."""

    title: str
    text: str
    blocks: list[Grid | Picture] = field(default_factory=list)


def sections(results: dict, flown: dict) -> list[Section]:
    """
    Pictures and tables of all flights.

    Args:
        results: content of the JSON file.
        flown: flights and their results with traces.

    """
    made = [Section('At a glance', '', [grids.glance(results)])]
    with matplotlib.rc_context(figures.STYLE):
        for task, by_conditions in results['summary']['tasks'].items():
            blocks: list[Grid | Picture] = []
            for conditions in (c for c in by_conditions if c in CONDITIONS):
                blocks += _blocks(results, flown, task, conditions)
            made.append(Section(task_title(task), TEXTS.get(_kind(task), ''), blocks))
    made.append(Section('Compute time', '', [grids.compute(results)]))
    return made


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


def _kind(task):
    return 'random' if task.startswith('random') else task


def _blocks(results, flown, task, conditions):
    """Pictures and table of a task under one set of conditions."""
    def picture(name, caption, figure):
        return [Picture(f'{Path(_kind(task)).stem}_{name}_{conditions}',
                        f'{caption} ({conditions} conditions)', png(figure))] if figure else []

    kind = _kind(task)
    if kind == 'waypoints':
        return [grids.waypoints(results, conditions), *picture(
            'states', 'States in a round: mean of all rounds, least to largest as a band',
            plots.waypoints(flown, conditions))]
    if kind == 'lemniscate':
        return [grids.lemniscate(results, conditions), *picture(
            'path', 'Path, mean of all rounds', plots.lemniscate_path(flown, conditions)),
            *picture('errors', 'Tracking errors in a round: mean of all rounds, least to largest '
                     'as a band', plots.lemniscate_errors(flown, conditions))]
    if kind in ('force', 'torque'):
        return [*picture('errors', 'Errors in time, the disturbance dashed; × where control was '
                         'lost; thin lines: further seeds' + (
                             '; each torque lasts 0.05 s' if kind == 'torque' else ''),
                         plots.disturbance(flown, kind, conditions)),
                grids.disturbance(results, kind, conditions)]
    if kind == 'payload':
        return [*picture('errors', 'Errors against the payload, range over the seeds; right: '
                         'height in time', plots.payload(flown, conditions)),
                grids.payload(results, conditions)]
    if kind == 'hover':
        return [grids.hover(results, conditions), *picture(
            'commands', 'Commands at the end of the hover, four joints and four rotors',
            plots.hover_commands(flown, conditions))]
    return [grids.poses(results, task, conditions),
            *picture('errors', 'Errors at the target; stars: published means, with their ranges',
                     plots.distributions(flown, task, conditions)),
            *picture('convergence', 'Errors after a pose was asked for: median and 10 to '
                     '90 % band over all poses',
                     plots.convergence(flown, task, conditions))]


def pictures(made: list[Section]) -> list[Picture]:
    """All pictures of all sections."""
    return [block for section in made for block in section.blocks if isinstance(block, Picture)]


def png(figure: Figure) -> bytes:
    """Figure as PNG with few colours, a third of the full size."""
    buffer, small = BytesIO(), BytesIO()
    with matplotlib.rc_context(figures.STYLE):
        figure.savefig(buffer, format='png', dpi=DOTS)
    Image.open(buffer).convert('RGB').quantize(COLOURS, dither=Image.Dither.NONE).save(
        small, format='png', optimize=True)
    return small.getvalue()


def legend(results: dict) -> list[tuple[str, str]]:
    """Term and meaning of the page's controllers and conditions."""
    meta = results['meta']
    made = []
    for name in meta['controllers']:
        text = [look(name).text or meta.get('specs', {}).get(name, '')]
        if moved := meta.get('guidance', {}).get(name):
            text.append(f'guidance: {moved}')
        made.append((look(name).label, '; '.join(filter(None, text))))
    made += [(f'{name} conditions', CONDITIONS[name]) for name in meta['conditions']]
    made += [(f'{name}: not flown', reason) for name, reason in meta['skipped'].items()]
    return made


def facts(results: dict) -> list[str]:
    """Code, number of flights, computer and policies."""
    meta = results['meta']
    code = f"beetle_omni_ros {meta['version']}" + \
        (f", commit {meta['commit']}" if meta.get('commit') else '')
    failed = sum(bool(flight['failure']) for flight in results['flights'])
    lines = [code, f"{len(results['flights'])} flights, {failed} failed; seeds "
                   f"{', '.join(map(str, meta['seeds']))}",
             f"{meta['cpu_s'] / 60:.1f} core minutes on {meta['machine']['processor']}"]
    lines += [f"simulated plant: {meta['plant']}"] * bool(meta.get('plant'))
    lines += [f'{look(name).label}: policy {digest}' for name, digest in meta['policies'].items()]
    return lines


def page(results: dict, made: list[Section]) -> str:
    """The self-contained HTML page."""
    body = ''.join(_html_section(section, results) for section in made)
    links = ' · '.join(f'<a href="#{_anchor(section.title)}">{escape(section.title)}</a>'
                       for section in made)
    terms = ''.join(f'<dt>{escape(term)}</dt><dd>{escape(text)}</dd>'
                    for term, text in legend(results))
    return frame(TITLE, '', f"""<p class="note">{'<br>'.join(map(escape, facts(results)))}</p>
<nav>{links}</nav>
<section><p>Every number of ours is <b class="ours">simulated</b>: the same plant, sensors, EKF,
supervisor, actuator models and limits for every controller. Published numbers are
<b class="gazebo">simulated in Gazebo</b> or measured on the <b class="real">real robot</b>,
as each table says.</p><dl>{terms}</dl>
<pre>{escape(results['meta']['command'])}</pre></section>
{body}
<section><details><summary>All flights</summary><div class="scroll"><table class="flights">
<thead><tr><th>task</th><th>conditions</th><th>controller</th><th>seed</th><th>end</th>
<th>core s</th></tr></thead><tbody>{grids.flights(results)}</tbody></table></div></details>
</section>""", shipped('comparison.css'))


def _anchor(title):
    return title.lower().replace(' ', '-')


def _html_section(section, results):
    blocks = ''.join(grid.html(block, results) if isinstance(block, Grid) else
                     f'<figure><div class="scroll"><img alt="{escape(block.caption)}" '
                     f'src="data:image/png;base64,{b64encode(block.data).decode()}"></div>'
                     f'<p class="note">{escape(block.caption)}.</p></figure>'
                     for block in section.blocks)
    text = f'<p>{escape(section.text)}</p>' if section.text else ''
    return (f'<section id="{_anchor(section.title)}"><h2>{escape(section.title)}</h2>{text}'
            f'{blocks}</section>\n')


def markdown(results: dict, made: list[Section], how: str = '') -> str:
    """
    The page as Markdown, with pictures in files beside it.

    ``how`` is a link to the how-to page; '' if that page is absent.
    """
    parts = [f'# {TITLE}\n', 'Made by `make compare`; the same with every detail is '
             '`comparison.html`, all numbers are in `comparison.json`.'
             + (f' [How it is made]({how}).\n' if how else '\n'),
             '\n'.join(f'- {line}' for line in facts(results)) + '\n',
             '\n'.join(f'- **{term}**: {text}' for term, text in legend(results)) + '\n']
    for section in made:
        parts.append(f'## {section.title}\n')
        parts += [section.text + '\n'] if section.text else []
        parts += [grid.markdown(block, results) if isinstance(block, Grid) else
                  f'![{block.caption}]({block.name}.png)\n\n{block.caption}.\n'
                  for block in section.blocks]
    return '\n'.join(parts)
