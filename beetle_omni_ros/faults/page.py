"""Results of a campaign as tables: Markdown and one self-contained page."""

from collections.abc import Callable
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from beetle_omni_ros.faults.trial import Trial
from beetle_omni_ros.pages.page import ABSENT, frame, Grid, html, markdown, section, verdict_head
from beetle_omni_ros.sim.fault_lists import OutcomeLimits

BEGIN = '<!-- faults: begin, written by beetle_omni faults --docs -->'
END = '<!-- faults: end -->'
COLUMNS = ('fault', 'what happens', 'expected', 'flights', 'as expected', 'outcomes',
           'impact median [m/s]', 'impact worst [m/s]', 'named after [s]')
FEW = 15        # faults that the picture shows one by one, and flights that are shown unfolded
NOTE = ('as expected: flights with the expected outcome or a better one. outcomes: with their '
        'number of flights. impact: speed of base_link at the fastest touchdown of a flight. '
        'named after: median time until the supervisor detected a fault.')
FAULT, PARTLY, SUCCESS = '#b3261e', '#d98a1c', '#2f8f5b'
# Outcome -> colour and meaning, the best outcome first.
OUTCOMES: dict[str, tuple[str, str]] = {
    'flies_on': (SUCCESS, 'still flying when the landing was requested; it ended below '
                          '{impact_speed:g} m/s and {degrees:.0f} deg'),
    'refused': ('#7fbf9a', 'the same, and the request was refused'),
    'lands': ('#1f5fa8', 'landed by itself, below {impact_speed:g} m/s and {degrees:.0f} deg'),
    'stops': (PARTLY, 'broke at the floor; the motors were off within {stop_time:g} s and '
                         'stayed off'),
    'hard': ('#e07b5a', 'touched down intact, above {impact_speed:g} m/s'),
    'tilted': ('#b0447a', 'touched down softly but beyond {degrees:.0f} deg'),
    'does not land': ('#7a52a3', 'motors on long after the landing was requested'),
    'crash, motors on': (FAULT, 'broke, and thrust was commanded for more than {stop_time:g} s'),
    'takes off': ('#7c1d17', 'rose by {rise:g} m after lying on the floor for {rest_time:g} s'),
    'flyaway': ('#22272e', '{fence_margin:g} m outside the fence, or {distance:g} m away'),
    'error': ('#6b7580', 'a part of the flight stack raised an exception')}
CSS = """
.faults td:first-child, .faults th:first-child { white-space: nowrap; max-width: none; }
.faults td.message { min-width: 16em; }
.faults svg { display: block; min-width: 620px; width: 100%; height: auto; }
.faults dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 12px; margin: 0; }
.faults dt { font-weight: 600; } .faults dd { margin: 0; color: var(--faint); }
.faults dt i { display: inline-block; width: 10px; height: 10px; border-radius: 2px;
  margin-right: 6px; }
.faults code { overflow-wrap: anywhere; }
.faults summary { font-size: 15px; font-weight: 500; }
"""


def fault_rows(results: dict) -> list[list[str]]:
    """Rows under COLUMNS, from the summary in ``results``."""
    return [[name, row['what'], row['expected'], str(row['flights']), str(row['good']),
             _counted(row['outcomes']), _number(row['impact_median_m_s']),
             _number(row['impact_worst_m_s']), _number(row['named_s'])]
            for name, row in results['summary']['faults'].items()]


def other_tables(results: dict) -> list[tuple[str, tuple[str, ...], list[list[str]]]]:
    """Title, header and rows of landings, healthy flights, if flown."""
    tables = []
    if results.get('landings'):
        tables.append(('Landings from random attitudes', (
            'conditions', 'motion capture', 'landings', 'good', 'outcomes', 'impact median [m/s]',
            'impact worst [m/s]', 'inclination median [deg]', 'inclination worst [deg]'),
            [[row['conditions'], 'yes' if row['mocap'] else 'lost', str(row['landings']),
              str(row['good']), _counted(row['outcomes']), _number(row['impact_median_m_s']),
              _number(row['impact_worst_m_s']), _number(row['inclination_median_deg']),
              _number(row['inclination_worst_deg'])] for row in results['landings']['summary']]))
    if results.get('healthy'):
        tables.append(('Healthy flights', (
            'conditions', 'flights', 'hours', 'alarms', 'not landed', 'errors'),
            [[row['conditions'], str(row['flights']), f"{row['hours']:.2f}",
              _counted(row['alarms']) or 'none', str(row['not_landed']), str(len(row['errors']))]
             for row in results['healthy']['summary']]))
    return tables


