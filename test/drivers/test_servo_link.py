"""Late, truncated and corrupt answers."""

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.drivers.servo_link import NoAnswer, ServoBusError, ServoLink
from beetle_omni_ros.drivers.servo_registers import GOAL_POSITION, HARDWARE_ERROR, TORQUE_ENABLE
from beetle_omni_ros.sim.emulated.servo_bus import crc16, fast_status, packet, status

IDS = [1, 2, 3]
DATA = {name: bytes(range(name, name + 10)) for name in IDS}
FOUND = {name: (0, part) for name, part in DATA.items()}


class Wire(ServoLink):
    """A bus with prepared answers, which stores sent packets."""

    def __init__(self, *answers, fast=True):
        super().__init__('wire', 1_000_000, 0.001)
        self.answers, self.sent, self.waiting, self.fast = list(answers), [], b'', fast

    def clearPort(self):
        pass

    def writePort(self, data):
        self.sent.append(bytes(data))
        self.waiting = self.answers.pop(0) if self.answers else b''
        return len(data)

    def readPort(self, length):
        taken, self.waiting = self.waiting[:length], self.waiting[length:]
        return taken

    def isPacketTimeout(self):
        return not self.waiting


def joint(data):
    """The common answer to a fast sync read."""
    length = len(next(iter(data.values()))) + 4
    return fast_status([(name, 0, part) for name, part in data.items()], length * len(data))


def test_sent_packets_equal_the_documented_bytes():
    link = Wire(status(1, 0), status(1, 0, b'\x05'), fast=False)
    link.write(1, GOAL_POSITION, 512)
    link.read(1, HARDWARE_ERROR)
    link.sync_write(GOAL_POSITION, {1: 150, 2: 170})
    link.sync_read(132, 4, [1, 2])
    link.fast = True
    link.sync_read(132, 4, [3, 7, 4])
    assert [one.hex(' ').upper() for one in link.sent] == [
        'FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89',
        packet(1, 2, b'\x46\0\1\0').hex(' ').upper(),
        'FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87',
        'FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA',
        'FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2']
    assert link.packet_of_sync_write(GOAL_POSITION, {1: 150, 2: 170}) == link.sent[2]


@pytest.mark.parametrize('data', [DATA, dict.fromkeys(IDS, b'\xff\xff\xfd\x00' * 2 + b'\xff\xfd')])
def test_a_fast_sync_read_answer_is_split_even_if_it_contains_headers(data):
    assert Wire(joint(data)).sync_read(126, 10, IDS) == {
        name: (0, part) for name, part in data.items()}


def test_the_valid_part_of_a_truncated_answer_is_used():
    for kept in range(8, 50):
        answers = Wire(joint(DATA)[:kept]).sync_read(126, 10, IDS)
        assert answers == {name: FOUND[name] for name in IDS[:(kept - 8) // 14]}, kept


def test_corrupted_bytes_are_never_returned_as_data():
    for place in range(50):
        raw = bytearray(joint(DATA))
        raw[place] ^= 0x10
        answers = Wire(bytes(raw)).sync_read(126, 10, IDS)
        assert answers.items() < FOUND.items(), place


@pytest.mark.parametrize('late', [
    joint({1: b'\x78\0\x23', 2: b'\x78\0\x23', 3: b'\x78\0\x23'}),  # 2 (3 + 4) = 10 + 4
    joint({1: b'\x01', 2: b'\x01', 3: b'\x01'}), status(2, 0), status(1, 0, b'\x01\x02\x03\x04')])
def test_a_late_answer_to_another_request_is_skipped(late):
    assert Wire(late + joint(DATA)).sync_read(126, 10, IDS) == FOUND
    link = Wire(late)
    assert link.sync_read(126, 10, IDS) == {}
    assert link.late


def test_answers_before_and_after_a_corrupted_one_are_used():
    broken = bytearray(status(2, 0, DATA[2]))
    broken[12] ^= 1
    link = Wire(status(1, 0, DATA[1]) + bytes(broken) + status(3, 0, DATA[3]), fast=False)
    assert link.sync_read(126, 10, IDS) == {1: FOUND[1], 3: FOUND[3]}


@pytest.mark.parametrize('fast', [True, False])
def test_error_bytes_are_read_with_the_feedback(fast):
    blocks = [(1, 0, b'a'), (2, 0x80, b'b'), (3, 0x87, b'c')]
    raw = (fast_status(blocks, 15) if fast
           else b''.join(status(*block) for block in blocks))
    assert Wire(raw, fast=fast).sync_read(65, 1, IDS) == {
        1: (0, b'a'), 2: (0x80, b'b'), 3: (0x87, b'c')}


def test_refusals_and_silence_are_one_line_with_port_and_id():
    with pytest.raises(ServoBusError, match=r'^wire, id 1: write 1 to Torque Enable\(64\): '
                                            'refused, no access'):
        Wire(status(1, 7)).write(1, TORQUE_ENABLE, 1)
    with pytest.raises(NoAnswer, match='^wire, id 1: ping: There is no status packet!$'):
        Wire().ping(1)
    with pytest.raises(SerialPortError, match='^wire: not open$'):
        ServoLink('wire', 1_000_000, 0.001).ping(1)


@pytest.mark.parametrize('late', [status(1, 0), status(1, 0, b'\1\2'), status(2, 0, b'\0'),
                                  joint(DATA)])
def test_a_late_answer_is_not_taken_for_the_value_of_a_register(late):
    with pytest.raises(NoAnswer):
        Wire(late).read(1, TORQUE_ENABLE)
    assert Wire(late + status(1, 0, b'\1')).read(1, TORQUE_ENABLE) == 1


def test_a_write_whose_answer_is_lost_is_repeated():
    link = Wire(b'', b'', status(1, 0))
    link.write(1, TORQUE_ENABLE, 1)
    assert len(link.sent) == 3
    with pytest.raises(NoAnswer):
        Wire(b'', b'', b'').write(1, TORQUE_ENABLE, 1)


def sealed(name, length, rest):
    """Bytes with a header and a correct CRC, and otherwise any content."""
    raw = b'\xff\xff\xfd\0' + bytes((name,)) + length.to_bytes(2, 'little') + b'\x55' + rest
    return raw + crc16(raw).to_bytes(2, 'little')


noise = st.binary(max_size=60) | st.builds(
    sealed, st.sampled_from((1, 2, 0xFC, 0xFE)), st.integers(0, 60), st.binary(max_size=60)) \
    | st.builds(status, st.sampled_from((1, 2, 9)), st.integers(0, 255), st.binary(max_size=12))


@settings(max_examples=200, deadline=None)
@given(st.lists(noise, max_size=4).map(b''.join), st.booleans())
def test_arbitrary_bytes_neither_raise_nor_block_the_link(data, fast):
    for error, part in Wire(data, fast=fast).sync_read(126, 10, IDS).values():
        assert len(part) == 10 or error
    for ask in (lambda link: link.ping(1), lambda link: link.read(1, GOAL_POSITION),
                lambda link: link.write(1, GOAL_POSITION, 5)):
        try:
            ask(Wire(data, fast=fast))
        except ServoBusError:
            pass
