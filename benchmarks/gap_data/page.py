"""The campaign's result for people: a Markdown page."""

from __future__ import annotations


def number(entry: dict) -> str:
    """Value with its interval and count, short."""
    if entry['value'] is None:
        return '-'
    text = f'{entry["value"]:.3g}'
    if entry['interval']:
        text += f' [{entry["interval"][0]:.2g}, {entry["interval"][1]:.2g}]'
    return f'{text} ({entry["count"]})'


def target(row: dict) -> str:
    """The criterion's bound."""
    if row['target'] is None:
        return ''
    if row['relation'] == 'in':
        return f'{row["target"][0]:g} to {row["target"][1]:g}'
    return f'{row["relation"]} {row["target"]:g}'


def markdown(report: dict) -> str:
    """The criteria, and the power."""
    lines = ['# Blind campaign', '', f'{report["meta"]["cases"]} cases: '
             f'`{report["meta"]["command"]}`', '']
    for difficulty, rows in report['criteria'].items():
        if any(row['count'] for row in rows):
            lines += [f'## {difficulty.capitalize()} flights', '', '| | target | |',
                      '|---|---|---|']
            lines += [f'| {row["name"]} | {target(row)} | {number(row)}'
                      f'{" **" if row["reached"] is False else ""} |' for row in rows]
            lines.append('')
    lines += ['`**` misses its target; in brackets the 95 % interval, in parentheses the number '
              'of cases or values.', '']
    if report['power']:
        lines += ['## Power: hard flights, by multiples of the detection limit', '',
                  '| times the limit | named | wrong name |', '|---|---|---|']
        lines += [f'| {row["multiple"]:g} | {number(row["named"])} | {number(row["wrong"])} |'
                  for row in report['power']]
    return '\n'.join(lines) + '\n'
