"""The report's HTML: structure and look, free of numbers."""

from __future__ import annotations

from html import escape

CSS = """
:root { --ink: #22272e; --faint: #6b7580; --line: #e3e7ec; --paper: #ffffff; --wash: #f6f7f9; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--wash); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 40px 28px 80px; }
header h1 { font-size: 28px; font-weight: 650; letter-spacing: -0.01em; margin: 0; }
header p { color: var(--faint); margin: 4px 0 24px; }
h2 { font-size: 17px; font-weight: 650; margin: 0 0 2px; }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 8px;
  padding: 20px 24px; margin: 0 0 18px; }
section > p { color: var(--faint); margin: 0 0 10px; }
img { width: 100%; height: auto; display: block; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(250px, 1fr)); gap: 14px;
  margin: 0 0 18px; }
.card { background: var(--paper); border: 1px solid var(--line); border-top: 4px solid;
  border-radius: 8px; padding: 12px 16px; font-size: 13px; overflow-wrap: anywhere; }
.card strong { display: block; font-size: 15px; }
.card span { color: var(--faint); }
.card .warning { color: #a3470b; display: block; }
figure { margin: 0 0 22px; } figure:last-child { margin-bottom: 0; }
figcaption { font-weight: 600; margin: 0 0 6px; }
.note { color: var(--faint); margin: 0 0 8px; font-size: 13px; }
.verdict { border-left: 10px solid; }
.verdict h2 { font-size: 26px; margin: 0 0 6px; }
.verdict p.said { color: var(--ink); font-size: 17px; margin: 0 0 12px; overflow-wrap: anywhere; }
@media (max-width: 600px) { main { padding: 20px 10px 40px; } section { padding: 14px 12px; }
  .verdict h2 { font-size: 21px; } li { overflow-wrap: anywhere; } }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px;
  font-variant-numeric: tabular-nums; }
th { color: var(--faint); font-weight: 500; border-bottom: 1px solid var(--ink); }
th, td { padding: 5px 14px 5px 0; text-align: right; vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; }
td { border-bottom: 1px solid var(--line); white-space: nowrap; }
td.long { white-space: normal; min-width: 16em; }
td.published, th.published { color: #98a1ab; }
tr:hover td { background: var(--wash); }
.faults td, .faults th { text-align: left; white-space: normal; }
summary { cursor: pointer; font-size: 17px; font-weight: 650; }
details[open] summary { margin-bottom: 12px; }
@media print { body { background: none; } section, .card { break-inside: avoid; } }
"""


def card(title: str, colour: str, facts: list[str], warnings: list[str]) -> str:
    """What one run is."""
    lines = ''.join(f'<span class="warning">{escape(text)}</span>' for text in warnings)
    return (f'<div class="card" style="border-top-color: {colour}"><strong>{escape(title)}'
            f'</strong><span>{escape(" · ".join(facts))}</span>{lines}</div>')


def section(title: str, text: str, content: str) -> str:
    """One titled box."""
    paragraph = f'<p>{escape(text)}</p>' if text else ''
    return f'<section><h2>{escape(title)}</h2>{paragraph}{content}</section>\n'


def page(title: str, subtitle: str, cards: list[str], tables: str, sections: list[str],
         poses: list[str], faults: str) -> str:
    """Put the whole page together; everything it needs is in it."""
    folded = f'<section><details><summary>Every pose</summary>{"".join(poses)}</details></section>'
    return frame(title, subtitle, f"""<div class="cards">{''.join(cards)}</div>
<section>{tables}</section>
{''.join(sections)}
{folded if poses else ''}
<section class="faults"><h2>Faults</h2>{faults}</section>""")


def frame(title: str, subtitle: str, content: str) -> str:
    """Return a whole page around ``content``, which is HTML."""
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
{content}
</main>
</body>
</html>
"""