def terminal_grids(results: dict) -> list[Grid]:
    """The tables with few columns, so that a terminal of 80 columns shows all names."""
    grids = []
    if results.get('summary'):
        grids.append(Grid('', ['fault', 'expected', 'good', 'outcomes', 'impact [m/s]',
                               'named [s]'],
                          [[name, row['expected'], f"{row['good']}/{row['flights']}",
                            _counted(row['outcomes'], '\n'), _number(row['impact_worst_m_s']),
                            _number(row['named_s'])]
                           for name, row in results['summary']['faults'].items()],
                          note='good: as expected or better. impact: the worst. named: median '
                               'time until a fault was detected.'))
    if results.get('landings'):
        grids.append(Grid('Landings from random attitudes', [
            'conditions', 'MoCap', 'good', 'outcomes', 'impact [m/s]', 'inclination [deg]'],
            [[row['conditions'], 'yes' if row['mocap'] else 'lost',
              f"{row['good']}/{row['landings']}", _counted(row['outcomes'], '\n'),
              _both(row, 'impact', '_m_s'), _both(row, 'inclination', '_deg')]
             for row in results['landings']['summary']],
            note='impact and inclination: median and worst.'))
    for title, header, rows in other_tables({**results, 'landings': None}):
        # The description of a fault is too long for a terminal; the page has it.
        kept = [k for k, name in enumerate(header) if name != 'what happens']
        grids.append(Grid(title, [header[k] for k in kept], [[row[k] for k in kept]
                                                             for row in rows]))
    return grids


def total_text(results: dict) -> str:
    """Summary of the campaign in one sentence, '' without faults."""
    if not results.get('summary'):
        return ''
    total = results['summary']['total']
    bags = '' if total['lost_bags'] is None else f"{total['lost_bags']} lost bags, "
    return (f"{total['good']} of {total['flights']} flights ended as expected; "
            f"{total['flyaways']} flyaways, {total['motors_on_after_crash']} with motors on after "
            f"a crash, {total['takeoffs']} take-offs without arming, {bags}"
            f"{total['errors']} errors.")


def as_markdown(results: dict) -> str:
    """All results as Markdown."""
    parts = [f'# Faults\n\n{results["meta"]["command"]}\n']
    if results.get('summary'):
        parts += [total_text(results) + '\n', markdown(COLUMNS, fault_rows(results))]
    parts += [f'## {title}\n\n{markdown(header, rows)}'
              for title, header, rows in other_tables(results)]
    return '\n'.join(parts)


def as_page(results: dict, folder: Path | None = None) -> str:
    """
    All results as one self-contained HTML page.

    Args:
        results: results of :func:`~beetle_omni_ros.faults.command.run_faults`.
        folder: folder of the page, which contains the recorded bags.

    """
    meta, content = results['meta'], ''
    limits = OutcomeLimits(**meta['limits'])
    if results.get('summary'):
        flights, total = results['flights'], results['summary']['total']
        severe = any(total[key] for key in ('flyaways', 'motors_on_after_crash', 'takeoffs',
                                            'errors', 'lost_bags'))
        every = total['good'] == total['flights']
        content += verdict_head(f"{total['good']} of {total['flights']} as expected",
                                FAULT if severe else SUCCESS if every else PARTLY,
                                total_text(results))
        bad = [one for one in flights if not one['good']]
        content += section('Flights that did not end as expected', '',
                           _flights(bad)) if bad else ''
        content += section('Outcomes', _groups(flights)[0], _bars(flights) + _meanings(limits))
        content += section('Impacts', 'Speed at the fastest touchdown of each flight.',
                           _impacts(flights, limits))
        content += section('Each fault', NOTE, _html(COLUMNS, fault_rows(results)))
        content += section('Each flight', '', _folded(flights, folder))
    for title, header, rows in other_tables(results):
        content += section(title, '', _html(header, rows))
    made = [meta['command'], meta['date'], f"version {meta['version']}"
            + (f", commit {meta['commit']}" if meta['commit'] else '')]
    return frame('Faults', ' · '.join(made), f'<div class="faults">{content}</div>', CSS)


