"""The HTML of a page: structure and look, free of numbers."""

from __future__ import annotations

from html import escape
from importlib.resources import files

from beetle_omni_ros.robot.resources import PACKAGE


def shipped(name: str) -> str:
    """Text of a file beside this module."""
    return files(f'{PACKAGE}.pages').joinpath(name).read_text(encoding='utf-8')


def section(title: str, text: str, content: str) -> str:
    """One titled box."""
    paragraph = f'<p>{escape(text)}</p>' if text else ''
    return f'<section><h2>{escape(title)}</h2>{paragraph}{content}</section>\n'


def frame(title: str, subtitle: str, content: str) -> str:
    """Return a whole page around ``content``, which is HTML; everything it needs is in it."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(title)}: {escape(subtitle)}</title>
<style>{shipped('page.css')}</style>
</head>
<body>
<main>
<header><h1>{escape(title)}</h1><p>{escape(subtitle)}</p></header>
{content}
</main>
</body>
</html>
"""
