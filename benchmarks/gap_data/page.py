"""The campaign's result for people: a Markdown table and one self-contained HTML page."""

from __future__ import annotations

from html import escape
import io

import matplotlib
from matplotlib.figure import Figure
import numpy as np

matplotlib.rcParams['svg.fonttype'] = 'none'
matplotlib.rcParams['svg.hashsalt'] = 'gap'
STYLE = """body{font:15px/1.5 sans-serif;max-width:1150px;margin:2em auto;padding:0 1em;
color:#1d2b33}
table{border-collapse:collapse;margin:1em 0}td,th{padding:.25em .7em;text-align:right;
border-bottom:1px solid #d7dde1}td:first-child,th:first-child{text-align:left}
.yes{background:#e2f3e4}.no{background:#f9e0dc}.small{color:#5b6770;font-size:.85em}
svg{max-width:100%;height:auto}h2{margin-top:2em}"""


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


def html(report: dict) -> str:
    """The page: criteria, power curve, confusion matrices, every case."""
    names = list(report['workflows'])
    parts = [f'<h1>Blind campaign</h1><p>{escape(_describe(report))}</p>']
    for difficulty in ('clean', 'hard'):
        tables = [report['workflows'][n]['criteria'][difficulty] for n in names]
        if any(row['count'] for row in tables[0]):
            parts.append(f'<h2>{difficulty.capitalize()} flights</h2>' + _criteria(names, tables))
    first = report['workflows'][names[0]]
    if any(report['workflows'][n]['power'] for n in names):
        parts.append('<h2>Power</h2><p>Share of cases named, by multiples of the detection '
                     'limit; hard flights.</p>' + _power_figure(report))
    for difficulty, table in first['confusion'].items():
        if table:
            parts.append(f'<h2>What {escape(names[0])} answered, {difficulty}</h2>'
                         + _confusion_figure(table))
    parts.append('<h2>Parameter errors</h2>' + _error_figure(report))
    parts.append('<h2>Where it is harder</h2>' + _slices(first['slices']))
    parts.append('<h2>Single effects</h2>' + _effects(first['effects']))
    return ('<!doctype html><html lang="en"><meta charset="utf-8"><title>Blind campaign</title>'
            f'<style>{STYLE}</style><body>' + '\n'.join(parts) + '</body></html>')


def _criteria(names, tables):
    head = ''.join(f'<th>{escape(n)}</th>' for n in names)
    body = ''
    for rows in zip(*tables):
        cells = ''.join(
            f'<td class="{ {True: "yes", False: "no", None: ""}[row["reached"]]}">'
            f'{escape(number(row))}</td>' for row in rows)
        body += (f'<tr><td>{escape(rows[0]["name"])}</td><td>{escape(target(rows[0]))}</td>'
                 f'{cells}</tr>')
    return f'<table><tr><th></th><th>target</th>{head}</tr>{body}</table>'


def _svg(figure) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format='svg', bbox_inches='tight', metadata={'Date': None})
    text = buffer.getvalue()
    return text[text.index('<svg'):]


def _power_figure(report):
    figure = Figure(figsize=(7, 3.6))
    axes = figure.subplots()
    for name, result in report['workflows'].items():
        rows = [r for r in result['power'] if r['named']['count']]
        if not rows:
            continue
        x, y = [r['multiple'] for r in rows], [r['named']['value'] for r in rows]
        ends = np.array([r['named']['interval'] for r in rows]).T
        line, = axes.plot(x, y, 'o-', label=f'{name}: right name')
        axes.fill_between(x, *ends, alpha=0.12, color=line.get_color())
        axes.plot(x, [r['wrong']['value'] for r in rows], ':', color=line.get_color(),
                  label=f'{name}: any wrong name')
    axes.set(xlabel='size over detection limit', ylabel='share of cases', ylim=(-0.03, 1.03),
             xscale='log')
    axes.set_xticks([0.5, 1, 2, 3, 6], ['0.5', '1', '2', '3', '6'])
    axes.legend(fontsize=8, frameon=False, loc='center left', bbox_to_anchor=(1, 0.5))
    return _svg(figure)


def _confusion_figure(table):
    truths = list(table)
    answers = sorted({a for counts in table.values() for a in counts},
                     key=lambda a: (a not in truths, truths.index(a) if a in truths else 0, a))
    counts = np.array([[table[t].get(a, 0) for a in answers] for t in truths], float)
    figure = Figure(figsize=(2 + 0.28 * len(answers), 1.5 + 0.24 * len(truths)))
    axes = figure.subplots()
    axes.imshow(counts / counts.sum(axis=1, keepdims=True), cmap='Blues', vmin=0, vmax=1,
                aspect='auto')
    for i, j in np.argwhere(counts):
        axes.text(j, i, f'{counts[i, j]:.0f}', ha='center', va='center', fontsize=7,
                  color='white' if counts[i, j] > 0.6 * counts[i].sum() else '#1d2b33')
    axes.set_xticks(range(len(answers)), answers, rotation=90, fontsize=7)
    axes.set_yticks(range(len(truths)), truths, fontsize=7)
    axes.set(xlabel='answer', ylabel='truth')
    return _svg(figure)


def _error_figure(report):
    figure = Figure(figsize=(7, 3.2))
    axes = figure.subplots()
    for name, result in report['workflows'].items():
        errors = np.sort([row['error'] for row in result['effects'] if row['error'] is not None])
        if len(errors):
            axes.step(np.maximum(errors, 1e-4), (np.arange(len(errors)) + 1) / len(errors),
                      where='post', label=f'{name} ({len(errors)} named)')
    axes.axvline(0.1, color='#9aa5ac', lw=0.8)
    axes.set(xscale='log', xlabel='error over size of the effect', ylabel='share of named cases')
    if axes.lines[1:]:
        axes.legend(fontsize=8, frameon=False)
    return _svg(figure)


def _slices(rows):
    body = ''.join(f'<tr><td>{escape(str(r["field"]))} {escape(str(r["value"]))}</td>'
                   f'<td>{escape(number(r["single_right"]))}</td>'
                   f'<td>{escape(number(r["false_alarm"]))}</td></tr>' for r in rows)
    return f'<table><tr><th></th><th>single right</th><th>false alarm</th></tr>{body}</table>'


def _effects(rows):
    body = ''.join(
        f'<tr class="{"" if r["right"] else "no"}"><td>{escape(r["effect"])}</td>'
        f'<td>{r["difficulty"]}</td><td>{escape(r["shape"])}</td><td>{r["size"]:.3g}</td>'
        f'<td>{escape(", ".join(r["answer"]))}</td>'
        f'<td>{"" if r["error"] is None else format(r["error"], ".2%")}</td>'
        f'<td>{"" if r["closure"] is None else format(r["closure"], ".2f")}</td>'
        f'<td>{r["wall_s"]:.1f}</td></tr>' for r in rows)
    return ('<table class="small"><tr><th>effect</th><th></th><th>shape</th><th>size</th>'
            '<th>answer</th><th>error</th><th>closure</th><th>s</th></tr>' + body + '</table>')
