"""Late, truncated and corrupt answers."""

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from beetle_omni_ros.drivers.servo_link import NoAnswer, Refused, ServoLink
from beetle_omni_ros.drivers.servo_port import PortLost, ServoPort
from beetle_omni_ros.drivers.servo_registers import GOAL_POSITION, HARDWARE_ERROR, TORQUE_ENABLE
from beetle_omni_ros.sim.emulated.dynamixel import crc16, fast_status, packet, status

IDS = [1, 2, 3]
DATA = {name: bytes(range(name, name + 10)) for name in IDS}


class Wire(ServoPort):
    """A port with prepared answers, which stores sent packets."""

    def __init__(self, *answers):
        super().__init__('wire', 1_000_000, 0.001)
        self.answers, self.sent, self.waiting = list(answers), [], b''
        self.tx_time_per_byte = 0.01

    def clearPort(self):
        pass

    def writePort(self, data):
        self.sent.append(bytes(data))
        self.unsent = len(data)
        self.waiting = self.answers.pop(0) if self.answers else b''
        return len(data)

    def readPort(self, length):
        taken, self.waiting = self.waiting[:length], self.waiting[length:]
        return taken


def linked(*answers, fast=True):
    link = ServoLink('wire', 1_000_000, 0.001)
    link._port, link.fast = Wire(*answers), fast
    return link


def joint(data, error=0):
    """The common answer to a fast sync read."""
    length = len(next(iter(data.values()))) + 4
    return b''.join(fast_status([(name, error, part) for name, part in data.items()],
                                length * len(data)))


def test_sent_packets_equal_the_documented_bytes():
    link = linked(status(1, 0), status(1, 0, b'\x05'), fast=False)
    link.write(1, GOAL_POSITION, 512)
    link.read(1, HARDWARE_ERROR)
    link.sync_write(GOAL_POSITION, {1: 150, 2: 170})
    link.sync_read(132, 4, [1, 2])
    link.fast = True
    link.sync_read(132, 4, [3, 7, 4])
    assert [one.hex(' ').upper() for one in link._port.sent] == [
        'FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89',
        packet(1, 2, b'\x46\0\1\0').hex(' ').upper(),
        'FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87',
        'FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA',
        'FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2']
    assert link.packet_of_sync_write(GOAL_POSITION, {1: 150, 2: 170}) == link._port.sent[2]


@pytest.mark.parametrize('data', [DATA, dict.fromkeys(IDS, b'\xff\xff\xfd\x00' * 2 + b'\xff\xfd')])
def test_a_fast_sync_read_answer_is_split_even_if_it_contains_headers(data):
    assert linked(joint(data)).sync_read(126, 10, IDS) == {
        name: (0, part) for name, part in data.items()}


