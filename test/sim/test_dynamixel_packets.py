"""Packets against the examples in the protocol's document; streams of packets."""

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from beetle_omni_ros.sim.emulated import dynamixel
from beetle_omni_ros.sim.emulated.dynamixel import (
    crc16,
    Instruction,
    packet,
    Receiver,
    status,
    stuffed,
    unstuffed,
)

# Examples of emanual.robotis.com/docs/en/dxl/protocol2, typed in by hand: (ID, instruction,
# parameters) and the whole packet.
INSTRUCTIONS = [
    (0x01, 0x01, '', 'FF FF FD 00 01 03 00 01 19 4E'),
    (0xFE, 0x01, '', 'FF FF FD 00 FE 03 00 01 31 42'),
    (0x01, 0x02, '84 00 04 00', 'FF FF FD 00 01 07 00 02 84 00 04 00 1D 15'),
    (0x01, 0x03, '74 00 00 02 00 00', 'FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89'),
    (0x01, 0x04, '68 00 C8 00 00 00', 'FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E'),
    (0x01, 0x05, '', 'FF FF FD 00 01 03 00 05 02 CE'),
    (0x01, 0x06, '01', 'FF FF FD 00 01 04 00 06 01 A1 E6'),
    (0x01, 0x08, '', 'FF FF FD 00 01 03 00 08 2F 4E'),
    (0x01, 0x10, '01 44 58 4C 22', 'FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC'),
    (0xFE, 0x82, '84 00 04 00 01 02', 'FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA'),
    (0xFE, 0x83, '74 00 04 00 01 96 00 00 00 02 AA 00 00 00',
     'FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87'),
    (0xFE, 0x92, '01 90 00 02 00 02 92 00 01 00',
     'FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05'),
    (0xFE, 0x93, '01 20 00 02 00 A0 00 02 1F 00 01 00 50',
     'FF FF FD 00 FE 10 00 93 01 20 00 02 00 A0 00 02 1F 00 01 00 50 B7 68'),
    (0xFE, 0x8A, '84 00 04 00 03 07 04', 'FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2'),
]
ANSWERS = [
    (0x01, '06 04 26', 'FF FF FD 00 01 07 00 55 00 06 04 26 65 5D'),
    (0x02, '06 04 26', 'FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D'),
    (0x01, 'A6 00 00 00', 'FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0'),
    (0x02, '1F 08 00 00', 'FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE'),
    (0x01, '', 'FF FF FD 00 01 04 00 55 00 A1 0C'),
    (0x01, '77 00', 'FF FF FD 00 01 06 00 55 00 77 00 C3 69'),
    (0x02, '24', 'FF FF FD 00 02 05 00 55 00 24 8B A9'),
]
FAST = ('FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08', '00 07 1F 08 00 00 16 CA',
        '00 04 FF 03 00 00 D1 9E')
FAST_BULK = ('FF FF FD 00 FE 14 00 55 00 03 A6 00 00 00 67 A4', '00 07 A5 01 24 74',
             '00 04 1F D9 C1')

payloads = st.tuples(
    st.integers(0, 0xFE).filter(lambda name: name != 0xFD), st.integers(0, 255),
    st.lists(st.sampled_from((0, 1, 0xFD, 0xFE, 0xFF, 0x55)) | st.integers(0, 255),
             max_size=40).map(bytes))


def test_crc_has_the_published_generator():
    # By definition, the remainder of the message with its CRC is zero.
    message = bytes(range(37))
    assert crc16(message + crc16(message).to_bytes(2, 'big')) == 0
    assert crc16(b'\x01') == 0x8005
    assert crc16(message) == crc16(message[5:], crc16(message[:5]))


@pytest.mark.parametrize(('name', 'instruction', 'parameters', 'expected'), INSTRUCTIONS)
def test_instructions_have_the_documented_bytes(name, instruction, parameters, expected):
    made = packet(name, instruction, bytes.fromhex(parameters))
    assert made == bytes.fromhex(expected)
    (received,) = Receiver().feed(made)
    assert (received.identifier, received.instruction) == (name, instruction)
    assert received.parameters == bytes.fromhex(parameters)
    assert received.valid


@pytest.mark.parametrize(('name', 'data', 'expected'), ANSWERS)
def test_answers_have_the_documented_bytes(name, data, expected):
    assert status(name, 0, bytes.fromhex(data)) == bytes.fromhex(expected)


@pytest.mark.parametrize(('blocks', 'expected'), [
    ([(3, 0, 'A6 00 00 00'), (7, 0, '1F 08 00 00'), (4, 0, 'FF 03 00 00')], FAST),
    ([(3, 0, 'A6 00 00 00'), (7, 0, 'A5 01'), (4, 0, '1F')], FAST_BULK)])
def test_the_fast_sync_read_answer_has_the_documented_bytes(blocks, expected):
    blocks = [(name, error, bytes.fromhex(data)) for name, error, data in blocks]
    length = sum(4 + len(data) for _, _, data in blocks)
    assert dynamixel.fast_status(blocks, length) == bytes.fromhex(''.join(expected))


@given(payloads)
def test_stuffing_round_trips_and_leaves_no_header(payload):
    name, instruction, parameters = payload
    body = bytes((instruction,)) + parameters
    assert unstuffed(stuffed(body)) == body
    raw = packet(name, instruction, parameters)
    # The last two bytes of the body with the CRC may still look like one.
    assert raw.rfind(b'\xff\xff\xfd\x00', 1, len(raw) - 2) < 1


@given(st.lists(payloads, min_size=1, max_size=6), st.data())
def test_packets_are_found_for_any_split_of_the_stream(sent, data):
    stream = b''.join(packet(*payload) for payload in sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    receiver, found = Receiver(), []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += receiver.feed(stream[start:end])
    assert [(one.identifier, one.instruction, one.parameters) for one in found] == sent
    assert all(one.valid for one in found)
    assert receiver.skipped == 0


@settings(max_examples=300)
@given(st.binary(max_size=200), payloads)
def test_after_any_noise_and_a_pause_the_next_packet_is_found(noise, payload):
    receiver = Receiver()
    list(receiver.feed(noise))
    receiver.forget()
    (found,) = receiver.feed(packet(*payload))
    assert found.valid and found.parameters == payload[2]


@given(payloads, st.integers(1, 60), payloads)
def test_a_truncated_packet_loses_no_other(broken, kept, payload):
    receiver = Receiver()
    whole = packet(*broken)
    list(receiver.feed(whole[:min(kept, len(whole) - 3)]))
    found = list(receiver.feed(packet(*payload)))
    assert [one.parameters for one in found if one.valid][-1:] == [payload[2]]


@given(payloads, st.integers(0, 10_000), st.integers(0, 7))
def test_one_flipped_bit_never_passes_as_valid(payload, place, bit):
    raw = bytearray(packet(*payload))
    raw[place % len(raw)] ^= 1 << bit
    found = Receiver().feed(bytes(raw))
    assert not any(one.valid and one.parameters != payload[2] for one in found)


def test_every_instruction_has_the_number_of_the_document():
    assert set(Instruction) <= {code for _, code, _, _ in INSTRUCTIONS} | {0x55}
