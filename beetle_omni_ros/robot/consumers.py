"""
Who acts on which effect of a robot file, who leaves it to another, and who refuses it.

A consumer's stand on an effect follows from how the effect acts (:attr:`Effect.kind`). A new
entry of the catalogue therefore has a stand everywhere, and one test over all of them holds that
the stand is true.
"""

from __future__ import annotations

from beetle_omni_ros.robot.effect_types import Stand
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

CONSUMERS = {'nmpc': 'NMPC and allocation', 'training': 'training', 'plant': 'simulated plant',
             'estimator': 'estimator', 'buses': 'delays of the buses', 'gap': 'gap finder'}
ACTS = Stand(True)
_CORRECTED = Stand(False, 'the estimator corrects the readings first')
_NO_MODEL = Stand(False, 'the filter follows the IMU and has no model of forces or servos')
_NO_DELAY = Stand(False, 'the effect delays no command')
_NO_JOINTS = Stand(False, 'the filter does not read the joints')
_STANDS = {
    'nmpc': {'sensor': _CORRECTED, 'play': Stand(
        False, 'a play is an offset of the servos, which is estimated in flight')},
    'training': {'sensor': _CORRECTED, 'play': Stand(
        False, 'the model of the servos has no play: train with joint_deflection or '
               'joint_friction, or take the effect out of the file', error=True)},
    'plant': {'play': Stand(
        False, 'MuJoCo has no play between encoder and rotor', error=True)},
    'estimator': {**dict.fromkeys(('body', 'servo', 'number', 'command', 'play'), _NO_MODEL),
                  'feedback': _NO_JOINTS},
    'buses': dict.fromkeys(('body', 'servo', 'number', 'sensor', 'feedback', 'play'), _NO_DELAY),
    'gap': {}}


def stand(consumer: str, name: str) -> Stand:
    """
    Stand of a consumer on an effect.

    Args:
        consumer: one of ``CONSUMERS``.
        name: of the catalogue.

    """
    effect = CATALOGUE[name]
    return effect.stands.get(consumer) or _STANDS[consumer].get(effect.kind, ACTS)


def check(consumer: str, robot: RobotParameters) -> None:
    """
    Refuse a robot with an effect that the consumer cannot have.

    Raises:
        ParameterError: naming the effect and the reason.

    """
    for name in robot.effects:
        found = stand(consumer, name)
        if found.error:
            raise ParameterError(f'effects.{name}: the {CONSUMERS[consumer]} refuses this effect: '
                                 f'{found.reason}')
