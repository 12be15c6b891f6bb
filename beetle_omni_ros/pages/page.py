"""HTML structure and style of a page."""

from html import escape
from importlib.resources import files

from beetle_omni_ros.pages.table import Grid, html
from beetle_omni_ros.robot.resources import PACKAGE


def shipped(name: str) -> str:
    """Return the text of a file in this folder."""
    return files(f'{PACKAGE}.pages').joinpath(name).read_text(encoding='utf-8')


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
    return frame(title, subtitle, f"""{head}<section>{''.join(map(html, grids))}
{f'<ul>{items}</ul>' if items else ''}</section>
{''.join(sections)}""")


def frame(title: str, subtitle: str, content: str, css: str = '') -> str:
    """Return a page with the HTML ``content`` and additional ``css``."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(': '.join(filter(None, (title, subtitle))))}</title>
<style>{shipped('page.css')}{css}</style>
</head>
<body>
<main>
<header><h1>{escape(title)}</h1>{f'<p>{escape(subtitle)}</p>' if subtitle else ''}</header>
{content}
</main>
</body>
</html>
"""
