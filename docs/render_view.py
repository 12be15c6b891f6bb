"""
Draw docs/pictures/view.png: ``python docs/render_view.py my_run/rl my_run/nmpc --at 9.2``.

It shows the page of `beetle_omni view` in an installed headless browser.
"""

import argparse
import io
from pathlib import Path
import sys
import threading

from PIL import Image

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.urdf import Model
from beetle_omni_ros.runs.bag import names_of
from beetle_omni_ros.view.page import Page
from beetle_omni_ros.view.playback import Player
from beetle_omni_ros.view.recording import Recording

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / 'test' / 'view'))
from view_browser import opened, rendered  # noqa: E402


def main():
    """Render and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('runs', type=Path, nargs='+')
    parser.add_argument('--at', type=float, default=9.2, help='time [s]')
    parser.add_argument('--dark', action='store_true')
    parser.add_argument('--size', type=int, nargs=2, default=(1280, 800), help='pixels')
    parser.add_argument('--output', type=Path, default=ROOT / 'docs' / 'pictures' / 'view.png')
    given = parser.parse_args()
    recordings = [Recording(path, name) for path, name in zip(given.runs, names_of(given.runs))]
    for recording in recordings:
        recording.wait(whole=True)
    page = Page([recording.name for recording in recordings], Model.load(),
                RobotParameters.load(), port=8500, dark=given.dark)
    player = Player(page, recordings, given.at, play=False)
    player.look()
    threading.Thread(target=player.run, daemon=True).start()
    with opened(page.url, *given.size) as (browser, _):
        rendered(browser)
        browser.add_style_tag(content='.mantine-Notifications-root {display: none}')
        browser.wait_for_timeout(3000)
        picture = Image.open(io.BytesIO(browser.screenshot())).convert('RGB')
    player.stop()
    page.close()
    picture.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE).save(
        given.output, optimize=True)


if __name__ == '__main__':
    main()
