"""One self-contained HTML page about an identification."""

from __future__ import annotations

from html import escape

from beetle_omni_ros.runs.report_page import CSS
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
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}: {escape(subtitle)}</title>
<style>{CSS}</style>
</head>
<body>
<main>
<header><h1>{escape(title)}</h1><p>{escape(subtitle)}</p></header>
<section>{''.join(table_html(grid) for grid in grids)}
{f'<ul>{said}</ul>' if said else ''}</section>
{''.join(sections)}
</main>
</body>
</html>
"""
