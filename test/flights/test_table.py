"""Flights as tables: formats, units, frames and missing samples."""

import gzip

import numpy as np
import pytest

from beetle_omni_ros.identify.recording.conventions import read_tables
from beetle_omni_ros.identify.recording.table import Format
from beetle_omni_ros.model.schema import ParameterError

FORMAT = """
time: {columns: [ms], unit: ms}
specific_force: {columns: [a, b, c], unit: g, sign: [1, -1, 1]}
quaternion: {columns: [w, x, y, z], order: wxyz, frame: world_to_body}
duty: {columns: [d1, d2, d3, d4], full: 65535}
"""
HEADER = 'ms,a,b,c,w,x,y,z,d1,d2,d3,d4\n'


def declared(tmp_path, text=FORMAT):
    path = tmp_path / 'own.yaml'
    path.write_text(text)
    return Format.load(str(path))


def rows(times, cells='0,0.5,1,0.8,0.6,0,0,65535,0,0,0'):
    return ''.join(f'{t},{cells}\n' for t in times)


def test_units_signs_orders_and_directions_are_those_that_the_format_declares(tmp_path):
    path = tmp_path / 'flight.csv.gz'
    path.write_bytes(gzip.compress((HEADER + rows(range(0, 200, 10))).encode()))
    table, = read_tables([path], declared(tmp_path))
    assert table.period == pytest.approx(0.01)
    assert np.allclose(table.values['specific_force'][0], [0, -0.5 * 9.80665, 9.80665])
    # w, x, y, z of the world in the body becomes x, y, z, w of the body in the world
    assert np.allclose(table.values['quaternion'][0], [-0.6, 0, 0, 0.8])
    assert np.allclose(table.values['duty'][0], [1, 0, 0, 0])


def test_readings_in_world_are_turned_by_the_attitude_of_its_row(tmp_path):
    path, world = tmp_path / 'flight.csv', FORMAT.replace('unit: g,', 'unit: g, frame: world,')
    path.write_text(HEADER + rows(range(0, 200, 10)) + '200,0,0.5,1,,0.6,0,0,0,0,0,0\n')
    forces = read_tables([path], declared(tmp_path, world))[0].values['specific_force']
    # (0, -0.5, 1) g, and the world is turned in the body by 2 acos(0.8) about x
    cosine, sine = 0.28, 0.96
    expected = [0, -0.5 * cosine - sine, cosine - 0.5 * sine]
    assert np.allclose(forces[:20] / 9.80665, expected) and np.isnan(forces[20]).all()
    rates = FORMAT.replace('specific_force', 'angular_velocity').replace('unit: g', 'unit: rad/s')
    turned, = read_tables([path], declared(tmp_path, rates.replace(
        'rad/s,', 'rad/s, frame: world,')))
    assert np.allclose(turned.values['angular_velocity'][:20], expected)
    for text in (world, rates.replace('rad/s,', 'rad/s, frame: world,')):
        with pytest.raises(ParameterError, match="'quaternion' is missing: expected the attitude"):
            declared(tmp_path, ''.join(line for line in text.splitlines(True)
                                       if 'wxyz' not in line))
    with pytest.raises(ParameterError, match="expected one of body, world, found 'sky'"):
        declared(tmp_path, FORMAT.replace('unit: g,', 'unit: g, frame: sky,'))


def test_the_header_may_be_a_comment_as_numpy_writes_it(tmp_path):
    path, numbers = tmp_path / 'flight.csv', np.arange(20)[:, None] * [10, *range(11)]
    np.savetxt(path, numbers, delimiter=',', header='made by numpy\n' + HEADER.strip())
    assert np.allclose(read_tables([path], declared(tmp_path))[0].values['duty'][3], [
        21 / 65535, 24 / 65535, 27 / 65535, 30 / 65535])
    np.savetxt(path, numbers, delimiter=',', header='made by numpy')
    with pytest.raises(ParameterError, match='the header is missing'):
        read_tables([path], declared(tmp_path))


