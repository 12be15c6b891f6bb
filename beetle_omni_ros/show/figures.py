"""Style of figures, and figures as part of a page."""

import base64
from collections.abc import Iterable
from io import BytesIO
from typing import Any
from zlib import crc32

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from beetle_omni_ros.bags.log import FlightLog

# Every colour of a figure, page or scene that has a meaning.
BLUE, RED, GREEN, AMBER, VIOLET, GREY = COLOURS = (
    '#1b5fb4', '#c8281e', '#2f8f5b', '#d98a1c', '#7a52a3', '#5b6770')
OTHERS = (GREEN, VIOLET, '#008c95', '#a0522d', '#6b7f1e', '#b0447a')  # of what has no colour
PARTS = (BLUE, AMBER, GREEN, '#b0447a')     # one for each joint, rotor or axis
BEFORE, AFTER = AMBER, GREEN    # a model before and after an identification
INK, FAINT = '#22272e', '#8a939d'
WIDTH = 9.6  # [in] of a page-wide figure
# Controller -> colour and dashes: blue for RL and red for NMPC as in the publication. The variants
# are lighter and dashed, so that readers who cannot distinguish the colours can also read them.
LINES: dict[str, tuple[str, str | tuple]] = {
    'nmpc': (RED, '-'),
    'rl': (BLUE, '-'),
    'rl_bare': ('#0b2d5c', (0, (2, 1))),
    'rl_any': ('#58b4e8', (0, (5, 1.6))),
    'rl_published': ('#3f8f8a', (0, (4, 1, 1, 1))),
    'nmpc_corrected': ('#b5651d', (0, (5, 1.2))),
    'nmpc_published': ('#e8960c', (0, (3, 1.2, 1, 1.2))),
    'hover': (GREY, (0, (1, 1.2)))}

STYLE: dict[Any, Any] = {
    'font.family': 'sans-serif', 'font.size': 9, 'axes.titlesize': 9.5, 'axes.titleweight': 'bold',
    'axes.titlelocation': 'left', 'axes.edgecolor': FAINT, 'axes.labelcolor': INK,
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.linewidth': 0.7,
    'axes.grid': True, 'grid.color': '#e6e9ed', 'grid.linewidth': 0.6, 'axes.axisbelow': True,
    'xtick.color': INK, 'ytick.color': INK, 'xtick.major.size': 2.5, 'ytick.major.size': 2.5,
    'text.color': INK, 'legend.frameon': False, 'legend.fontsize': 8.5, 'lines.linewidth': 1.2,
    'path.simplify_threshold': 1.0, 'svg.hashsalt': 'beetle_omni', 'svg.fonttype': 'path',
    'figure.dpi': 100}


def line_of(controller: str) -> tuple[str, str | tuple]:
    """Colour and dashes of a controller; its name decides those of one outside the package."""
    return LINES.get(controller, (OTHERS[crc32(controller.encode()) % len(OTHERS)],
                                  (0, (4, 1, 1, 1))))


def colours_of(logs: Iterable[FlightLog]) -> list[str]:
    """One colour for each flight: that of its controller, or a free one if it is taken."""
    made: list[str] = []
    for log in logs:
        first = line_of(next(iter(log.controllers()), ''))[0]
        made.append(next((colour for colour in (first, *OTHERS, *COLOURS[2:])
                          if colour not in made), FAINT))
    return made


def panels(rows: int, columns: int = 1, height: float = 1.5, **options):
    """
    Make a figure of panels.

    Returns:
        The figure and a (rows, columns) array of its axes.

    """
    figure = Figure(figsize=(WIDTH, height * rows + 0.5), layout='constrained')
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    return figure, axes


def legend(figure: Figure, axes: Axes) -> None:
    """Add one legend above the whole figure."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:     # in rows of equal length
        rows = -(-len(labels) // 6)
        figure.legend(handles, labels, loc='outside upper left', ncols=-(-len(labels) // rows))


def svg(figure: Figure, alternative: str) -> str:
    """Return a figure as an <img> with its SVG, so that styles of figures do not interfere."""
    buffer = BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None})
    data = base64.b64encode(buffer.getvalue()).decode()
    return (f'<div class="scroll"><img alt="{alternative}" '
            f'src="data:image/svg+xml;base64,{data}"></div>')
