"""Style of figures, and figures as part of a page."""

import base64
from io import BytesIO
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = ('#1f5fa8', '#d1432f', '#2f8f5b', '#d98a1c', '#7a52a3', '#5b6770')  # one for each run
PARTS = ('#1f5fa8', '#d98a1c', '#2f8f5b', '#b0447a')  # one for each joint, rotor or axis
INK, FAINT = '#22272e', '#8a939d'
WIDTH = 9.6  # [in] of a page-wide figure
# Controller -> colour and dashes: blue for RL and red for NMPC as in the publication. The variants
# are lighter and dashed, so that readers who cannot distinguish the colours can also read them.
LINES: dict[str, tuple[str, str | tuple]] = {
    'nmpc': ('#c8281e', '-'),
    'rl': ('#1b5fb4', '-'),
    'rl_bare': ('#0b2d5c', (0, (2, 1))),
    'rl_any': ('#58b4e8', (0, (5, 1.6))),
    'rl_late': ('#4b3f9e', (0, (6, 1.6))),
    'rl_published': ('#3f8f8a', (0, (4, 1, 1, 1))),
    'nmpc_corrected': ('#b5651d', (0, (5, 1.2))),
    'nmpc_published': ('#e8960c', (0, (3, 1.2, 1, 1.2))),
    'hover': ('#5b6770', (0, (1, 1.2)))}

STYLE: dict[Any, Any] = {
    'font.family': 'sans-serif', 'font.size': 9, 'axes.titlesize': 9.5, 'axes.titleweight': 'bold',
    'axes.titlelocation': 'left', 'axes.edgecolor': FAINT, 'axes.labelcolor': INK,
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.linewidth': 0.7,
    'axes.grid': True, 'grid.color': '#e6e9ed', 'grid.linewidth': 0.6, 'axes.axisbelow': True,
    'xtick.color': INK, 'ytick.color': INK, 'xtick.major.size': 2.5, 'ytick.major.size': 2.5,
    'text.color': INK, 'legend.frameon': False, 'legend.fontsize': 8.5, 'lines.linewidth': 1.2,
    'path.simplify_threshold': 1.0, 'svg.hashsalt': 'beetle_omni', 'svg.fonttype': 'path',
    'figure.dpi': 100}


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
    if handles:
        figure.legend(handles, labels, loc='outside upper right', ncols=min(6, len(labels)))


def svg(figure: Figure, alternative: str) -> str:
    """Return a figure as an <img> with its SVG, so that styles of figures do not interfere."""
    buffer = BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None})
    data = base64.b64encode(buffer.getvalue()).decode()
    return (f'<div class="scroll"><img alt="{alternative}" '
            f'src="data:image/svg+xml;base64,{data}"></div>')
