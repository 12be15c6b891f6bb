"""Sentences and lines of Markdown files; the tests in test/docs hold the limits."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 35            # words in a sentence
COLUMNS = 99            # characters in a line of text
ABBREVIATIONS = ('e.g.', 'i.e.', 'approx.', 'vs.', 'et al.')

_FENCE = re.compile(r'^\s*(```|~~~)')
_TABLE = re.compile(r'^\s*\|')
_HEADING = re.compile(r'^(#{1,6})\s+(.*?)\s*#*$')
_ITEM = re.compile(r'^\s*(?:[-*+]|\d+[.)])\s+')
_LINK = re.compile(r'!?\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]*)(?:\s+"[^"]*")?\)')
_CODE = re.compile(r'(`+)(.+?)\1')
_END = re.compile(r'(?<=[.!?])["\')\]*_]*\s+(?=["\'(\[*_]*[A-Z0-9`])')


class Line(NamedTuple):
    """One line of a page outside fenced code."""

    number: int
    text: str


def lines(text: str) -> Iterator[Line]:
    """Lines of a page that are not in fenced code or in comments."""
    fence = None
    comment = False
    for number, line in enumerate(text.splitlines(), 1):
        mark = _FENCE.match(line)
        if mark and fence in (None, mark[1]):
            fence = None if fence else mark[1]
        elif not fence:
            comment = comment or line.lstrip().startswith('<!--')
            if not comment:
                yield Line(number, line)
            comment = comment and '-->' not in line


def paragraphs(text: str) -> Iterator[Line]:
    """Paragraphs and list items as single lines; no headings, tables, code or pictures."""
    start, parts = 0, []
    for number, line in (*lines(text), Line(0, '')):
        code = not parts and re.match(r'^ {4}(?!\s*([-*+]|\d+[.)])\s)', line)
        apart = not line.strip() or code or _TABLE.match(line) or _HEADING.match(line)
        if (apart or _ITEM.match(line)) and parts:
            yield Line(start, ' '.join(parts))
            parts = []
        if not apart:
            start = start if parts else number
            parts.append(_ITEM.sub('', line).strip())


def sentences(text: str) -> Iterator[Line]:
    """Sentences with the line on which their paragraph begins."""
    for number, paragraph in paragraphs(text):
        plain = _CODE.sub('Code', _LINK.sub(lambda link: link[1], paragraph))
        for short in ABBREVIATIONS:
            plain = plain.replace(short, short.replace('.', ''))
        for sentence in _END.split(plain):
            if words(sentence):
                yield Line(number, sentence.strip())


def words(sentence: str) -> int:
    """Words of a sentence: what holds a letter or a digit; inline code is one word."""
    return sum(any(c.isalnum() for c in part) for part in sentence.split())


def too_long(text: str) -> list[Line]:
    """Sentences of more than LONGEST words."""
    return [sentence for sentence in sentences(text) if words(sentence.text) > LONGEST]


def too_wide(text: str) -> list[Line]:
    """Lines of text beyond COLUMNS; tables and lines without a blank to break at are free."""
    return [line for line in lines(text) if len(line.text) > COLUMNS
            and not _TABLE.match(line.text) and not line.text.lstrip().startswith('![')]


def written() -> list[Path]:
    """Every page of the repository."""
    return sorted([ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'policies' / 'README.md',
                   ROOT / 'benchmarks' / 'gap_data' / 'README.md',
                   *(ROOT / 'docs').rglob('*.md')])
