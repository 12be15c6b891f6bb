"""One self-contained HTML page about an identification."""

from __future__ import annotations

from html import escape

from beetle_omni_ros.runs.report_page import frame
from beetle_omni_ros.runs.table import Grid
from beetle_omni_ros.runs.table import html as table_html


def page(title: str, subtitle: str, grids: list[Grid], notes: list[str],
         sections: list[str]) -> str:
    """
    Put a page together.

    Args:
        title: of the page.
        subtitle: below it.
        grids: tables.
        notes: sentences below the tables.
        sections: HTML made by :func:`beetle_omni_ros.runs.report_page.section`.

    """
    said = ''.join(f'<li>{escape(note)}</li>' for note in notes)
    return frame(title, subtitle, f"""<section>{''.join(table_html(grid) for grid in grids)}
{f'<ul>{said}</ul>' if said else ''}</section>
{''.join(sections)}""")