@pytest.mark.parametrize('kept', range(8, 50))
def test_the_valid_part_of_a_truncated_answer_is_used(kept):
    answers = linked(joint(DATA)[:kept]).sync_read(126, 10, IDS)
    assert answers == {name: (0, DATA[name]) for name in IDS[:(kept - 8) // 14]}


@pytest.mark.parametrize('place', range(50))
def test_corrupted_bytes_are_never_returned_as_data(place):
    raw = bytearray(joint(DATA))
    raw[place] ^= 0x10
    answers = linked(bytes(raw)).sync_read(126, 10, IDS)
    assert all(answer == (0, DATA[name]) for name, answer in answers.items())
    assert len(answers) < 3


@pytest.mark.parametrize('late', [
    joint({1: b'\x78\0\x23', 2: b'\x78\0\x23', 3: b'\x78\0\x23'}),  # 2 (3 + 4) = 10 + 4
    joint({1: b'\x01', 2: b'\x01', 3: b'\x01'}), status(2, 0), status(1, 0, b'\x01\x02\x03\x04')])
def test_a_late_answer_to_another_request_is_skipped(late):
    link = linked(late + joint(DATA))
    assert link.sync_read(126, 10, IDS) == {name: (0, DATA[name]) for name in IDS}
    link = linked(late)
    assert link.sync_read(126, 10, IDS) == {}
    assert link.late


def test_answers_before_and_after_a_corrupted_one_are_used():
    broken = bytearray(status(2, 0, DATA[2]))
    broken[12] ^= 1
    link = linked(status(1, 0, DATA[1]) + bytes(broken) + status(3, 0, DATA[3]), fast=False)
    assert link.sync_read(126, 10, IDS) == {1: (0, DATA[1]), 3: (0, DATA[3])}


@pytest.mark.parametrize('fast', [True, False])
def test_alerts_are_read_with_the_feedback(fast):
    blocks = [(1, 0, b'a'), (2, 0x80, b'b'), (3, 0x87, b'c')]
    raw = b''.join(fast_status(blocks, 15) if fast else [status(*block) for block in blocks])
    link = linked(raw, status(2, 0), fast=fast)
    assert link.sync_read(65, 1, IDS) == {1: (0, b'a'), 2: (0, b'b'), 3: (7, b'c')}
    assert link.alerts == {2, 3}
    link.write(2, TORQUE_ENABLE, 0)
    assert link.alerts == {3}


def test_refusals_and_silence_are_one_line_with_port_and_id():
    with pytest.raises(Refused, match=r'^wire, id 1: write 1 to Torque Enable\(64\): refused, no '
                                      'access'):
        linked(status(1, 7)).write(1, TORQUE_ENABLE, 1)
    with pytest.raises(NoAnswer, match='^wire, id 1: ping: There is no status packet!$'):
        linked().ping(1)


@pytest.mark.parametrize('late', [status(1, 0), status(1, 0, b'\1\2'), status(2, 0, b'\0'),
                                  joint(DATA)])
def test_a_late_answer_is_not_taken_for_the_value_of_a_register(late):
    with pytest.raises(NoAnswer):
        linked(late).read(1, TORQUE_ENABLE)
    assert linked(late + status(1, 0, b'\1')).read(1, TORQUE_ENABLE) == 1
    assert linked(late + status(1, 0, b'\1'), fast=False).sync_read(64, 1, [1]) == {
        1: (0, b'\1')}


def test_a_write_whose_answer_is_lost_is_repeated():
    link = linked(b'', b'', status(1, 0))
    link.write(1, TORQUE_ENABLE, 1)
    assert len(link._port.sent) == 3
    with pytest.raises(NoAnswer):
        linked(b'', b'', b'').write(1, TORQUE_ENABLE, 1)


def test_a_closed_link_raises_an_error():
    with pytest.raises(PortLost):
        ServoLink('wire', 1_000_000, 0.001).ping(1)


def sealed(name, length, rest):
    """Bytes with a header and a correct CRC, and otherwise any content."""
    raw = b'\xff\xff\xfd\0' + bytes((name,)) + length.to_bytes(2, 'little') + b'\x55' + rest
    return raw + crc16(raw).to_bytes(2, 'little')


noise = st.binary(max_size=60) | st.builds(
    sealed, st.sampled_from((1, 2, 0xFC, 0xFE)), st.integers(0, 60), st.binary(max_size=60)) \
    | st.builds(status, st.sampled_from((1, 2, 9)), st.integers(0, 255), st.binary(max_size=12))


@settings(max_examples=300, deadline=None)
@given(st.lists(noise, max_size=4).map(b''.join), st.booleans())
def test_arbitrary_bytes_neither_raise_nor_block_the_link(data, fast):
    for error, part in linked(data, fast=fast).sync_read(126, 10, IDS).values():
        assert len(part) == 10 or error
    for ask in (lambda link: link.ping(1), lambda link: link.read(1, GOAL_POSITION),
                lambda link: link.write(1, GOAL_POSITION, 5)):
        try:
            ask(linked(data, fast=fast))
        except (NoAnswer, Refused):
            pass
