"""
The controllers of this package, registered like those of other packages.

docs/how-to/own_controller.md explains the registration.

setup.py makes an entry point of each. This module imports no large libraries; they are loaded when
a controller is built.

Line styles: blue for RL and red for NMPC as in the publication. The variants are lighter and
dashed, so that readers who cannot distinguish the colours can also read the figures.
"""

from beetle_omni_ros.control.entry import ControllerEntry, Line

nmpc = ControllerEntry(
    name='nmpc', label='NMPC', description='offset-free, params/nmpc.yaml',
    controller='beetle_omni_ros.control.nmpc:NmpcController',
    parameters='beetle_omni_ros.control.nmpc_parameters:NmpcParameters',
    parameters_file='params/nmpc.yaml', option='--nmpc', flies_degraded=True, stands_by=True,
    compared=True, cost=0.1, line=Line('#c8281e', '-', '^'))

rl = ControllerEntry(
    name='rl', label='RL', description='the learned policy, 33 observations',
    controller='beetle_omni_ros.control.policy:PolicyController',
    parameters='beetle_omni_ros.control.policy:PolicyParameters',
    parameters_file='params/rl.yaml', policy_file='policies/rl.onnx', option='--policy',
    guidance='unwinding, routing, turning, trimming', stands_by=True, compared=True, cost=0.07,
    line=Line('#1b5fb4', '-', 'o'))

rl_bare = ControllerEntry(
    name='rl_bare', label='RL, bare', description='the learned policy without guidance',
    controller='beetle_omni_ros.control.policy:PolicyController',
    parameters='beetle_omni_ros.control.policy:PolicyParameters',
    parameters_file='params/rl.yaml', policy_file='policies/rl.onnx', fixed={'without': 'all'},
    compared=True, cost=0.07, line=Line('#0b2d5c', (0, (2, 1)), 'x'))

rl_memory = ControllerEntry(
    name='rl_memory', label='RL, memory',
    description='the learned policy with the estimated disturbance as input',
    controller='beetle_omni_ros.control.policy:PolicyController',
    parameters='beetle_omni_ros.control.policy:PolicyParameters',
    parameters_file='params/rl.yaml', policy_file='policies/rl_memory.onnx',
    fixed={'policy': 'policies/rl_memory.onnx'},
    guidance='unwinding, routing, turning, trimming', compared=True, cost=0.08,
    line=Line('#58b4e8', (0, (5, 1.6)), 's'))

nmpc_published = ControllerEntry(
    name='nmpc_published', label='NMPC, published settings',
    description='params/nmpc_published.yaml',
    controller='beetle_omni_ros.control.nmpc:NmpcController',
    parameters='beetle_omni_ros.control.nmpc_parameters:NmpcParameters',
    parameters_file='params/nmpc_published.yaml', flies_degraded=True, compared=True, cost=0.13,
    line=Line('#e8960c', (0, (3, 1.2, 1, 1.2)), 'v'))

hover = ControllerEntry(
    name='hover', label='hover PD', description="PD with allocation, the supervisor's fallback",
    controller='beetle_omni_ros.control.hover:HoverController',
    parameters='beetle_omni_ros.control.hover:HoverParameters',
    parameters_file='params/hover.yaml', flies_degraded=True, cost=0.05,
    line=Line('#5b6770', (0, (1, 1.2)), 'D'))
