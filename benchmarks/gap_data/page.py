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
    """The criteria and power of every workflow side by side, and the first one's confusions."""
    names = list(report['workflows'])
    lines = ['# Blind campaign', '', _describe(report), '']
    for difficulty in ('clean', 'hard'):
        tables = [report['workflows'][n]['criteria'][difficulty] for n in names]
        if not any(row['count'] for row in tables[0]):
            continue
        lines += [f'## {difficulty.capitalize()} flights', '',
                  '| | target | ' + ' | '.join(names) + ' |',
                  '|---|---|' + '---|' * len(names)]
        for rows in zip(*tables):
            cells = [number(row) + (' **' if row['reached'] is False else '') for row in rows]
            lines.append(f'| {rows[0]["name"]} | {target(rows[0])} | ' + ' | '.join(cells) + ' |')
        lines.append('')
    lines += ['`**` misses its target; in brackets the 95 % interval, in parentheses the number '
              'of cases or values.', '', *_power_table(report, names)]
    for difficulty, table in report['workflows'][names[0]]['confusion'].items():
        if table:
            lines += [f'## What {names[0]} answered, {difficulty}', '', '| truth | answers |',
                      '|---|---|']
            lines += [f'| {truth} | ' + ', '.join(
                f'{answer} {count}' for answer, count in sorted(
                    counts.items(), key=lambda item: -item[1])) + ' |'
                for truth, counts in table.items()]
            lines.append('')
    return '\n'.join(lines)


def _power_table(report, names):
    rows = list(zip(*(report['workflows'][n]['power'] for n in names)))
    if not rows:
        return []
    return ['## Power: share named, by multiples of the detection limit, hard flights', '',
            '| times the limit | ' + ' | '.join(f'{n} | {n}, wrong name' for n in names) + ' |',
            '|---|' + '---|---|' * len(names),
            *(f'| {same[0]["multiple"]:g} | ' + ' | '.join(
                f'{number(row["named"])} | {number(row["wrong"])}' for row in same) + ' |'
              for same in rows), '']


def _describe(report):
    meta = report['meta']
    return (f'Set {meta["set"]}, seed {meta["seed"]}, {meta["cases"]} cases, '
            f'commands executed {1000 * meta["command_age"]:g} ms after their stamps; flights of '
            'a generator that shares no equation with the package. The command that makes it '
            f'again: `{meta["command"]}`.')
