"""Pictures of the pages: none is older than what it shows."""

from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / 'docs'


@pytest.fixture
def pictures(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    import make_pictures
    return make_pictures


def test_every_picture_is_that_of_its_inputs(pictures):
    assert not pictures.stale(), 'run python docs/make_pictures.py'
    assert all((DOCS / name).is_file() for name in pictures.PICTURES)


def test_a_changed_colour_function_or_file_makes_a_picture_stale(pictures, monkeypatch, tmp_path):
    def own_robot():
        return pictures.figure(1)

    monkeypatch.setattr(pictures, 'own_robot', own_robot)
    entry = pictures.PICTURES['tutorials/pictures/own_robot.png']
    monkeypatch.setitem(pictures.PICTURES, 'tutorials/pictures/own_robot.png',
                        (own_robot, entry[1]))
    entry = pictures.PICTURES['tutorials/pictures/real_gap.png']
    monkeypatch.setitem(pictures.PICTURES, 'tutorials/pictures/real_gap.png',
                        (entry[0], ('params/robot.yaml',)))
    assert pictures.stale() == ['tutorials/pictures/own_robot.png',
                                'tutorials/pictures/real_gap.png']
    monkeypatch.setitem(pictures.figures.LINES, 'rl', ('#000000', '-'))
    assert pictures.stale() == list(pictures.PICTURES)
