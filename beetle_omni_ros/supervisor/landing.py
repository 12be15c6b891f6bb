"""Takeoff and landing, stepped by the supervisor: the way up, and why and how to come down."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import Command, Fallback, State, TrajectoryTarget
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.model.degraded import FLYING_MARGIN, Holding
from beetle_omni_ros.supervisor.commands import Output
from beetle_omni_ros.supervisor.inputs import Inputs
from beetle_omni_ros.supervisor.interface import ERROR
from beetle_omni_ros.supervisor.way import climb, coasted, halting, inclination, plan, Ramp, Way
from beetle_omni_ros.supervisor.wrench import NEAR_GROUND

ESCAPE_TIME = 1.5       # [s] of the attitude of an escape, before the turn to level
ACCELERATION = 0.5      # [m/s^2] of climb and descent
MOCAP_PATIENCE = 1.5    # [s] of dead reckoning until landing; its velocity error is then 0.1 m/s
                        # and grows
# Takeoff
CLIMB_SPEED = 0.5       # [m/s]
GROUND_RATE = 0.5       # [rad/s] at which an inclination of the ground is levelled
AIRBORNE = 0.05         # [m] of rise; below it the reaction to a fault is motors off
CLEARANCE = 0.3         # [m] smallest climb, for a start from a platform
ALIGN_RATE = 2.0        # [rad/s] of the joints, which turn to their hover angles first
ALIGNED = 0.1           # [rad] larger than the servos' sag of 0.02 rad
ALIGN_PATIENCE = 4.0    # [s] the farthest joint needs 2 s
NEAR, SLOW = 0.15, 0.2  # [m] error of the hover controller with a 10 % wrong mass; [m/s]
PATIENCE = 4.0          # [s] after the climb
# Levelling
TURN_HEIGHT = 1.2       # [m] above the ground to turn over with a weak pack, which costs 0.5 m
LEVEL_RATE = 0.8        # [rad/s] from upside down to level in 4 s
LEVEL_FIRST = 0.3       # [rad] a larger inclination is levelled before the descent
BLIND_LIMIT = 0.3       # [s] without any sensor the attitude is then unknown: motors off
# Silent joints that are not where they should be
CONTRADICTED = 0.5      # [-] of the weight, by which accelerometer and modelled force differ:
                        # joints 0.5 rad beside their commands; the lag of a turn is below 0.1 rad
CONTRADICTED_TIME = 0.3     # [s] in which the robot gains 1.5 m/s
ADRIFT = 2.0            # [m/s] a faster robot is not held by its stopped joints
# The ground
SPEED = 0.3             # [m/s] of the descent, harmless for the legs
TARGET_LEAD = 0.5       # [m] depth of the target below the robot
STILL_SPEED = 0.12      # [m/s] a slower robot may stand on the ground
CARRIED = 0.2           # [-] share of the weight that the ground carries
FELT = 0.1              # [s] time constant of this share
GROUND_TIME = 0.3       # [s] of both; the rotors need 0.1 s to settle
STILL_TIME = 1.0        # [s] without sinking until the ground is detected without IMU
AHEAD, BETWEEN = 20.0, 0.1      # [s] length and spacing of the published way


class Takeoff:
    """
    Joints to their hover angles, then a climb by the hover controller.

    Attributes:
        failure: '' or the reason of an abort.
        done: whether the height is reached.
        airborne: whether it has left the ground.

    """

    def __init__(self, height: float, allocator: Allocator, hover: Fallback, state: State):
        self._hover, self._start = hover, state
        self._tilt = np.clip(state.tilt, -allocator.tilt_limit, allocator.tilt_limit)
        self._goal_tilt = allocator.hover(state.quaternion, self._tilt).tilt
        self._rise = max(height - state.position[2], CLEARANCE)
        self._end = state.position + np.array([0.0, 0.0, self._rise])
        self._ramp: Ramp | None = None
        self._aligned_for = self._climbed_for = 0.0
        self.failure, self.done, self.airborne = '', False, False
        hover.reset()

    def step(self, state: State, dt: float) -> Command:
        """The command for the present time."""
        self.airborne |= bool(state.position[2] > self._start.position[2] + AIRBORNE)
        if self._ramp is None:
            return self._align(state, dt)
        self._climbed_for += dt
        over = self._climbed_for - self._ramp.duration
        if over >= 0 and np.linalg.norm(state.position - self._end) < NEAR \
                and np.linalg.norm(state.velocity) < SLOW:
            self.done = True
        elif over > PATIENCE:
            # In the air, off target: the hand-over follows. On the ground: abort.
            self.done = self.airborne
            if not self.airborne:
                self.failure = f'still on the ground {PATIENCE:g} s after the climb'
        self._hover.observe(state, free=self.airborne)
        # The ramp runs by counted time, which a step of the clock does not change.
        return self._hover.step(state, self._ramp.at(self._climbed_for))

    def _align(self, state, dt):
        reach = ALIGN_RATE * dt
        self._tilt = self._tilt + np.clip(self._goal_tilt - self._tilt, -reach, reach)
        self._aligned_for += dt
        error = np.abs(state.tilt - self._goal_tilt)
        if error.max() < ALIGNED and np.array_equal(self._tilt, self._goal_tilt):
            level = rotations.from_rpy(0.0, 0.0, rotations.to_rpy(state.quaternion)[2])
            turn = max(rotations.geodesic_angle(level, state.quaternion) / GROUND_RATE, 1e-9)
            self._ramp = Ramp(0.0, self._start.position,
                              Way(np.array([0.0, turn]), np.array([state.quaternion, level])),
                              climb(self._rise, CLIMB_SPEED, ACCELERATION))
        elif self._aligned_for > ALIGN_PATIENCE:
            k = int(error.argmax())
            self.failure = f'gimbal{k + 1} is {error[k]:.2f} rad from its place after ' \
                           f'{ALIGN_PATIENCE:g} s (joint_bridge_node)'
        return Command(state.stamp, self._tilt, np.zeros(4))


def why_land(inputs: Inputs) -> tuple[str, str] | None:
    """Text of the most urgent reason, and name of the fault, '' for one that has a name."""
    if text := inputs.unready('rotor'):
        return f'{text}: landing while it may follow', 'rotor_bridge_lost'
    if 'estimator_wrong' in inputs.faults and not inputs.backup.running:
        return 'the estimate contradicts MoCap: controlled descent on raw sensors', ''
    if inputs.ekf.silent:
        return f'ekf_node {inputs.ekf.text}: controlled descent on raw sensors', 'estimator_lost'
    if 'mocap_jumped' in inputs.faults:
        return 'MoCap jumped: landing', ''
    if inputs.mocap.lost and inputs.mocap.elapsed > MOCAP_PATIENCE:
        return f'MoCap {inputs.mocap.text}: landing by dead reckoning', 'mocap_lost'
    if inputs.joints.silent or inputs.unready('joint'):
        text = inputs.unready('joint') or f'joint_bridge_node {inputs.joints.text}'
        return (f'{text}: landing with the joints as they are', 'joint_bridge_lost') \
            if 'joint' in inputs.bridges else \
            (f'{text}: landing with the joints where they were commanded', 'joints_lost')
    if inputs.battery_empty:
        return f'battery empty ({inputs.voltage:.1f} V): landing', 'battery_empty'
    if inputs.outside(0.0):
        return 'left the fence: landing', 'fence_left'
    return None


class Landing:
    """
    One way down from any attitude, with any remaining estimate and actuators.

    Attributes:
        grounded: whether the robot is on the ground.
        given_up: '' or the reason why a controlled descent is no longer possible.
        ramp: the plan.

    """

    def __init__(self, inputs: Inputs, output: Output, hover: Fallback):
        self._inputs, self._output, self._hover = inputs, output, hover
        self.grounded, self.given_up = False, ''
        self._standing_for = self._still_for = self._blind_for = self._contradicted_for = 0.0
        self._support = 0.0     # share of the weight that the rotors do not carry, filtered
        self._rise = 0.0        # of the present plan, before a turn over [m]
        if 'estimator_wrong' in inputs.faults or inputs.ekf.silent:
            inputs.backup.start(inputs.estimate)
        self.set_out()
        self._halting = inputs.health.healthy

    @property
    def way(self) -> TrajectoryTarget:
        """The planned way, for a controller that can fly a trajectory."""
        ramp = self.ramp
        times = ramp.stamp + np.arange(0.0, ramp.duration + AHEAD, BETWEEN)
        samples = [ramp.at(time) for time in times]
        return TrajectoryTarget(times, np.array([one.position for one in samples]),
                                np.array([one.quaternion for one in samples]),
                                np.array([one.velocity for one in samples]),
                                np.array([one.angular_velocity for one in samples]), ramp.stamp)

    def step(self, now: float, dt: float) -> Command:
        """The command for the present time."""
        inputs, backup = self._inputs, self._inputs.backup
        if not backup.running and inputs.ekf.silent:
            inputs.say(ERROR, f'ekf_node {inputs.ekf.text}: descent goes on with raw sensors')
            backup.start(inputs.estimate)
            self.set_out()
        if not backup.running:
            return self._follow(self._seen, dt)
        for source, name in ((inputs.mocap, 'MoCap'), (inputs.imu, 'IMU')):
            if source.silent:
                inputs.say(ERROR, f'{name} is gone too: descent without it', f'no {name}')
        no_mocap, no_imu = inputs.mocap.silent, inputs.imu.silent
        self._blind_for = self._blind_for + dt if no_mocap and no_imu else 0.0
        if self._blind_for > BLIND_LIMIT:
            self.given_up = 'no estimator, no MoCap, no IMU'
        if no_imu:
            force, torque = inputs.allocator.wrench(self._seen.tilt, self._output.thrusts)
            backup.predict(now, force / inputs.allocator.mass, torque / inputs.robot.inertia)
        return self._follow(self._seen, dt)

    @property
    def _seen(self):
        return self._inputs.seen(self._output.in_force)

    # The plan ---------------------------------------------------------------------------------

    def set_out(self) -> None:
        """Plan the way down from the present pose, with the actuators that work."""
        inputs, state = self._inputs, self._seen
        climbed, self._halting, self._rise = self._rise > 0, False, 0.0
        if inputs.health.healthy:
            way = plan(state.quaternion, state.tilt, inputs.allocator, LEVEL_RATE)
        else:
            way = self._escape(state, climbed)
        slanted = inclination(state.quaternion) > LEVEL_FIRST or not inputs.health.healthy
        begin = way.duration if slanted else 0.0
        knots = [(begin + 1e-9, 0.0), (begin + SPEED / ACCELERATION, -SPEED)]
        if self._rise > 0:
            knots = [(begin + time, speed)
                     for time, speed in climb(self._rise, CLIMB_SPEED, ACCELERATION)]
        self.ramp = Ramp(state.stamp, coasted(state), way, [(0.0, 0.0), *knots])

    def _escape(self, state, climbed):
        """First to the attitude where control is regained soonest, then towards level."""
        # With a weak pack the attitudes on the side can be passed only fast, at a loss of height.
        # A low robot on its back remains there and climbs first.
        inputs, height = self._inputs, self._inputs.height
        holding = Holding(inputs.robot, inputs.health)
        on_back = inclination(state.quaternion) > 0.5 * np.pi
        if not climbed and on_back and height is not None and height < TURN_HEIGHT \
                and replace(inputs.health, thrust_limit=None).healthy:
            self._rise = TURN_HEIGHT + NEAR - height
        escape = holding.quickest(state.quaternion, state.angular_velocity, state.tilt,
                                  FLYING_MARGIN, np.inf if self._rise > 0 else LEVEL_RATE)
        if self._rise > 0:
            return Way(np.array([0.0, ESCAPE_TIME]), np.array([escape, escape]))
        level = rotations.from_rpy(0.0, 0.0, rotations.to_rpy(state.quaternion)[2])
        goal = holding.nearest(level, FLYING_MARGIN)
        turn = max(rotations.geodesic_angle(goal, escape) / LEVEL_RATE, 1e-3)
        # The escape attitude is the reference at once: a sampled path to it costs height.
        return Way(np.cumsum([0.0, ESCAPE_TIME, turn]), np.array([escape, escape, goal]))

    # The descent ------------------------------------------------------------------------------

    def _follow(self, state, dt):
        """Follow the ramp, whose target waits for the robot."""
        halt = halting(state, self.ramp.position[2]) if self._halting else None
        if self._halting and halt is None \
                or self._rise > 0 and state.stamp > self.ramp.stamp + self.ramp.duration:
            self.set_out()
        reference = halt or self.ramp.at(state.stamp)
        height = max(reference.position[2], state.position[2] - TARGET_LEAD)
        reference = replace(reference, position=np.array([*reference.position[:2], height]))
        self._feel_ground(state, dt, reference.velocity[2])
        self._doubt_joints(state, dt)
        # Rates from MoCap only are late and noisy: no update of the disturbance.
        self._hover.observe(state, free=self._inputs.backup.imu_alive)
        return self._hover.step(state, reference)

    def _feel_ground(self, state, dt, speed):
        """The rotors carry clearly less than the weight, but the robot does not fall."""
        inputs = self._inputs
        # Without IMU the velocity comes from the rotor model, which does not include the floor.
        backup = inputs.backup
        no_imu = backup.running and not backup.imu_alive
        by_poses = backup.velocity_by_poses if no_imu else None
        still = abs(state.velocity[2] if by_poses is None else by_poses[2]) < STILL_SPEED
        # Used only if motion is not measured: an upward wind would seem to be the ground.
        specific_force_up = inputs.specific_force_up if inputs.blind else None
        model, gravity = inputs.allocator, inputs.robot.gravity
        force, _ = model.wrench(state.tilt, self._output.thrusts)
        lift = float(rotations.matrix(state.quaternion)[2].dot(force)) / model.mass
        felt = gravity if specific_force_up is None else specific_force_up
        # The accelerometer jitters on the floor, by more than the weight with idle rotors.
        self._support += min(1.0, dt / FELT) * ((felt - lift) / gravity - self._support)
        sinking = speed < -0.5 * SPEED
        stands = sinking and self._support > CARRIED and (still or specific_force_up is not None)
        self._standing_for = self._standing_for + dt if stands else 0.0
        self._still_for = self._still_for + dt if no_imu and sinking and still else 0.0
        self.grounded = self._standing_for >= GROUND_TIME - 1e-9 or self._still_for >= STILL_TIME

    def _doubt_joints(self, state, dt):
        """Without feedback the joints may have stopped: motors off before the robot flies away."""
        inputs, sample, contradicted = self._inputs, self._inputs.backup.sample, False
        near = inputs.height is not None and inputs.height < NEAR_GROUND
        if inputs.joints.silent and not inputs.imu.silent and sample is not None and not near:
            force, _ = inputs.allocator.wrench(state.tilt, self._output.thrusts)
            missing = np.linalg.norm(force / inputs.allocator.mass - sample[1])
            adrift = 'joint' in inputs.bridges and np.linalg.norm(state.velocity) > ADRIFT
            contradicted = bool(adrift or missing > CONTRADICTED * inputs.robot.gravity)
        self._contradicted_for = self._contradicted_for + dt if contradicted else 0.0
        if self._contradicted_for >= CONTRADICTED_TIME:
            self.given_up = 'the silent joints are not where they should be'
