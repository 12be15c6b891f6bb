"""One self-contained HTML page about an identification."""

from __future__ import annotations

from html import escape

from beetle_omni_ros.pages.page import frame
from beetle_omni_ros.runs.table import Grid
from beetle_omni_ros.runs.table import html as table_html


def page(title: str, subtitle: str, grids: list[Grid], notes: list[str],
         sections: list[str], head: str = '') -> str:
    """
    Put a page together.

    Args:
        title: of the page.
        subtitle: below it.
        grids: tables.
        notes: sentences below the tables.
        sections: HTML made by :func:`beetle_omni_ros.pages.page.section`.
        head: HTML above the tables, such as :func:`verdict_head`.

    """
    said = ''.join(f'<li>{escape(note)}</li>' for note in notes)
    return frame(title, subtitle, f"""{head}<section>{''.join(table_html(grid) for grid in grids)}
{f'<ul>{said}</ul>' if said else ''}</section>
{''.join(sections)}""")


def verdict_head(word: str, colour: str, sentence: str, picture: str = '') -> str:
    """Verdict, the sentence that says it, and the one picture that shows it, as HTML."""
    return (f'<section class="verdict" style="border-left-color: {colour}">'
            f'<h2>{escape(word)}</h2><p class="said">{escape(sentence)}</p>{picture}</section>\n')
