"""Flights of the package's own simulator: what is there is named, and nothing else."""

import pytest
from rich.console import Console
import yaml

import beetle_omni_ros
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.model.resources import share_path


def flown(folder, task, **more):
    """Bags of two flights."""
    bags = [folder / f'{seed}' for seed in (1, 2)]
    for seed, bag in enumerate(bags, 1):
        beetle_omni_ros.simulate('nmpc', task, seed=seed, bag=bag, **more)
    return bags


def gap(bags, **more):
    """Results of these flights."""
    return gap_results(bags, console=Console(quiet=True), **more)


def test_two_calm_hovers_show_only_means_and_name_nothing(tmp_path):
    result = gap(flown(tmp_path, 4 * [[0, 0, 1, 0, 0, 0]]))
    assert not result['effects'] and result['false_alarm_probability'] > 0.05
    for kind in ('force', 'acceleration', 'rate'):
        assert 'only means' in result['groups'][kind]['reason']
    assert 'only means' not in result['groups']['joint'].get('reason', '')


def test_late_tilt_commands_and_modules_that_load_the_servos_are_named_and_nothing_else(tmp_path):
    plant, robot = tmp_path / 'plant.yaml', tmp_path / 'without_modules.yaml'
    plant.write_text('extends: robot.yaml\neffects: {joint_command_latency: {delay: 0.007}}\n')
    file = yaml.safe_load(share_path('params/robot.yaml').read_text())
    module = file.pop('multibody')['module']
    file['joints']['inertia'] = 5e-5
    robot.write_text(yaml.safe_dump(file))
    effects = {effect['names'][0]: effect['parameters'] for effect in gap(
        flown(tmp_path, 'random3', plant=plant), robot=robot)['effects']}
    assert set(effects) == {'module_reaction', 'joint_command_latency'}
    # the emulated bus acts in ticks of 5 ms
    assert effects['joint_command_latency']['delay']['value'] == pytest.approx(0.010, abs=0.003)
    depth = module['centre_of_mass'][2]
    for name, true in (('module_inertia', module['inertia'][0] + module['mass'] * depth**2),
                       ('mass_moment', -module['mass'] * depth)):
        low, high = effects['module_reaction'][name]['interval']
        assert low < true < high
