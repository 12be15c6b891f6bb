"""Results of a campaign as tables: Markdown and one self-contained page."""

from beetle_omni_ros.pages.page import frame, section
from beetle_omni_ros.pages.table import Grid, html, markdown

BEGIN = '<!-- faults: begin, written by beetle_omni faults --docs -->'
END = '<!-- faults: end -->'
COLUMNS = ('fault', 'what happens', 'expected', 'flights', 'as expected', 'outcomes',
           'impact median [m/s]', 'impact worst [m/s]', 'named after [s]')


def fault_rows(results: dict) -> list[list[str]]:
    """Rows under COLUMNS, from the summary in ``results``."""
    return [[name, row['what'], row['expected'], str(row['flights']), str(row['good']),
             _counted(row['outcomes']), _number(row['impact_median_m_s']),
             _number(row['impact_worst_m_s']), _number(row['named_s'])]
            for name, row in results['summary']['faults'].items()]


def other_tables(results: dict) -> list[tuple[str, tuple[str, ...], list[list[str]]]]:
    """Title, header and rows of landings, healthy flights and ROS, if flown."""
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
    if results.get('ros'):
        tables.append(('Through ROS', (
            'fault', 'what happens', 'expected', 'outcome', 'as expected', 'named',
            'impact [m/s]', 'motors off after the crash [s]', 'bag'),
            [[row['case'], row['what'], row['expected'],
              f"{row['outcome']} {row['error']}".strip(), 'yes' if row['good'] else 'no',
              row['named'], _number(row['impact_m_s']), _number(row['stopped_s']),
              'lost' if row['bag_lost'] else 'kept'] for row in results['ros']]))
    return tables


def total_text(results: dict) -> str:
    """Summary of the campaign in one sentence, '' without faults."""
    if not results.get('summary'):
        return ''
    total = results['summary']['total']
    bags = 'bags not recorded' if total['lost_bags'] is None else f"{total['lost_bags']} lost bags"
    return (f"{total['good']} of {total['flights']} flights ended as expected; "
            f"{total['flyaways']} flyaways, {total['motors_on_after_crash']} with motors on after "
            f"a crash, {total['takeoffs']} take-offs without arming, {bags}, "
            f"{total['errors']} errors.")


def as_markdown(results: dict) -> str:
    """All results as Markdown."""
    parts = [f'# Faults\n\n{results["meta"]["command"]}\n']
    if results.get('summary'):
        parts += [total_text(results) + '\n', markdown(COLUMNS, fault_rows(results))]
    parts += [f'## {title}\n\n{markdown(header, rows)}'
              for title, header, rows in other_tables(results)]
    return '\n'.join(parts)


def as_page(results: dict) -> str:
    """All results as one self-contained HTML page."""
    content = ''
    if results.get('summary'):
        content += section('Faults', total_text(results), _html(COLUMNS, fault_rows(results)))
        bad = [[result['case'], result['start'], str(result['seed']), result['conditions'],
                result['outcome'], _number(result.get('impact_m_s')),
                result.get('said') or result['error']]
               for result in results['flights'] if not result['good']]
        content += section('Flights that did not end as expected', '', _html(
            ('fault', 'from', 'seed', 'conditions', 'outcome', 'impact [m/s]', 'first complaint'),
            bad)) if bad else ''
    for title, header, rows in other_tables(results):
        content += section(title, '', _html(header, rows))
    return frame('Faults', results['meta']['command'], f'<div class="faults">{content}</div>')


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


def _html(header, rows):
    return html(Grid('', list(header), rows))


def _counted(counts):
    return ', '.join(f'{count} {text}' for text, count in counts.items())


def _number(value):
    return '' if value is None else f'{value:.2f}'
