"""
Tables of numbers from the results, and their HTML and Markdown.

A cell is a list of texts and numbers. A number is a path in the JSON, so that page and JSON
cannot differ.
"""

from dataclasses import dataclass, field
from html import escape
from math import isfinite

from beetle_omni_ros.comparison.style import look
from beetle_omni_ros.pages import table
from beetle_omni_ros.pages.table import ABSENT


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


OURS = 'ours, simulated'
GAZEBO = 'published, simulated (Gazebo)'
REAL = 'published, real robot'


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


def numbers(grid: Grid):
    """All numbers of a table."""
    for _, cells in grid.rows:
        for cell in cells:
            yield from (part for part in (*cell.main, *cell.small) if isinstance(part, Number))


def _groups(grid):
    """(group, number of its columns) of adjacent columns."""
    groups: list[list] = []
    for column in grid.columns:
        if groups and groups[-1][0] == column.group:
            groups[-1][1] += 1
        else:
            groups.append([column.group, 1])
    return groups


def html(grid: Grid, results: dict) -> str:
    """Table, notes and commands as HTML; numbers have their path in ``data-key``."""
    kinds = [_kind(column.group) for column in grid.columns]
    first = [k == 0 or grid.columns[k - 1].group != column.group
             for k, column in enumerate(grid.columns)]
    classes = [kind + (' first' if new else '') for kind, new in zip(kinds, first, strict=True)]
    top = '<th></th>' + ''.join(
        f'<th colspan="{count}" class="group {_kind(group)}">{escape(group)}</th>'
        for group, count in _groups(grid))
    head = '<th></th>' + ''.join(
        f'<th class="{name}"><i style="background: {look(column.controller).colour}"></i>'
        f'{escape(look(column.controller).label)}</th>'
        for name, column in zip(classes, grid.columns, strict=True))
    body = ''.join(
        f'<tr><th scope="row">{escape(name)}</th>' + ''.join(
            f'<td class="{kind}{" best" if cell.best else ""}">{_html_cell(cell, results)}</td>'
            for kind, cell in zip(classes, cells, strict=True)) + '</tr>\n'
        for name, cells in grid.rows)
    return (f'<figure class="table"><figcaption>{escape(grid.title)}</figcaption>'
            f'<div class="scroll"><table><thead><tr class="groups">{top}</tr><tr>{head}</tr>'
            f'</thead>\n<tbody>{body}</tbody></table></div>{_html_notes(grid)}</figure>\n')


def _kind(group):
    return {GAZEBO: 'gazebo', REAL: 'real'}.get(group, 'ours')


def _html_cell(cell, results):
    small = ''.join(_html_part(part, results) for part in cell.small)
    return ''.join(_html_part(part, results) for part in cell.main) + \
        (f'<small>{small}</small>' if small else '')


def _html_part(part, results):
    if not isinstance(part, Number):
        return escape(part)
    key = '/'.join(str(entry) for entry in part.path)
    return f'<span data-key="{escape(key)}">{part.text(results)}</span>'


def _html_notes(grid):
    notes = ' '.join(escape(note) for note in grid.notes)
    commands = escape('\n'.join(grid.commands))
    return (f'<p class="note">{notes}</p>' if notes else '') + \
        (f'<pre>{commands}</pre>' if commands else '')


def markdown(grid: Grid, results: dict) -> str:
    """Table, notes and commands as GitHub Markdown."""
    multiple = len(_groups(grid)) > 1
    head = [f'{look(column.controller).label}'
            + (f' ({column.group})' if multiple and column.group != OURS else '')
            for column in grid.columns]
    rows = [[name, *(_markdown_cell(cell, results) for cell in cells)]
            for name, cells in grid.rows]
    lines = [f'**{grid.title}**', '', table.markdown(['', *head], rows, numeric=True).rstrip()]
    lines += ['', ' '.join(grid.notes)] if grid.notes else []
    lines += ['', '```sh', *grid.commands, '```'] if grid.commands else []
    return '\n'.join(lines) + '\n'


def _markdown_cell(cell, results):
    main, small = (''.join(part.text(results) if isinstance(part, Number) else part
                           for part in parts) for parts in (cell.main, cell.small))
    main = f'**{main}**' if cell.best else main
    return f'{main} {small}'.strip()
