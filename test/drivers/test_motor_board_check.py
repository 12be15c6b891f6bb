"""Bring-up finds what is wrong with the motor board and says what to do."""

from dataclasses import replace

import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from board_bench import QUICK

from beetle_omni_ros.drivers import motor_board_check
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard


def findings(emulated, monkeypatch):
    """Name -> finding; a short look is enough for the emulated board."""
    monkeypatch.setattr(motor_board_check, 'LISTEN', 0.8)
    parameters = replace(MotorBoardParameters.load(), port=emulated.port)
    return {f.name: f for f in motor_board_check.check_motor_board(parameters)}


def test_a_good_board_passes_everything(monkeypatch):
    with EmulatedMotorBoard(parameters=QUICK) as emulated:
        found = findings(emulated, monkeypatch)
        assert len(found) == 12
        assert all(finding.ok for finding in found.values()), found
        assert not emulated.armed


def test_faults_are_found_and_each_has_advice(monkeypatch):
    with EmulatedMotorBoard(parameters=QUICK) as emulated:
        emulated.faults.failed_escs = (2,)
        emulated.set_battery(20.0, 0.0)
        emulated.faults.corrupt_in = 0.5
        found = findings(emulated, monkeypatch)
    bad = {name for name, finding in found.items() if not finding.ok}
    assert bad == {'ESC of rotor 2', 'motor board ready to arm', 'link to the motor board'}
    assert found['motor board ready to arm'].found == 'battery low, ESC failure'
    assert all(found[name].advice for name in bad)


def test_a_silent_or_missing_board_ends_the_list(monkeypatch):
    with EmulatedMotorBoard(parameters=QUICK) as emulated:
        emulated.faults.mute = True
        found = findings(emulated, monkeypatch)
        assert list(found) == ['motor board port', 'motor board']
        assert '0 bytes' in found['motor board'].found
        emulated.unplug()
        (port,) = findings(emulated, monkeypatch).values()
    assert not port.ok and 'no such device' in port.found
