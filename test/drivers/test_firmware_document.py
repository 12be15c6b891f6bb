"""docs/reference/firmware.md shows the tested packets and the emulated numbers."""

from pathlib import Path
import re

import pytest
import reference_packets as reference

from beetle_omni_ros.sim.emulated import board_firmware, mavlink
from beetle_omni_ros.sim.emulated.board_parameters import EmulatedBoardParameters

DOCUMENT = (Path(__file__).resolve().parents[2] / 'docs' / 'reference' / 'firmware.md').read_text()


def test_documented_packets_equal_the_tested_packets():
    shown = [bytes.fromhex(row) for row in re.findall(r'`(fd(?: [0-9a-f]{2})+)`', DOCUMENT)]
    assert shown == [*reference.BY_HOST, *reference.BY_BOARD]


def test_documented_numbers_equal_the_emulated_numbers():
    rows = re.findall(r'^\| `(\w+)` \| ([\d.]+) (?:s|V|Hz) \|', DOCUMENT, re.MULTILINE)
    assert len(rows) == 14
    parameters = EmulatedBoardParameters.load()
    for name, value in rows:
        assert getattr(parameters, name) == float(value), name


@pytest.mark.parametrize('number', mavlink.MESSAGES)
def test_documented_message_tables_agree_with_the_dialect(number):
    seed, layout = mavlink.MESSAGES[number]
    name = reference.DEFINITIONS[number][0]
    assert re.search(rf'^\| {name} \| {number} \| {seed} \| {layout.size} \|', DOCUMENT,
                     re.MULTILINE), f'{name}: {number}, {seed}, {layout.size}'


def test_the_documented_version_equals_the_transmitted_version():
    assert f'**Contract version {board_firmware.CONTRACT_VERSION}.**' in DOCUMENT
