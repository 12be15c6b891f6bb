"""Parameters of the training."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beetle_omni_ros.model.schema import (
    bind,
    flatten,
    group,
    nest,
    parameter,
    ParameterFile,
    unknown,
)

STRATA = ('wound_back', 'level', 'wound', 'mixed', 'hover', 'hold', 'moving')


@dataclass(frozen=True, kw_only=True)
class EpisodeParameters:
    """Time, targets and the end of an episode."""

    duration: float = parameter(16.0, doc='longest episode', unit='s', low=1, high=1000)
    target_time: np.ndarray = parameter(
        [3.0, 8.0], doc='range of the duration of a target', unit='s', shape=(2,),
        low=0.1, high=1000)
    region: np.ndarray = parameter(
        [4.0, 4.0, 3.0], doc='edges of the box of targets', unit='m', shape=(3,), low=0.1, high=50)
    position_limit: float = parameter(9.0, doc='distance from the target that ends the episode',
                                      unit='m', low=1, high=100)
    velocity_limit: float = parameter(15.0, doc='speed that ends the episode', unit='m/s', low=1,
                                      high=100)
    rate_limit: float = parameter(30.0, doc='angular rate that ends the episode', unit='rad/s',
                                  low=1, high=200)
    hold_targets: float = parameter(0.1, doc='fraction of new targets near the present pose, '
                                             'to train holding', low=0, high=1)
    level_targets: float = parameter(0.1, doc='fraction of the other targets with a level '
                                              'attitude', low=0, high=1)
    trim_share: float = parameter(
        0.5, doc='fraction of robots that fly with the trimming, whose integral needs damping; '
        'the others need accuracy', low=0, high=1)
    replay_share: float = parameter(
        0.3, doc='largest fraction of the episodes that begin with an earlier miss',
        low=0, high=0.9)


@dataclass(frozen=True, kw_only=True)
class StartParameters:
    """Shares of the robots in the strata of initial states, normalised to a sum of one."""

    wound_back: float = parameter(1.0, doc='all joints at -pi', low=0, high=100)
    level: float = parameter(1.0, doc='all joints at 0', low=0, high=100)
    wound: float = parameter(1.0, doc='all joints at +pi', low=0, high=100)
    mixed: float = parameter(1.0, doc='each joint at -pi, 0 or +pi', low=0, high=100)
    hover: float = parameter(2.0, doc='hover at a random attitude', low=0, high=100)
    hold: float = parameter(3.0, doc='hover, with the first target at the same attitude', low=0,
                            high=100)
    moving: float = parameter(1.0, doc='hover with initial velocities', low=0, high=100)
    other_branch: float = parameter(
        0.3, doc='fraction of the joints of a hover start on another turn', low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class RandomParameters:
    """Differences between robots: half-widths of uniform ranges; latencies are ranges."""

    mass_scale: float = parameter(0.05, doc='mass', low=0, high=0.5)
    inertia_scale: float = parameter(0.05, doc='inertia, each axis', low=0, high=0.5)
    arm_scale: float = parameter(0.0, doc='distance of the rotors from the centre of gravity',
                                 low=0, high=0.5)
    thrust_scale: float = parameter(0.0, doc='thrust of all rotors for a command', low=0, high=0.5)
    lag_scale: float = parameter(0.0, doc='lags of servos and rotors', low=0, high=0.5)
    weak_share: float = parameter(0.0, doc='fraction of robots with one weak rotor', low=0, high=1)
    weak_loss: float = parameter(0.3, doc='largest loss of thrust of a weak rotor', low=0, high=1)
    centre_of_mass: float = parameter(0.01, doc='each axis', unit='m', low=0, high=0.1)
    position_bias: float = parameter(0.01, doc='each axis', unit='m', low=0, high=0.2)
    position_noise: float = parameter(0.01, doc='each axis', unit='m', low=0, high=0.2)
    attitude_bias: float = parameter(0.01, doc='about each axis', unit='rad', low=0, high=0.2)
    attitude_noise: float = parameter(0.01, doc='about each axis', unit='rad', low=0, high=0.2)
    velocity_bias: float = parameter(0.005, doc='each axis', unit='m/s', low=0, high=1)
    velocity_noise: float = parameter(0.005, doc='each axis', unit='m/s', low=0, high=1)
    rate_bias: float = parameter(0.005, doc='each axis', unit='rad/s', low=0, high=1)
    rate_noise: float = parameter(0.005, doc='each axis', unit='rad/s', low=0, high=1)
    tilt_bias: float = parameter(0.0524, doc='each joint', unit='rad', low=0, high=0.5)
    tilt_noise: float = parameter(0.0349, doc='each joint', unit='rad', low=0, high=0.5)
    estimated_force_bias: float = parameter(
        0.6, doc='of the disturbance estimate of a policy with memory, each axis', unit='N',
        low=0, high=10)
    estimated_force_noise: float = parameter(0.1, doc='each axis', unit='N', low=0, high=10)
    estimated_torque_bias: float = parameter(
        0.15, doc='each axis, mostly from biased encoders', unit='N m', low=0, high=1)
    estimated_torque_noise: float = parameter(0.05, doc='each axis', unit='N m', low=0, high=1)
    noise_power: float = parameter(
        0.7, doc='scale of noise and biases of a robot is u^power, u uniform in [0, 1]; 0: full '
                 'scale for every robot', low=0, high=10)
    velocity_latency: np.ndarray = parameter([0.0, 0.025], doc='age of velocity and rate',
                                             unit='s', shape=(2,), low=0, high=0.03)
    carried_share: float = parameter(
        0.75, doc='fraction of robots that extrapolate the delayed velocity and rate along their '
        'trend, as the estimator does', low=0, high=1)
    tilt_latency: np.ndarray = parameter([0.005, 0.015], doc='age of the joint feedback',
                                         unit='s', shape=(2,), low=0, high=0.02)
    command_latency: np.ndarray = parameter([0.005, 0.015], doc='delay of commands', unit='s',
                                            shape=(2,), low=0, high=0.02)
    actuators: str = parameter(
        'measured', doc='robot file whose measured intervals of servos, rotors and delays the '
        'robots cover')
    actuator_spread: np.ndarray = parameter(
        [-0.3, 1.1], doc='place of a robot on the line from the nominal one (0) to one drawn from '
        'these intervals (1)', shape=(2,), low=-1, high=2)
    thrust_limit: np.ndarray = parameter(
        [18.0, 22.0], doc='largest thrust that the battery allows while four rotors hover',
        unit='N', shape=(2,), low=0, high=100)
    thrust_sag: float = parameter(
        0.037, doc='decrease of this thrust for each N^1.5 of the rotors beyond hover, by the '
        'resistance of the pack', unit='N^-0.5', low=0, high=1)
    force_share: float = parameter(0.3, doc='fraction of robots with a constant force', low=0,
                                   high=1)
    force: float = parameter(4.0, doc='largest constant force, each axis', unit='N', low=0,
                             high=50)
    strong_share: float = parameter(0.3, doc='fraction of robots with a strong constant force',
                                    low=0, high=1)
    strong_force: float = parameter(
        55.0, doc='largest force that the rotors have to give against a strong force and gravity',
        unit='N', low=0, high=200)
    payload_share: float = parameter(0.2, doc='fraction of robots with a payload', low=0, high=1)
    payload: float = parameter(1.1, doc='largest mass of a payload', unit='kg', low=0, high=10)
    torque: float = parameter(0.1, doc='largest constant torque with a constant force, each axis',
                              unit='N m', low=0, high=5)
    push_share: float = parameter(0.3, doc='fraction of robots with random pushes', low=0,
                                  high=1)
    push_period: float = parameter(3.0, doc='mean time between pushes', unit='s', low=0.1,
                                   high=1000)
    push_velocity: float = parameter(0.6, doc='change of velocity, standard deviation of an axis',
                                     unit='m/s', low=0, high=10)
    push_rate: float = parameter(6.5, doc='change of body rate, standard deviation of an axis',
                                 unit='rad/s', low=0, high=30)


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """Weights of the terms in :mod:`train.rewards`, with the terms' names."""

    position: float = parameter(-3.5, doc='published -1')
    pose: float = parameter(2.0, doc='published')
    reach_position: float = parameter(1.0, doc='published')
    reach_pose: float = parameter(0.75, doc='published')
    linear_velocity: float = parameter(-0.0075, doc='published -0.03')
    angular_velocity: float = parameter(-0.035, doc='published -0.05')
    joint_limit: float = parameter(-0.02, doc='published')
    thrust_limit: float = parameter(-0.01, doc='published')
    joint_action_rate: float = parameter(-0.1, doc='published -5e-4')
    thrust_action_rate: float = parameter(-2e-3, doc='published -1e-4')
    thrust_power: float = parameter(-1e-4, doc='published -1e-5; saves thrust for a low battery')
    joint_acceleration: float = parameter(-1.5e-5, doc='published')
    z_axis_align: float = parameter(-0.1, doc='published')
    thrust_allocation: float = parameter(-1e-5, doc='published')
    attitude: float = parameter(-4.0, doc='own: slope far from the target')
    near_position: float = parameter(3.5, doc='own: slope close to the target')
    near_attitude: float = parameter(2.5, doc='own: slope close to the target')
    near_pose: float = parameter(1.5, doc='own: slope close to the target')
    exact_pose: float = parameter(2.5, doc='own: slope in the last centimetres')
    joint_winding: float = parameter(-3.0, doc='own: joints beyond half a turn')
    hover_tilt_rate: float = parameter(-60.0, doc='own: smooth commands at the target')
    hover_thrust_rate: float = parameter(-1.5, doc='own: smooth commands at the target')
    sinking: float = parameter(-48.0, doc='own: below both start and target')
    termination: float = parameter(-2000.0, doc='own: smaller than the cost of the worst flight')
    scale: float = parameter(0.01, doc='scale of the sum')


