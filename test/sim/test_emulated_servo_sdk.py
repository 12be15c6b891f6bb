"""The maker's SDK as a reference for the emulated bus, through a pseudo-terminal."""

from pathlib import Path
from random import Random
import time

import numpy as np
import pytest

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.emulated import servo_table as table
from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

pytestmark = pytest.mark.real_time

sdk = pytest.importorskip('dynamixel_sdk')
ALL = (1, 2, 3, 4)


@pytest.fixture
def bus():
    with EmulatedServoBus(reboot_time=0.05) as made:
        yield made


@pytest.fixture
def line(bus):
    """(port, packet handler), opened as the SDK's examples do."""
    port = sdk.PortHandler(bus.port)
    assert port.setBaudRate(1_000_000)
    yield port, sdk.PacketHandler(2.0)
    port.closePort()


def group_read(line, address, length, names=ALL):
    group = sdk.GroupSyncRead(*line, address, length)
    for name in names:
        group.addParam(name)
    return group


def test_the_table_agrees_with_the_makers_model_file():
    folder = Path(sdk.__file__).parents[1] / 'dynamixel_easy_sdk' / 'control_table'
    path = folder / 'xc330_t181_fw52.model'
    if not path.is_file():
        pytest.skip('this SDK has no model files')
    rows = [line.split('\t') for line in path.read_text().splitlines()]
    rows = {row[2]: (int(row[0]), int(row[1])) for row in rows
            if len(row) == 3 and row[0].isdigit() and not row[2].startswith('Indirect')}
    assert len(rows) > 45
    for name, (address, size) in rows.items():
        assert (table.BY_NAME[name].address, table.BY_NAME[name].size) == (address, size), name


def test_the_sdk_reads_writes_pings_and_receives_errors(bus, line):
    port, handler = line
    assert handler.ping(port, 2) == (1210, sdk.COMM_SUCCESS, 0)
    assert handler.ping(port, 9)[1] == sdk.COMM_RX_TIMEOUT
    assert handler.write1ByteTxRx(port, 1, 11, 4) == (sdk.COMM_SUCCESS, 0)
    assert handler.write4ByteTxRx(port, 1, 116, -534 & 0xFFFFFFFF) == (sdk.COMM_SUCCESS, 0)
    assert handler.read4ByteTxRx(port, 1, 116)[0] == -534 & 0xFFFFFFFF
    assert handler.write1ByteTxRx(port, 1, 64, 1) == (sdk.COMM_SUCCESS, 0)
    assert handler.write1ByteTxRx(port, 1, 11, 3) == (sdk.COMM_SUCCESS, 7)
    assert handler.write2ByteTxRx(port, 1, 116, 5) == (sdk.COMM_SUCCESS, 5)
    assert bus.torque_enabled.tolist() == [True, False, False, False]
    assert bus.goals[0] == pytest.approx((-534 - 2048) * 2 * np.pi / 4096)


def test_values_that_contain_a_header_arrive_complete(line):
    port, handler = line
    assert handler.write1ByteTxRx(port, 1, 11, 4) == (0, 0)
    for value in (0xFFFDFFFF, 0xFFFDFFFF, 0xFFFFFFFD):  # FF FF FD FF and the like, all legal
        assert handler.write4ByteTxRx(port, 1, 116, value) == (0, 0)
        assert handler.read4ByteTxRx(port, 1, 116) == (value, 0, 0)


def test_a_reboot_forgets_ram(bus, line):
    port, handler = line
    assert handler.write1ByteTxRx(port, 2, 65, 1) == (0, 0)
    assert handler.reboot(port, 2) == (0, 0)
    assert handler.ping(port, 2)[1] == sdk.COMM_RX_TIMEOUT
    time.sleep(0.06)
    assert handler.read1ByteTxRx(port, 2, 65) == (0, 0, 0)


def test_broadcast_ping_finds_all(line):
    port, handler = line
    found, result = handler.broadcastPing(port)
    assert result == sdk.COMM_SUCCESS
    assert found == {name: [1210, table.FIRMWARE] for name in ALL}


