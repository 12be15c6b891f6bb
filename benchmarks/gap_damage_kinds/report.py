"""Tables and files of the results."""

from __future__ import annotations

import json
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gap_damage_kinds.judge import Judged
from gap_damage_kinds.kind import HARMLESS, Kind, LIE

MARKS = {True: 'yes', False: 'no', None: '–'}
GOAL = 0.9      # of causes in words


def totals(results: dict[str, list[Judged]], kinds: dict[str, Kind]) -> dict:
    """Counts over all kinds of damage, and over the controls."""
    bad = [(kinds[n], j) for n, row in results.items() for j in row if kinds[n].harm != HARMLESS]
    lies = [j for kind, j in bad if kind.harm == LIE]
    controls = [j for n, row in results.items() for j in row if kinds[n].harm == HARMLESS]
    every = [j for _, j in bad]
    return {
        'damaged': len(every), 'bad_data': sum(j.verdict == 'bad_data' for j in every),
        'no_gap': sum(j.verdict == 'no_gap' for j in every),
        'no_gap_of_lies': sum(j.verdict == 'no_gap' for j in lies),
        'no_gap_without_cause': sum(j.verdict == 'no_gap' and not j.cause for j in every),
        'named': sum(bool(j.names) for j in every),
        'named_falsely': sum(bool(j.false_names) for j in every),
        'cause': sum(bool(j.cause) for j in every),
        'topic': sum(bool(j.topic) for j in every),
        'onset': sum(bool(j.onset) for j in every),
        'onsets': sum(j.onset is not None for j in every),
        'right': sum(j.right for j in every),
        'controls': len(controls), 'controls_right': sum(j.right for j in controls),
        'unanswered': sum(j.verdict in ('timeout', 'no answer') for j in every + controls)}


def goals(t: dict) -> list[tuple[str, str, bool]]:
    """Name, count and whether it is reached."""
    share = t['cause'] / t['damaged'] if t['damaged'] else 1.0
    return [('never no gap (false data)', str(t['no_gap_of_lies']), t['no_gap_of_lies'] == 0),
            ('no gap, all damage', str(t['no_gap']), t['no_gap'] == 0),
            ('no gap without the cause in words', str(t['no_gap_without_cause']),
             t['no_gap_without_cause'] == 0),
            ('any effect named', str(t['named']), t['named'] == 0),
            ('body, rotor or joint named falsely', str(t['named_falsely']),
             t['named_falsely'] == 0),
            ('cause in words', f"{t['cause']} of {t['damaged']}", share >= GOAL),
            ('right topic', f"{t['topic']} of {t['damaged']}", t['topic'] >= GOAL * t['damaged']),
            ('onset within 2 s', f"{t['onset']} of {t['onsets']}",
             t['onset'] >= GOAL * t['onsets']),
            ('controls used', f"{t['controls_right']} of {t['controls']}",
             t['controls_right'] == t['controls']),
            ('not answered', str(t['unanswered']), t['unanswered'] == 0)]


def rows(results: dict[str, list[Judged]], kinds: dict[str, Kind]) -> list[list[str]]:
    """A row for each kind: name, verdicts, false names, cause, topic, onset, right, seconds."""
    made = []
    for name, row in results.items():
        verdicts = ', '.join(j.verdict for j in row)
        named = ', '.join(sorted({n for j in row for n in j.names}))
        made.append([name, kinds[name].harm, verdicts, named or '–', *(
            _share([getattr(j, key) for j in row]) for key in ('cause', 'topic', 'onset', 'right')
        ), f'{max(j.seconds for j in row):.0f}'])
    return made


def _share(values):
    known = [v for v in values if v is not None]
    return f'{sum(known)}/{len(known)}' if known else '–'


HEAD = ('kind', 'harm', 'verdicts', 'named', 'cause', 'topic', 'onset', 'right', 'longest [s]')


def show(results: dict[str, list[Judged]], kinds: dict[str, Kind], console: Console) -> None:
    """Print the table and the totals."""
    table = Table(*HEAD)
    for row in rows(results, kinds):
        done, of = row[7].split('/')
        table.add_row(*map(escape, row), style='green' if done == of else 'red')
    Console(width=max(console.width, 130)).print(table)
    for name, count, reached in goals(totals(results, kinds)):
        console.print(f'{name}: {count}', style='green' if reached else 'red', highlight=False)


def write(results: dict[str, list[Judged]], kinds: dict[str, Kind], meta: dict,
          output: Path) -> None:
    """Write damage.json and damage.md."""
    output.mkdir(parents=True, exist_ok=True)
    data = {'meta': meta, 'totals': totals(results, kinds),
            'kinds': {name: {'description': kinds[name].description, 'harm': kinds[name].harm,
                             'sets': [j.plain() for j in row]} for name, row in results.items()}}
    (output / 'damage.json').write_text(json.dumps(data, indent=1) + '\n')
    (output / 'damage.md').write_text(markdown(results, kinds, meta))


def markdown(results: dict[str, list[Judged]], kinds: dict[str, Kind], meta: dict) -> str:
    """Totals, table and statements."""
    lines = ['# Damaged recordings', '', f"`{meta['command']}`", '', '| total | | |',
             '| --- | --- | --- |']
    lines += [f'| {name} | {count} | {MARKS[reached]} |'
              for name, count, reached in goals(totals(results, kinds))]
    lines += ['', '| ' + ' | '.join(HEAD) + ' |', '| --- ' * len(HEAD) + '|']
    lines += ['| ' + ' | '.join(row) + ' |' for row in rows(results, kinds)]
    lines += ['', '## What was said', '']
    for name, row in results.items():
        said = list(dict.fromkeys(j.said.replace('\n', ' ')[:300] for j in row))
        lines += [f'- **{name}** ({kinds[name].description}): ' + ' / '.join(said)]
    return '\n'.join(lines) + '\n'
