"""Pictures of the pages: each has a command, and those older than what they show are listed."""

from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / 'docs'


def test_every_picture_has_a_command_and_stale_ones_are_listed(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    import make_pictures as made
    assert set(made.commands()) == {path.relative_to(DOCS).as_posix() for path in DOCS.rglob('*')
                                    if path.suffix in ('.png', '.gif', '.svg')}
    stale, name = made.stale(), 'tutorials/pictures/real_gap.png'
    with monkeypatch.context() as changed:
        changed.setitem(made.PICTURES, name, (made.real_gap, ('params/robot.yaml',)))
        assert set(made.stale()) == set(stale) | {name}
        changed.setitem(made.figures.LINES, 'rl', ('#000000', '-'))
        assert set(made.stale()) == set(made.commands())
    if stale:
        pytest.skip('older than what they show: ' + '; '.join(map(': '.join, stale.items())))
