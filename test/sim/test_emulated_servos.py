"""Emulated servos against the maker's SDK and model file."""

from pathlib import Path
import time

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from beetle_omni_ros.sim.emulated import servo_bus as emulated
from beetle_omni_ros.sim.emulated.servo_bus import (
    EmulatedServo,
    EmulatedServoBus,
    packet,
    packets,
    TABLE,
)

sdk = pytest.importorskip('dynamixel_sdk')

payloads = st.tuples(
    st.integers(0, 0xFE).filter(lambda name: name != 0xFD), st.integers(0, 255),
    st.lists(st.sampled_from((0, 1, 0xFD, 0xFE, 0xFF, 0x55)) | st.integers(0, 255),
             max_size=40).map(bytes))


@given(st.lists(payloads, min_size=1, max_size=6), st.binary(max_size=200), st.data())
def test_packets_are_found_for_any_split_of_the_stream_and_after_noise(sent, noise, data):
    stream = b''.join(packet(*payload) for payload in sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    buffer, found = bytearray(noise), []
    list(packets(buffer))
    buffer.clear()          # after a pause on the line
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        buffer += stream[start:end]
        found += packets(buffer)
    assert found == sent


@given(st.floats(-3.9, 3.9), st.sampled_from((-1, 1)), st.integers(0, 4095),
       st.integers(-2, 2))
def test_goals_mean_the_same_angle_as_positions(angle, sign, zero, turns):
    servo = EmulatedServo(1, sign=sign, zero=zero)
    servo.angle = angle + turns * 2 * np.pi
    servo.reboot(-1.0)
    servo.angle = angle
    servo.read(132, 4)
    assert servo.write(TABLE['Goal Position'].address, servo['Present Position'].to_bytes(
        4, 'little', signed=True)) == emulated.NONE
    assert servo.goal == pytest.approx(angle, abs=0.51 * emulated.POSITION_UNIT)


def test_the_table_agrees_with_the_makers_model_file():
    folder = Path(sdk.__file__).parents[1] / 'dynamixel_easy_sdk' / 'control_table'
    path = folder / 'xc330_t181_fw52.model'
    if not path.is_file():
        pytest.skip('this SDK has no model files')
    rows = [line.split('\t') for line in path.read_text().splitlines()]
    rows = {row[2]: (int(row[0]), int(row[1])) for row in rows
            if len(row) == 3 and row[0].isdigit()}
    known = set(TABLE) & set(rows)
    assert len(known) > 30
    for name in known:
        assert rows[name] == TABLE[name][:2], name


@pytest.mark.real_time
def test_the_sdk_reads_writes_pings_and_receives_errors():
    with EmulatedServoBus(reboot_time=0.05) as bus:
        port, handler = sdk.PortHandler(bus.port), sdk.PacketHandler(2.0)
        assert port.setBaudRate(1_000_000)
        assert handler.ping(port, 2) == (1210, sdk.COMM_SUCCESS, 0)
        assert handler.ping(port, 9)[1] == sdk.COMM_RX_TIMEOUT
        assert handler.write1ByteTxRx(port, 1, 11, 4) == (sdk.COMM_SUCCESS, 0)
        for value in (-534 & 0xFFFFFFFF, 0xFFFDFFFF, 0xFFFFFFFD):   # with a header, all legal
            assert handler.write4ByteTxRx(port, 1, 116, value) == (sdk.COMM_SUCCESS, 0)
            assert handler.read4ByteTxRx(port, 1, 116) == (value, 0, 0)
        assert handler.write1ByteTxRx(port, 1, 64, 1) == (sdk.COMM_SUCCESS, 0)
        assert handler.write1ByteTxRx(port, 1, 11, 3) == (sdk.COMM_SUCCESS, 7)
        assert bus.drive()[1] == [True, False, False, False]
        assert bus.drive()[0][0] == pytest.approx((-3 - 2048) * 2 * np.pi / 4096)
        assert handler.reboot(port, 1) == (0, 0)
        assert handler.ping(port, 1)[1] == sdk.COMM_RX_TIMEOUT
        time.sleep(0.06)
        assert handler.read1ByteTxRx(port, 1, 64) == (0, 0, 0)
        assert bus.refusals == 1
        port.closePort()


def test_a_stall_does_not_split_the_answers_to_one_request():
    bus = EmulatedServoBus()
    bus.close()     # ends its thread
    sent, request = [], packet(emulated.BROADCAST, emulated.SYNC_READ,
                               bytes((126, 0, 10, 0, 1, 2, 3, 4)))
    bus._read, bus._send = (lambda: request), sent.append
    bus._serve(time.monotonic())
    assert [len(list(packets(bytearray(data)))) for data in sent] == [4]