def in_docs(text: str, table: str) -> str:
    """
    Replace the text between the markers by ``table``.

    Raises:
        ValueError: the markers are absent.

    """
    if BEGIN not in text or END not in text:
        raise ValueError(f"expected the lines '{BEGIN}' and '{END}'")
    before, _, rest = text.partition(BEGIN)
    return f'{before}{BEGIN}\n{table}{END}{rest.partition(END)[2]}'


def _flights(flights):
    """Table with one row for each flight."""
    bags = any(one.get('bag_lost') is not None for one in flights)
    header = ['fault', 'from', 'seed', 'conditions', 'expected', 'outcome', 'impact [m/s]',
              'first message', *['bag'] * bags]
    head = ''.join(f'<th>{name}</th>' for name in header)
    return (f'<figure class="table"><div class="scroll"><table><thead><tr>{head}</tr></thead>'
            f'<tbody>{"".join(_row(one, bags) for one in flights)}</tbody></table></div></figure>')


def _row(one, bags):
    colour = OUTCOMES.get(one['outcome'], (FAULT, ''))[0]
    cells = [*(f'<td>{escape(str(one[key]))}</td>' for key in (
        'case', 'start', 'seed', 'conditions', 'expected')),
        f'<td style="color: {colour}">{escape(one["outcome"])}</td>',
        f'<td>{_number(one.get("impact_m_s"))}</td>',
        f'<td class="message">{escape(one.get("said") or one["error"] or ABSENT)}</td>']
    if bags:
        name = str(Trial(*(one[key] for key in ('case', 'start', 'seed', 'conditions',
                                                'controller'))))
        cells.append('<td>lost</td>' if one['bag_lost'] else
                     f'<td><a href="bags/{quote(name)}/">{escape(name)}</a></td>')
    return f'<tr>{"".join(cells)}</tr>\n'


def _folded(flights, folder):
    """The table of flights, folded if long, and the command that opens a bag."""
    opened = ' open' if len(flights) <= FEW else ''
    bags = [one for one in flights if one.get('bag_lost') is False]
    command = f'<p>Page of one flight: <code>beetle_omni report {escape(str(folder))}/bags/NAME ' \
              '--output flight.html</code></p>' if bags and folder else ''
    count = f'{len(flights)} flight{"s" * (len(flights) > 1)}'
    return f'{command}<details{opened}><summary>{count}</summary>{_flights(flights)}</details>'


def _meanings(limits):
    values = {**vars(limits), 'degrees': np.degrees(limits.inclination)}
    rows = ''.join(f'<dt><i style="background: {colour}"></i>{name}</dt>'
                   f'<dd>{escape(text.format(**values))}</dd>'
                   for name, (colour, text) in OUTCOMES.items())
    return f'<details open><summary>Meaning of the outcomes</summary><dl>{rows}</dl></details>'


def _groups(flights) -> tuple[str, dict[str, list[dict]]]:
    """Flights of each fault, or of each start if these are many; with a title."""
    by = 'case' if len({one['case'] for one in flights}) <= FEW else 'start'
    names = dict.fromkeys(one[by] for one in flights)
    title = 'Number of flights of each fault.' if by == 'case' else \
        'Number of flights from each start.'
    return title, {name: [one for one in flights if one[by] == name] for name in names}


WIDTH, LEFT, RIGHT, ROW = 760, 190, 20, 24      # of a picture


