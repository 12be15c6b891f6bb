"""Refusals and protections of an emulated servo by the manual."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from beetle_omni_ros.sim.emulated import servo_table as table
from beetle_omni_ros.sim.emulated.dynamixel import (
    BROADCAST,
    Error,
    Instruction,
    Packet,
    packet,
    Receiver,
    status,
)
from beetle_omni_ros.sim.emulated.servo import EmulatedServo
from beetle_omni_ros.sim.emulated.servo_network import ServoNetwork

BAUD = 1_000_000


@pytest.fixture
def servo():
    return EmulatedServo(1, reboot_time=0.0)


@pytest.fixture
def network():
    return ServoNetwork([EmulatedServo(name, reboot_time=0.1) for name in (1, 2, 3, 4)])


def write(servo, name, value):
    register = table.BY_NAME[name]
    return servo.write(register.address, value.to_bytes(register.size, 'little', signed=value < 0))


def ask(network, name, instruction, parameters=b'', now=0.0, baud_rate=BAUD):
    """Send one packet; return the parts of each answer."""
    (asked,) = Receiver().feed(packet(name, instruction, parameters))
    answers = []
    for reply in network.handle(asked, baud_rate, now):
        (answer,) = Receiver().feed(reply.data)
        assert answer.valid and answer.instruction == Instruction.STATUS
        answers.append((answer.identifier, answer.parameters[0], answer.parameters[1:]))
    return answers


def place(name):
    register = table.BY_NAME[name]
    return register.address.to_bytes(2, 'little') + register.size.to_bytes(2, 'little')


def test_registers_do_not_overlap_and_start_within_their_limits():
    assert sum(register.size for register in table.REGISTERS) == len(table.DEFINED)
    servo = EmulatedServo(1)
    for register in table.REGISTERS:
        if register.writable:
            assert register.low <= servo[register.name] <= register.high, register.name


@pytest.mark.parametrize(('name', 'value', 'error'), [
    ('Operating Mode', 2, Error.DATA_RANGE), ('Operating Mode', 17, Error.DATA_RANGE),
    ('Baud Rate', 7, Error.DATA_RANGE), ('ID', 253, Error.DATA_RANGE),
    ('Torque Enable', 2, Error.DATA_RANGE), ('Position P Gain', 16384, Error.DATA_RANGE),
    ('Bus Watchdog', 128, Error.DATA_RANGE), ('Model Number', 5, Error.ACCESS),
    ('Present Position', 5, Error.ACCESS), ('Goal Position', 4096, Error.DATA_LIMIT),
    ('Goal Position', -1, Error.DATA_LIMIT), ('Goal Velocity', 511, Error.DATA_LIMIT),
    ('Goal Current', 911, Error.DATA_RANGE), ('Goal Position', 4095, Error.NONE),
    ('Goal Velocity', -510, Error.NONE)])
def test_a_value_outside_its_range_is_refused_and_changes_nothing(servo, name, value, error):
    before = servo[name]
    assert write(servo, name, value) == error
    assert servo[name] == (value if error is Error.NONE else before)


def test_extended_mode_takes_goals_beyond_one_turn_up_to_its_own_limit(servo):
    assert write(servo, 'Operating Mode', table.EXTENDED_MODE) == Error.NONE
    assert write(servo, 'Goal Position', -534) == Error.NONE
    assert write(servo, 'Goal Position', 1_048_576) == Error.DATA_RANGE
    assert servo['Goal Position'] == -534


def test_a_lowered_limit_register_limits_the_goal(servo):
    write(servo, 'Current Limit', 300)
    assert write(servo, 'Goal Current', 301) == Error.DATA_LIMIT
    assert write(servo, 'Goal Current', -300) == Error.NONE


@pytest.mark.parametrize(('address', 'data', 'error'), [
    (116, b'\0\0', Error.DATA_LENGTH), (117, b'\0\0\0', Error.DATA_LENGTH),
    (116, b'\0' * 5, Error.ACCESS), (14, b'\0', Error.ACCESS), (500, b'\0', Error.ACCESS),
    (64, b'', Error.DATA_LENGTH), (64, b'\1\1', Error.NONE), (65, b'\1\1', Error.ACCESS)])
def test_writes_must_cover_whole_known_registers(servo, address, data, error):
    assert servo.write(address, data) == error


def test_a_write_with_one_bad_value_changes_none(servo):
    assert servo.write(64, b'\1\2') == Error.DATA_RANGE
    assert not servo.torque


def test_eeprom_is_locked_while_torque_is_on(servo):
    assert write(servo, 'Torque Enable', 1) == Error.NONE
    for name in ('ID', 'Baud Rate', 'Operating Mode', 'Shutdown', 'Homing Offset'):
        assert write(servo, name, servo[name]) == Error.ACCESS, name
    assert write(servo, 'Position P Gain', 700) == Error.NONE
    write(servo, 'Torque Enable', 0)
    assert write(servo, 'Operating Mode', table.EXTENDED_MODE) == Error.NONE


@pytest.mark.parametrize(('address', 'length'), [(66, 1), (60, 3), (147, 2), (0, 0), (600, 1)])
def test_reading_where_there_is_nothing_is_refused(servo, address, length):
    assert servo.read(address, length, 0.0) == (Error.ACCESS, b'')


def test_a_change_of_mode_resets_gains_profiles_and_goals(servo):
    for name, value in (('Position P Gain', 700), ('Profile Velocity', 50), ('Goal PWM', 100)):
        write(servo, name, value)
    write(servo, 'Operating Mode', table.EXTENDED_MODE)
    assert (servo['Position P Gain'], servo['Profile Velocity'], servo['Goal PWM']) \
        == (900, 0, 885)


def test_the_watchdog_stops_the_servo_and_locks_its_goals_until_cleared(servo):
    write(servo, 'Operating Mode', table.EXTENDED_MODE)
    write(servo, 'Bus Watchdog', 5)
    servo.advance(10.0)
    assert not servo.expired, 'it counts only while torque is on'
    servo.feed_watchdog(20.0)
    write(servo, 'Torque Enable', 1)
    write(servo, 'Goal Position', 4000)
    servo.move(0.5, 3.0, 0.1)
    servo.advance(20.09)
    assert not servo.expired and servo.goal > 2
    servo.advance(20.11)
    assert servo.expired and servo['Bus Watchdog'] == 255
    assert servo.goal == pytest.approx(0.5, abs=table.POSITION_UNIT)
    for name in table.GOALS:
        assert write(servo, name, 0) == Error.DATA_RANGE
    assert write(servo, 'Bus Watchdog', 5) == Error.DATA_RANGE
    assert write(servo, 'Bus Watchdog', 0) == Error.NONE
    assert write(servo, 'Goal Position', 4000) == Error.NONE


def test_any_packet_on_the_bus_keeps_the_watchdog_quiet(network):
    for servo in network.servos:
        write(servo, 'Bus Watchdog', 5)
        write(servo, 'Torque Enable', 1)
    ask(network, 3, Instruction.PING, now=50.0)
    for servo in network.servos:
        servo.advance(50.05)
    assert not any(servo.expired for servo in network.servos)


@pytest.mark.parametrize(('fault', 'shuts_down'), [
    (table.OVERLOAD, True), (table.OVERHEATING, True), (table.SHOCK, True),
    (table.VOLTAGE_ERROR, False)])
def test_hardware_errors_raise_the_alert_and_those_of_shutdown_take_torque(servo, fault,
                                                                           shuts_down):
    write(servo, 'Torque Enable', 1)
    servo.trip(fault)
    assert servo.alert == 0x80
    assert servo.torque is not shuts_down
    assert write(servo, 'Torque Enable', 1) == (Error.RESULT_FAIL if shuts_down else Error.NONE)
    servo.reboot(0.0)
    assert servo.alert == 0
    assert write(servo, 'Torque Enable', 1) == Error.NONE


def test_a_reboot_keeps_eeprom_forgets_ram_and_the_turns(servo):
    write(servo, 'Operating Mode', table.EXTENDED_MODE)
    write(servo, 'Position P Gain', 700)
    servo.move(3.6, 0.0, 0.0)
    whole = int.from_bytes(servo.read(132, 4, 0.0)[1], 'little', signed=True)
    write(servo, 'Torque Enable', 1)
    servo.reboot(0.0)
    assert not servo.torque
    assert (servo['Operating Mode'], servo['Position P Gain']) == (table.EXTENDED_MODE, 900)
    assert whole > 4095
    assert int.from_bytes(servo.read(132, 4, 0.0)[1], 'little', signed=True) == whole - 4096


def test_position_mode_forgets_the_turns_when_torque_comes_on(servo):
    servo.move(3.6, 0.0, 0.0)
    write(servo, 'Torque Enable', 1)
    assert 0 <= int.from_bytes(servo.read(132, 4, 0.0)[1], 'little') < 4096


@given(st.floats(-3.9, 3.9), st.sampled_from((-1, 1)), st.integers(0, 4095),
       st.integers(-2, 2))
def test_goals_mean_the_same_angle_as_positions(angle, sign, zero, turns):
    servo = EmulatedServo(1, sign=sign, zero=zero)
    write(servo, 'Operating Mode', table.EXTENDED_MODE)
    servo.move(angle + turns * 2 * np.pi, 0.0, 0.0)
    servo.reboot(-1.0)
    servo.move(angle, 0.0, 0.0)
    counts = int.from_bytes(servo.read(132, 4, 0.0)[1], 'little', signed=True)
    assert write(servo, 'Goal Position', counts) == Error.NONE
    assert servo.goal == pytest.approx(angle, abs=0.51 * table.POSITION_UNIT)


# --- the line ---------------------------------------------------------------------------------


def test_only_the_addressed_servo_answers_at_its_baud_rate(network):
    assert [name for name, _, _ in ask(network, 3, Instruction.PING)] == [3]
    assert ask(network, 9, Instruction.PING) == []
    assert ask(network, 3, Instruction.PING, baud_rate=57600) == []
    assert [name for name, _, _ in ask(network, BROADCAST, Instruction.PING)] == [1, 2, 3, 4]


def test_unknown_instructions_are_refused(network):
    assert ask(network, 2, 0x20)[0][1] == Error.INSTRUCTION
    assert [refusal.identifier for refusal in network.refused] == [2]


def test_a_bad_crc_is_answered_with_its_error_and_does_nothing(network):
    broken = Packet(1, Instruction.WRITE, b'\x40\x00\x01', False)
    (reply,) = network.handle(broken, BAUD, 0.0)
    assert reply.data == status(1, Error.CRC)
    assert not network.servos[0].torque
    assert network.handle(Packet(BROADCAST, Instruction.WRITE, b'\x40\0\1', False), BAUD, 0.0) \
        == []


def test_refused_sync_writes_are_not_answered_but_recorded(network):
    write(network.servos[0], 'Torque Enable', 1)
    mode = place('Operating Mode') + bytes((1, 4, 2, 4))
    assert ask(network, BROADCAST, Instruction.SYNC_WRITE, mode) == []
    assert [(one.identifier, one.error, one.address) for one in network.refused] \
        == [(1, Error.ACCESS, 11)]
    assert network.servos[1]['Operating Mode'] == 4


@pytest.mark.parametrize('instruction', [Instruction.SYNC_READ, Instruction.FAST_SYNC_READ])
def test_servos_behind_a_silent_one_do_not_answer_either(network, instruction):
    network.silent = {3}
    (asked,) = Receiver().feed(packet(BROADCAST, instruction, place('ID') + bytes((2, 3, 4))))
    data = b''.join(reply.data for reply in network.handle(asked, BAUD, 0.0))
    if instruction == Instruction.SYNC_READ:
        assert data == status(2, 0, b'\2')
    else:
        assert data.startswith(b'\xff\xff\xfd\0\xfe\x10\0\x55\0\x02\x02')
        assert len(data) == 8 + 5


def test_old_firmware_does_not_support_fast_sync_read():
    network = ServoNetwork([EmulatedServo(1, firmware=45)])
    assert ask(network, BROADCAST, Instruction.FAST_SYNC_READ, place('ID') + b'\1') == []
    assert ask(network, BROADCAST, Instruction.SYNC_READ, place('ID') + b'\1') == [(1, 0, b'\1')]


def test_the_status_return_level_decides_what_is_answered(network):
    write(network.servos[0], 'Status Return Level', 0)
    assert ask(network, 1, Instruction.READ, place('ID')) == []
    assert ask(network, 1, Instruction.PING)
    write(network.servos[0], 'Status Return Level', 1)
    assert ask(network, 1, Instruction.READ, place('ID'))
    assert ask(network, 1, Instruction.WRITE, b'\x41\0\1') == []
    assert network.servos[0]['LED'] == 1


def test_a_rebooting_servo_is_silent_for_its_boot_time(network):
    assert ask(network, 1, Instruction.REBOOT, now=5.0) == [(1, 0, b'')]
    assert ask(network, 1, Instruction.PING, now=5.05) == []
    assert ask(network, 1, Instruction.PING, now=5.11)


@settings(max_examples=400, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([*Instruction, 0x20, 0xC3]),
                          st.sampled_from((0, 1, 2, 4, 7, BROADCAST)),
                          st.binary(max_size=30)), max_size=12))
def test_arbitrary_sequences_of_packets_raise_no_error(sequence):
    network = ServoNetwork([EmulatedServo(name, reboot_time=0.01) for name in (1, 2, 3, 4)])
    for count, (instruction, name, parameters) in enumerate(sequence):
        (asked,) = Receiver().feed(packet(name, instruction, parameters))
        for reply in network.handle(asked, BAUD, count * 0.1):
            assert reply.data.startswith(b'\xff\xff\xfd\0')
        for servo in network.servos:
            servo.advance(count * 0.1)
            assert np.isfinite(servo.goal)
            for register in table.REGISTERS:
                if register.writable and not (register.name == 'Bus Watchdog' and servo.expired):
                    assert register.low <= servo[register.name] <= register.high
