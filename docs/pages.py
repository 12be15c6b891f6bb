"""
Sentences, links and anchors of Markdown files.

``python docs/pages.py [FILE...]`` prints the mean and the longest sentence of each page. The tests
in test/docs hold the limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import sys
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


def links(text: str) -> Iterator[Line]:
    """Targets of links and pictures, with their lines."""
    for number, line in lines(text):
        for found in _LINK.finditer(_CODE.sub(lambda code: 'x' * len(code[0]), line)):
            yield Line(number, found[2])


def anchors(text: str) -> set[str]:
    """Anchors of a page's headings, as the site and the repository's pages make them."""
    found: dict[str, int] = {}
    for _, line in lines(text):
        heading = _HEADING.match(line)
        if heading:
            plain = _CODE.sub(lambda code: code[2], _LINK.sub(lambda link: link[1], heading[2]))
            name = re.sub(r'[^\w\- ]', '', plain.lower()).strip().replace(' ', '-')
            found[name] = found.get(name, 0) + 1
    return found.keys() | {f'{name}_{i}' for name, n in found.items() for i in range(1, n)}


def broken_links(page: Path) -> list[str]:
    """Relative links of a page that lead to no file or to no heading."""
    text, broken = page.read_text(encoding='utf-8'), []
    for number, target in links(text):
        if re.match(r'[a-z]+:', target):
            continue
        path, _, anchor = target.partition('#')
        file = (page.parent / path).resolve() if path else page
        if not file.exists():
            broken.append(f'{page}:{number}: {target}: no such file')
        elif anchor and file.suffix == '.md' \
                and anchor not in anchors(file.read_text(encoding='utf-8')):
            broken.append(f'{page}:{number}: {target}: no such heading')
    return broken


def written() -> list[Path]:
    """Every page of the repository."""
    return sorted([ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'policies' / 'README.md',
                   ROOT / 'benchmarks' / 'gap_data' / 'README.md',
                   *(ROOT / 'docs').rglob('*.md')])


def main(files: list[str]) -> None:
    """Print a table of the pages."""
    for page in [Path(file) for file in files] or written():
        text = page.read_text(encoding='utf-8')
        lengths = [words(sentence.text) for sentence in sentences(text)] or [0]
        print(f'{sum(lengths) / len(lengths):6.1f} words a sentence, longest {max(lengths):3d}, '
              f'{sum(n > LONGEST for n in lengths):3d} over {LONGEST}; '
              f'{len(too_wide(text)):3d} lines over {COLUMNS}: {page}')


if __name__ == '__main__':
    main(sys.argv[1:])