def _svg(groups: dict, axis: str, label: str, draw: Callable) -> str:
    """A picture with one row for each group; ``draw`` makes the content of a row."""
    height = ROW * len(groups) + (34 if axis else 6)
    rows = ''.join(
        f'<text x="{LEFT - 10}" y="{ROW * k + 16}" text-anchor="end">{escape(name)}</text>'
        f'{draw(members, ROW * k)}' for k, (name, members) in enumerate(groups.items()))
    return (f'<div class="scroll"><svg viewBox="0 0 {WIDTH} {height}" role="img" '
            f'aria-label="{label}" font-size="12" fill="#22272e">{axis}{rows}</svg></div>')


def _bars(flights):
    """Outcome counts of each group as stacked bars."""
    groups = _groups(flights)[1]
    scale = (WIDTH - LEFT - RIGHT) / max(map(len, groups.values()))

    def bar(members, y):
        x, parts = LEFT, []
        outcomes = [one['outcome'] for one in members]
        for name in [*OUTCOMES, *sorted({*outcomes} - {*OUTCOMES})]:
            count = outcomes.count(name)
            if count:
                colour = OUTCOMES.get(name, (FAULT, ''))[0]
                parts.append(
                    f'<g><title>{escape(name)}: {count}</title><rect x="{x:.1f}" y="{y + 3}" '
                    f'width="{count * scale:.1f}" height="{ROW - 6}" fill="{colour}"/>'
                    + (f'<text x="{x + count * scale / 2:.1f}" y="{y + 16}" fill="#fff" '
                       f'text-anchor="middle">{count}</text>' if count * scale > 16 else '')
                    + '</g>')
            x += count * scale
        return ''.join(parts)
    return _svg(groups, '', 'number of flights with each outcome', bar)


def _impacts(flights, limits):
    """Impact speeds of each group as dots, with the limits of a landing."""
    groups = {name: [one for one in members if one.get('impact_m_s') is not None]
              for name, members in _groups(flights)[1].items()}
    speeds = [one['impact_m_s'] for members in groups.values() for one in members]
    most = max([1.2 * limits.impact_speed, *speeds])
    scale, foot = (WIDTH - LEFT - RIGHT) / most, ROW * len(groups)

    def mark(speed, text, colour):
        x = LEFT + scale * speed
        return (f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{foot}" stroke="{colour}" '
                f'stroke-dasharray="4 3"/><text x="{x:.1f}" y="{foot + 28}" fill="{colour}" '
                f'text-anchor="middle">{text}</text>')

    step = next(width for width in (0.2, 0.5, 1, 2, 5, 10, 50) if most / width <= 10)
    ticks = ''.join(f'<text x="{LEFT + scale * speed:.1f}" y="{foot + 14}" fill="#6b7580" '
                    f'text-anchor="middle">{speed:g}</text>'
                    for speed in np.arange(0, most + 1e-9, step))
    # the two labels would overlap on a wide axis
    apart = scale * (limits.impact_speed - limits.landing_speed) > 100
    axis = (ticks + mark(limits.landing_speed, 'landings' if apart else '', '#6b7580')
            + mark(limits.impact_speed, f'breaks above {limits.impact_speed:g} m/s', FAULT))

    def dots(members, y):
        return ''.join(
            f'<circle cx="{LEFT + scale * one["impact_m_s"]:.1f}" cy="{y + 6 + (7 * k) % 13}" '
            f'r="3.5" fill="{OUTCOMES.get(one["outcome"], (FAULT, ""))[0]}" fill-opacity="0.75">'
            f'<title>{escape(one["case"])} {escape(one["start"])} {one["seed"]}: '
            f'{one["impact_m_s"]:.2f} m/s</title></circle>' for k, one in enumerate(members))
    return _svg(groups, axis, 'impact speeds in m/s', dots) + (
        f'<p class="note">Dashed: {limits.landing_speed:g} m/s, limit of the landing campaign, '
        f'and {limits.impact_speed:g} m/s, above which the robot breaks. Colours as above.</p>')


def _html(header, rows):
    return html(Grid('', list(header), rows))


def _counted(counts, between=', '):
    return between.join(f'{count} {text}' for text, count in counts.items())


def _number(value):
    return '' if value is None else f'{value:.2f}'


def _both(row, name, unit):
    median, worst = (row[f'{name}_{which}{unit}'] for which in ('median', 'worst'))
    return ABSENT if median is None else f'{median:.2f}, {worst:.2f}'
