"""Tables of text for the terminal, as Markdown and as HTML."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

from rich.console import Console
from rich.table import Table
from rich.text import Text

ABSENT = '–'
LONGEST_TITLE = 78      # characters that fit on one line of a terminal
PUBLISHED = ' class="published"'
LONG = ' class="long"'
LONGEST_CELL = 45       # characters that fit on one line of a page's cell


@dataclass(frozen=True)
class Grid:
    """
    A table of text.

    Attributes:
        title: one line.
        header: titles of the columns.
        rows: cells of each row.
        faint: indices of rows with published results.
        faint_columns: indices of columns with published results.
        note: meaning of the columns, below the title.

    """

    title: str
    header: list[str]
    rows: list[list[str]]
    faint: frozenset[int] = frozenset()
    faint_columns: frozenset[int] = frozenset()
    note: str = ''


def print_grids(shown: list[Grid], console: Console) -> None:
    """Print tables to the terminal."""
    for grid in shown:
        console.print(_rich(grid))
        if grid.note:
            console.print(grid.note, style='dim', highlight=False, markup=False)


def _rich(grid):
    table = Table(title=Text(grid.title), title_justify='left', title_style='', box=None,
                  min_width=min(len(grid.title), LONGEST_TITLE), header_style='dim',
                  padding=(0, 2, 0, 0))
    for k, name in enumerate(grid.header):
        table.add_column(Text(name), justify='left' if k == 0 else 'right', overflow='fold',
                         no_wrap=k == 0, style='dim' if k in grid.faint_columns else None)
    for k, row in enumerate(grid.rows):
        table.add_row(*(Text(cell) for cell in row),
                      style='dim' if k in grid.faint else None)
    return table


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]], numeric: bool = False) -> str:
    """Return GitHub Markdown; ``numeric`` aligns all columns but the first to the right."""
    rule = ['---'] + ['---:' if numeric else '---'] * (len(header) - 1)
    return ''.join('| ' + ' | '.join(cell.replace('|', '\\|') for cell in line) + ' |\n'
                   for line in (header, rule, *rows))


def html(grid: Grid) -> str:
    """Return a table as HTML."""
    def cell(tag, text, row, column):
        faint = row in grid.faint or column in grid.faint_columns
        style = PUBLISHED if faint else LONG if len(text) > LONGEST_CELL else ''
        return f'<{tag}{style}>{escape(text)}</{tag}>'

    head = ''.join(cell('th', text, None, k) for k, text in enumerate(grid.header))
    body = ''.join(
        '<tr>' + ''.join(cell('td', text, row, k) for k, text in enumerate(cells)) + '</tr>\n'
        for row, cells in enumerate(grid.rows))
    note = f'<p class="note">{escape(grid.note)}</p>' if grid.note else ''
    title = f'<figcaption>{escape(grid.title)}</figcaption>' if grid.title else ''
    return (f'<figure class="table">{title}{note}'
            f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
            f'<tbody>{body}</tbody></table></div></figure>\n')
