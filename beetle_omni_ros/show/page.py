"""Tables of text for the terminal, as Markdown and as HTML, and structure and style of pages."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from math import isfinite
import os
from pathlib import Path
import shlex
import sys

from jinja2 import Environment, PackageLoader, select_autoescape
from rich.console import Console
from rich.table import Table
from rich.text import Text

from beetle_omni_ros.model.resources import PACKAGE

ABSENT = '–'
SPACE = 2               # characters between columns
LONGEST_TITLE = 78      # characters that fit on one line of a terminal
PUBLISHED = ' class="published"'
LONG = ' class="long"'
LONGEST_CELL = 45       # characters that fit on one line of a page's cell


def number(value: float | None, digits: int | None = 2) -> str:
    """Return the text of a number; ``digits`` None: as short as possible."""
    if value is None or not isfinite(value):
        return ABSENT
    text = f'{value:g}' if digits is None else f'{value:.{digits}f}'
    return text.removeprefix('-') if float(text) == 0 else text


class Terminal(Console):
    """The console of a command, which still writes its files after `| head` has ended."""

    def on_broken_pipe(self) -> None:
        """Discard all further output."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@dataclass(frozen=True)
class Grid:
    """A table of text."""

    title: str                      # one line
    header: list[str]               # titles of the columns
    rows: list[list[str]]
    faint: frozenset[int] = frozenset()             # indices of rows with published results
    faint_columns: frozenset[int] = frozenset()     # the same of columns
    note: str = ''                  # meaning of the columns, below the title
    best: frozenset[tuple[int, int]] = frozenset()  # (row, column) of cells in bold
    unbroken: int = 1               # number of first columns that a terminal never breaks


def print_grids(shown: list[Grid], console: Console) -> None:
    """Print tables; lines break between words only, and the first columns never."""
    for grid in shown:
        columns = list(zip(grid.header, *grid.rows, strict=True))
        table = Table(title=Text(grid.title) if grid.title else None, title_justify='left',
                      title_style='', box=None, min_width=min(len(grid.title), LONGEST_TITLE),
                      header_style='dim', padding=(0, SPACE, 0, 0))
        for k, (name, *cells) in enumerate(columns):
            words = [word for cell in (name, *cells) for word in (
                [cell] if k < grid.unbroken else cell.split())]
            table.add_column(Text(name), justify='right' if k else 'left',
                             no_wrap=k < grid.unbroken,
                             min_width=max(map(len, words), default=0),
                             style='dim' if k in grid.faint_columns else None)
        for k, row in enumerate(grid.rows):
            table.add_row(*map(Text, row), style='dim' if k in grid.faint else None)
        console.print(table, crop=False)
        if grid.note:
            console.print(grid.note, style='dim', highlight=False, markup=False)


def print_end(console: Console, files: Iterable[Path | None], *then: str | Sequence) -> None:
    """Print the files of a command that exist, and what to do or the commands to type next."""
    lines = [f'files: {file}' for file in files if file and file.exists()]
    lines += [f'next:  {one}' if isinstance(one, str) else
              f"next:  {shlex.join(['beetle_omni', *map(str, one)])}" for one in then]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def markdown(grid: Grid, numeric: bool = False) -> str:
    """Return GitHub Markdown; ``numeric`` aligns all columns but the first to the right."""
    rule = ['---'] + ['---:' if numeric else '---'] * (len(grid.header) - 1)
    rows = [[f'**{cell}**' if (row, k) in grid.best else cell for k, cell in enumerate(cells)]
            for row, cells in enumerate(grid.rows)]
    return ''.join('| ' + ' | '.join(cell.replace('|', '\\|') for cell in line) + ' |\n'
                   for line in (grid.header, rule, *rows))


def html(grid: Grid) -> str:
    """Return a table as HTML."""
    def cell(tag, text, row, column):
        faint = row in grid.faint or column in grid.faint_columns
        style = PUBLISHED if faint else LONG if len(text) > LONGEST_CELL else ''
        shown = f'<b>{escape(text)}</b>' if (row, column) in grid.best else escape(text)
        return f'<{tag}{style}>{shown}</{tag}>'

    head = ''.join(cell('th', text, None, k) for k, text in enumerate(grid.header))
    body = ''.join(
        '<tr>' + ''.join(cell('td', text, row, k) for k, text in enumerate(cells)) + '</tr>\n'
        for row, cells in enumerate(grid.rows))
    note = f'<p class="note">{escape(grid.note)}</p>' if grid.note else ''
    title = f'<figcaption>{escape(grid.title)}</figcaption>' if grid.title else ''
    return (f'<figure class="table">{title}{note}'
            f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n'
            f'<tbody>{body}</tbody></table></div></figure>\n')


def shipped(name: str) -> str:
    """Return the text of a file in this folder."""
    return files(f'{PACKAGE}.show').joinpath(name).read_text(encoding='utf-8')


def section(title: str, text: str, content: str) -> str:
    """Return the HTML of a box with a title and a text."""
    paragraph = f'<p>{escape(text)}</p>' if text else ''
    return f'<section><h2>{escape(title)}</h2>{paragraph}{content}</section>\n'


def verdict_head(word: str, colour: str, sentence: str, picture: str = '') -> str:
    """Return the HTML of a verdict with one sentence and one picture."""
    return (f'<section class="verdict" style="border-left-color: {colour}">'
            f'<h2>{escape(word)}</h2><p class="said">{escape(sentence)}</p>{picture}</section>\n')


def page(title: str, subtitle: str, grids: list[Grid], notes: list[str],
         sections: list[str], head: str = '') -> str:
    """
    Return a page of tables, notes below them and sections.

    ``sections`` are HTML of :func:`section`; ``head`` is HTML above the tables, such as
    :func:`verdict_head`.
    """
    items = ''.join(f'<li>{escape(note)}</li>' for note in notes)
    content = f"""{head}<section>{''.join(map(html, grids))}
{f'<ul>{items}</ul>' if items else ''}</section>
{''.join(sections)}"""
    return rendered('page.html', title=title, subtitle=subtitle, content=content)


def rendered(template: str, **values) -> str:
    """Return a template of this folder with these values, in HTML escaped."""
    environment = Environment(loader=PackageLoader(PACKAGE, 'show'), trim_blocks=True,
                              lstrip_blocks=True, keep_trailing_newline=True,
                              autoescape=select_autoescape())
    environment.globals.update(shipped=shipped, markdown=markdown, html=html)
    return environment.get_template(template).render(**values)