@pytest.mark.parametrize('read', ['txRxPacket', 'fastSyncRead'])
def test_group_reads_give_the_values_of_the_plant(bus, line, read):
    angles = np.array([0.5, -1.0, 3.6, -3.9])
    bus.set_state(angles, [1.0, -2.0, 0.0, 5.0], [0.1, 0.0, -0.2, 0.0])
    group = group_read(line, 126, 10)
    assert getattr(group, read)() == sdk.COMM_SUCCESS
    for name, angle in zip(ALL, angles, strict=True):
        raw = group.getData(name, 132, 4)
        counts = raw - (1 << 32) if raw >> 31 else raw
        assert (counts - 2048) * 2 * np.pi / 4096 == pytest.approx(angle, abs=0.0008)


def test_group_writes_reach_all(bus, line):
    port, handler = line
    group = sdk.GroupSyncWrite(port, handler, 116, 4)
    for name in ALL:
        group.addParam(name, [name, 4, 0, 0])
    assert group.txPacket() == sdk.COMM_SUCCESS
    handler.ping(port, 1)  # answered after what came before
    assert [servo['Goal Position'] for servo in bus.servos] == [1025, 1026, 1027, 1028]


@pytest.mark.parametrize('read', ['txRxPacket', 'fastSyncRead'])
def test_line_faults_have_the_names_of_the_sdk(bus, line, read):
    group = group_read(line, 126, 10)
    bus.faults.bad_crc = 1.0
    assert getattr(group, read)() in (sdk.COMM_RX_CORRUPT, sdk.COMM_RX_TIMEOUT)
    bus.faults.bad_crc, bus.faults.dropped = 0.0, 1.0
    assert getattr(group, read)() in (sdk.COMM_RX_TIMEOUT, sdk.COMM_RX_CORRUPT)
    bus.faults.dropped, bus.faults.silent = 0.0, {2}
    assert getattr(group, read)() != sdk.COMM_SUCCESS
    bus.faults.silent = set()
    assert getattr(group, read)() == sdk.COMM_SUCCESS


def test_another_baud_rate_is_noise_to_the_servos(bus):
    port, handler = sdk.PortHandler(bus.port), sdk.PacketHandler(2.0)
    port.setBaudRate(57600)
    assert handler.ping(port, 1)[1] == sdk.COMM_RX_TIMEOUT
    port.setBaudRate(1_000_000)
    assert handler.write1ByteTxRx(port, 1, 8, 4) == (0, 0)
    assert handler.ping(port, 1)[1] == sdk.COMM_RX_TIMEOUT
    port.setBaudRate(2_000_000)
    assert handler.ping(port, 1)[:2] == (1210, 0)
    port.closePort()


def test_answers_take_the_transmission_time_if_requested():
    with EmulatedServoBus(identifiers=(1,), baud_rate=9600, timing=True) as bus:
        port, handler = sdk.PortHandler(bus.port), sdk.PacketHandler(2.0)
        port.setBaudRate(9600)
        start = time.monotonic()
        assert handler.ping(port, 1)[1] == sdk.COMM_SUCCESS
        # Ten bytes sent and fourteen received, ten bits each: the least time on the wire.
        assert time.monotonic() - start > 24 * 10 / 9600
        port.closePort()


def test_the_emulator_tolerates_noise_and_early_requests(bus, line):
    port, handler = line
    random = Random(3)
    for _ in range(60):
        noise = random.randbytes(random.randrange(1, 300))
        if random.random() < 0.5:
            noise += b'\xff\xff\xfd\x00' + random.randbytes(random.randrange(12))
        port.writePort(noise)
    time.sleep(0.15)  # a pause on the line ends an unfinished packet
    assert handler.ping(port, 1)[:2] == (1210, sdk.COMM_SUCCESS)


def test_without_a_plant_the_servos_simulate_their_motion():
    joints = RobotParameters.load().joints
    with EmulatedServoBus(motion=joints) as bus:
        port, handler = sdk.PortHandler(bus.port), sdk.PacketHandler(2.0)
        port.setBaudRate(1_000_000)
        handler.write1ByteTxRx(port, 1, 64, 1)
        handler.write4ByteTxRx(port, 1, 116, 2500)
        handler.write4ByteTxRx(port, 2, 116, 2500)  # no torque
        deadline = time.monotonic() + 5
        while handler.read4ByteTxRx(port, 1, 132)[0] != 2500 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert handler.read4ByteTxRx(port, 1, 132)[0] == 2500
        assert handler.read4ByteTxRx(port, 2, 132)[0] == 2048
        port.closePort()
