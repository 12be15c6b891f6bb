"""Late, truncated and corrupt answers."""

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from beetle_omni_ros.drivers.servo_link import ServoLink
from beetle_omni_ros.drivers.servo_xc330 import (
    GOAL_POSITION,
    HARDWARE_ERROR,
    ServoBusError,
    TORQUE_ENABLE,
)
from beetle_omni_ros.sim.emulated.servo_bus import packet, sealed, STATUS


def status(identifier, error, data=b''):
    """The answer of one servo."""
    return packet(identifier, STATUS, bytes((error,)) + data)


IDS = [1, 2, 3]
DATA = {name: bytes(range(name, name + 10)) for name in IDS}
FOUND = {name: (0, part) for name, part in DATA.items()}
ALL = b''.join(status(name, 0, part) for name, part in DATA.items())


class Wire(ServoLink):
    """A bus with prepared answers, which stores sent packets."""

    def __init__(self, *answers):
        super().__init__('wire', 1_000_000, 0.001)
        self.answers, self.sent, self.waiting = list(answers), [], b''

    def clearPort(self):
        pass

    def writePort(self, data):
        self.sent.append(bytes(data))
        self.waiting = self.answers.pop(0) if self.answers else b''
        return len(data)

    def readPort(self, length):
        length = max(length, 0)
        taken, self.waiting = self.waiting[:length], self.waiting[length:]
        return taken

    def isPacketTimeout(self):
        return not self.waiting


def test_sent_packets_equal_the_documented_bytes():
    link = Wire(status(1, 0), status(1, 0, b'\x05'))
    link.write(1, GOAL_POSITION, 512)
    link.read(1, HARDWARE_ERROR)
    link.sync_write(GOAL_POSITION, {1: 150, 2: 170})
    link.sync_read(132, 4, [1, 2])
    assert [one.hex(' ').upper() for one in link.sent] == [
        'FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89',
        packet(1, 2, b'\x46\0\1\0').hex(' ').upper(),
        'FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87',
        'FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA']
    assert link.packet_of_sync_write(GOAL_POSITION, {1: 150, 2: 170}) == link.sent[2]


def test_the_valid_part_of_a_truncated_answer_is_used():
    for kept in range(len(ALL)):
        answers = Wire(ALL[:kept]).sync_read(126, 10, IDS)
        assert answers == {name: FOUND[name] for name in IDS[:kept // 21]}, kept


def test_corrupted_bytes_are_never_returned_as_data_and_cost_one_answer():
    for place in range(len(ALL)):
        raw = bytearray(ALL)
        raw[place] ^= 0x10
        answers = Wire(bytes(raw)).sync_read(126, 10, IDS)
        assert answers.items() < FOUND.items(), place
        assert len(answers) == 2 or place % 21 in (5, 6)    # the length


@pytest.mark.parametrize('late', [
    status(1, 0, b'\x01'), status(2, 0), status(1, 0, b'\x01\x02\x03\x04')])
def test_a_late_answer_to_another_request_is_skipped(late):
    assert Wire(late + ALL).sync_read(126, 10, IDS) == FOUND
    link = Wire(late)
    assert link.sync_read(126, 10, IDS) == {}
    assert link.late


def test_a_write_whose_answer_is_lost_is_repeated():
    link = Wire(b'', b'', status(1, 0))
    link.write(1, TORQUE_ENABLE, 1)
    assert len(link.sent) == 3
    silent = Wire(b'', b'', b'')
    with pytest.raises(ServoBusError):
        silent.write(1, TORQUE_ENABLE, 1)
    assert silent.late


def with_crc(name, length, rest):
    """Bytes with a header and a correct CRC, and otherwise any content."""
    return sealed(b'\xff\xff\xfd\0' + bytes((name,)) + length.to_bytes(2, 'little') + b'\x55'
                  + rest)


noise = st.binary(max_size=60) | st.builds(
    with_crc, st.sampled_from((1, 2, 0xFC, 0xFE)), st.integers(0, 60), st.binary(max_size=60)) \
    | st.builds(status, st.sampled_from((1, 2, 9)), st.integers(0, 255), st.binary(max_size=12))


@settings(max_examples=200, deadline=None)
@given(st.lists(noise, max_size=4).map(b''.join))
def test_arbitrary_bytes_neither_raise_nor_block_the_link(data):
    for error, part in Wire(data).sync_read(126, 10, IDS).values():
        assert len(part) == 10 or error
    for ask in (lambda link: link.ping(1), lambda link: link.read(1, GOAL_POSITION),
                lambda link: link.write(1, GOAL_POSITION, 5)):
        try:
            ask(Wire(data))
        except ServoBusError:
            pass