@dataclass(frozen=True, kw_only=True)
class NetworkParameters:
    """Networks of actor and critic."""

    hidden: np.ndarray = parameter([512, 256, 128], doc='layers of the actor; published')
    critic: np.ndarray = parameter([512, 256, 128], doc='layers of the critic; published')
    output_scale: float = parameter(4.0, doc='action for each unit of the last layer', low=0.01,
                                    high=100)
    carry: float = parameter(0.7, doc='factor of the previous action in the output', low=0, high=1)
    last_gain: float = parameter(0.01, doc='initial gain of the last layer', low=0, high=10)
    tilt_std: float = parameter(0.6, doc='initial standard deviation of the tilt actions', low=0,
                                high=10)
    thrust_std: float = parameter(1.7, doc='initial standard deviation of the thrust actions',
                                  low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class PpoParameters:
    """Proximal policy optimisation; the published hyperparameters."""

    robots: int = parameter(4096, doc='published', low=1, high=1 << 20)
    steps: int = parameter(48, doc='steps in an iteration; published', low=1, high=10000)
    epochs: int = parameter(5, doc='published', low=1, high=100)
    minibatches: int = parameter(4, doc='minibatches in an epoch', low=1, high=1000)
    discount: float = parameter(0.99, doc='published', low=0, high=1)
    learning_rate: float = parameter(1e-3, doc='initial learning rate', low=0, high=1)
    learning_rate_limits: np.ndarray = parameter([3e-5, 1e-2], doc='limits of the adaptation',
                                                 shape=(2,))


@dataclass(frozen=True, kw_only=True)
class ScheduleParameters:
    """Values that change linearly between two fractions of the iterations."""

    begin: float = parameter(0.25, doc='fraction of the iterations at the begin of the change',
                             low=0, high=1)
    end: float = parameter(0.8, doc='fraction of the iterations at the end of the change', low=0,
                           high=1)
    kl: np.ndarray = parameter([0.01, 0.005], doc='desired divergence of an update', shape=(2,))
    entropy: np.ndarray = parameter([5e-4, 0.0], doc='weight of the entropy', shape=(2,))
    imitation: np.ndarray = parameter([1.0, 0.0], doc='weight of the divergence from the teacher, '
                                      'if there is one', shape=(2,))
    tilt_std_limit: np.ndarray = parameter([0.7, 0.08], doc='largest standard deviation of the '
                                           'tilt actions, in actions', shape=(2,))
    thrust_std_limit: np.ndarray = parameter([2.5, 0.25], doc='largest standard deviation of the '
                                             'thrust actions, in actions', shape=(2,))
    smooth: np.ndarray = parameter([0.1, 1.0], doc='factor on the weights of *_action_rate and '
                                   'hover_*_rate', shape=(2,))
    severity: np.ndarray = parameter([0.0, 1.0], doc='factor on forces, payloads and pushes',
                                     shape=(2,))
    near: np.ndarray = parameter([0.5, 1.0], doc='factor on the weights of near_*', shape=(2,))
    sinking: np.ndarray = parameter([0.3, 1.0], doc='factor on the weight of sinking', shape=(2,))


@dataclass(frozen=True, kw_only=True)
class TrainParameters(ParameterFile, file='train.yaml'):
    """All parameters of a training; each run saves them beside its checkpoints."""

    seed: int = parameter(0, doc='random seed', low=0, high=2**31 - 1)
    iterations: int = parameter(12300, doc='PPO iterations', low=1, high=10**7)
    memory: bool = parameter(False, doc='whether the policy observes the disturbance estimate')
    log_every: int = parameter(50, doc='iterations between two rows of progress', low=1,
                               high=10**6)
    save_every: int = parameter(1000, doc='iterations between two checkpoints', low=1, high=10**7)
    episode: EpisodeParameters = group(EpisodeParameters, 'episodes and targets')
    start: StartParameters = group(StartParameters, 'initial states')
    random: RandomParameters = group(RandomParameters, 'randomisation, noise, latency')
    reward: RewardWeights = group(RewardWeights, 'weights')
    network: NetworkParameters = group(NetworkParameters, 'actor and critic')
    ppo: PpoParameters = group(PpoParameters, 'optimisation')
    schedule: ScheduleParameters = group(ScheduleParameters, 'changes during training')

    def plain(self) -> dict[str, Any]:
        """Dotted key -> value as a plain number, text or list."""
        return {name: value.tolist() if isinstance(value, np.ndarray) else value
                for name, _, _, value in flatten(self)}


def read_parameters(file: Path | None, changes: dict) -> TrainParameters:
    """Read a parameter file (None: the shipped one) and replace values by dotted names."""
    flat = TrainParameters.load(file).plain()
    for key in changes.keys() - flat.keys():
        raise unknown(f'--set {key}', 'key', key, flat)
    return bind(TrainParameters, nest(flat | changes), '--set' if changes else str(file or ''))