def test_a_single_column_needs_no_list_and_the_unit_1_no_quotes(tmp_path):
    form = declared(tmp_path, FORMAT.replace('[ms]', 'ms') + 'voltage: {columns: u, unit: mV}\n')
    assert form.signals['time'].columns == ('ms',) and form.signals['voltage'].columns == ('u',)
    assert declared(tmp_path, FORMAT.replace('duty: {', 'duty: {unit: 1, ')).signals['duty']


def test_empty_cells_and_lost_rows_are_samples_that_do_not_exist(tmp_path):
    path = tmp_path / 'flight.csv'
    lines = rows(range(0, 90, 10)) + '90,0,0,1,0,0,0,0,0,0,0,0\n' \
        + '100,,0,1,1,0,0,0,,0,0,0\n' + rows(range(130, 200, 10))
    path.write_text(HEADER + lines)
    table, = read_tables([path], declared(tmp_path))
    assert len(table) == 20
    assert np.isnan(table.values['specific_force'][10]).tolist() == [True, False, False]
    assert np.isnan(table.values['quaternion'][9]).all()    # a pose that MoCap has lost
    assert np.isnan(table.values['duty'][11:13]).all()
    assert not np.isnan(table.values['duty'][13]).any()


def test_the_elements_of_lists_in_a_cell_are_columns(tmp_path):
    path = tmp_path / 'flight.csv'
    path.write_text(',t,p,v,q,R,w,pwm,p_d\n' + ''.join(
        f'{k},{0.02 * k},"[{k}.5, -1, 2e-1]","[1, 2, 3]","[0, 0, 0, 1]","[[1, 0], [0, 1]]",'
        '"[0, 0, nan]","[500, 600, 700, 1000]","[0, 0, 0]"\n' for k in range(12)))
    values = read_tables([path], Format.load('neural_fly'))[0].values
    assert np.allclose(values['position'][3], [3.5, -1, 0.2])
    assert np.allclose(values['duty'][0], [0.25, 0.3, 0.35, 0.5])
    assert np.isnan(values['angular_velocity'][:, 2]).all()
    path.write_text(path.read_text().replace('[4.5, -1, 2e-1]', '[4.5, -1]'))
    with pytest.raises(ParameterError, match='flight.csv: row 6'):
        read_tables([path], Format.load('neural_fly'))


@pytest.mark.parametrize('text, message', [
    ('duty: {columns: [a, b, c, d]}', "'time' is missing"),
    ('time: {columns: [t], unit: h}', "time.unit': expected one of s, ms, us, ns, found 'h'"),
    ('time: {columns: [t], unit: s}\nposition: {columns: [x, y], unit: m}',
     "position.columns': expected 3 names"),
    ('time: {columns: [t], unit: s}\nspeed: {columns: [x]}', 'unknown signal'),
    ('time: {columns: [t], unit: s}\nquaternion: {columns: [a, b, c, d], order: zyxw}',
     "quaternion.order': expected one of xyzw, wxyz"),
])
def test_a_wrong_format_is_refused_with_file_and_key(tmp_path, text, message):
    with pytest.raises(ParameterError, match='own.yaml') as error:
        declared(tmp_path, text)
    assert message in str(error.value)


@pytest.mark.parametrize('lines, message', [
    (rows(range(0, 100, 10)) + '100,up,0,1,1,0,0,0,0,0,0,0\n', 'row 12, column a'),
    (rows([0, 10, 10] + list(range(20, 100, 10))), 'increasing times'),
    ('1,2,3\n', 'expected 12 values, found 3'),
])
def test_a_wrong_row_is_refused_with_file_row_and_column(tmp_path, lines, message):
    path = tmp_path / 'flight.csv'
    path.write_text(HEADER + lines)
    with pytest.raises(ParameterError, match='flight.csv') as error:
        read_tables([path], declared(tmp_path))
    assert message in str(error.value)


def test_a_column_of_the_format_that_the_table_lacks_is_named(tmp_path):
    path = tmp_path / 'flight.csv'
    path.write_text('ms,a,b,c\n0,0,0,1\n')
    with pytest.raises(ParameterError, match="no column 'w'"):
        read_tables([path], declared(tmp_path))


def test_an_unknown_format_names_the_shipped_ones():
    with pytest.raises(ParameterError, match='crazypad_motor, nanobench'):
        Format.load('px4')
