"""
The supervisor: selects the command of the actuators and reacts to faults.

A pure state machine that reads no clock and no topic. All times are arguments, so that the node
and the in-process evaluation run the same code with the same results. See docs/safety.md.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import exp

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, Fallback, PoseTarget, Target
from beetle_omni_ros.model.allocation import ALL_HEALTHY, clipped, NO_ZEROS, ROTORS
from beetle_omni_ros.model.mode import (
    COMMAND_AGE,
    DISARMED,
    FALLBACK,
    FLYING,
    IN_FLIGHT,
    LANDING,
    Mode,
    MOTORS_OFF,
    STOPPED,
    TAKEOFF,
)
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor.commands import within_limits
from beetle_omni_ros.supervisor.inputs import ARM_TILT, Inputs
from beetle_omni_ros.supervisor.interface import Answer, ERROR, INFO, SupervisorParameters, WARNING
from beetle_omni_ros.supervisor.landing import Landing, Takeoff
from beetle_omni_ros.supervisor.way import coasted, halting, inclination
from beetle_omni_ros.supervisor.wrench import NEAR_GROUND

STOP_TIME = 0.3         # [s] zero thrust is sent for this time, then nothing
HANDOVER_TIME = 0.3     # [s] longest duration: half a turn of a joint
TILT_RATE = 9.0         # [rad/s] as in hover.yaml: below the servos' 10
THRUST_RATE = 300.0     # [N/s] as in hover.yaml: 3 N a period
AHEAD = 0.5             # [rad] from its target a joint turns at its full rate: 50 ms of delay and
                        # lag at 10 rad/s
LOOK = 0.02             # [s] after a pause without a command: two periods of MoCap, because the
                        # robot may lie on the floor
LATE_TIME = 0.3         # [s] three lags of a rotor after late commands: no actuator is suspected
RESUMING = 0.1          # [s] after a pause until every source has sent a message again
FALLBACK_TIME = 30.0    # [s] of fallback until landing; enough to restart a controller
MOCAP_PATIENCE = 1.5    # [s] of dead reckoning until landing; its velocity error is then 0.1 m/s
                        # and grows
RECOVERY_TIME = 1.0     # [s] in which a landing stops a tumble of 15 rad/s
FENCE_MARGIN = 2.0      # [m] farther outside the fence a landing is a flyaway: motors off
LANDING_LIMIT = 90.0    # [s] from the margin above the fence it takes 74 s, and levelling 4 s


class Supervisor(Inputs):
    """
    Arms, selects, checks, falls back, lands.

    ``fallback`` flies takeoff, fallback and landing. ``controllers`` may be active; None: those on
    standby.

    Attributes:
        state: 'disarmed', 'takeoff', 'flying', 'fallback', 'landing' or 'emergency_stop'.
        source: of the executed command: a controller's name, 'hover' or 'none'.
        target_override: target of the controllers that replaces the operator's target, or None.

    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 fallback: Fallback, controllers: Sequence[str] | None = None):
        controllers = tuple(registry.STANDING_BY if controllers is None else controllers)
        super().__init__(parameters, robot, controllers)
        self._pilot = registry.pilot(controllers)
        self._hover = fallback
        self._handover_left = 0.0   # after a change of the controller [s]
        self.state, self.source = DISARMED, 'none'
        self.target_override: Target | None = None
        self._cycle = {TAKEOFF: self._take_off, FLYING: self._fly, FALLBACK: self._hold,
                       LANDING: self._descend}
        # Objects of the present state, created when it is entered.
        self._takeoff: Takeoff
        self._landing: Landing
        self._target: PoseTarget | None     # of the fallback; None until the turn has ended
        self._height: float
        self._in_state = 0.0    # time since the last change of the state [s]
        self._acted_on = ALL_HEALTHY    # health to which landing and hover are adapted
        self._given: Command | None = None      # the last output before the final check
        self._asked: Command | None = None      # and after it
        self._before = np.inf       # time of the update before [s]
        self._resumed = -np.inf     # time of the last pause [s]

    # Requests ---------------------------------------------------------------------------------

    def arm(self, now: float) -> Answer:
        """Start the motors and take off, or return the reason of the refusal."""
        reason = self.why_not_arm() if self.state == DISARMED else f'{self.state}, not disarmed'
        if reason:
            return self._refuse(f'arm refused: {reason}')
        self._in_force = self._given = None
        self._takeoff = Takeoff(self._parameters.takeoff_height, self.allocator, self._hover,
                                self.seen)
        self.floor = float(self.estimate.position[2])
        self.watch.reset()
        self._acted_on = ALL_HEALTHY
        self._hover.set_health(ALL_HEALTHY)
        return self._enter(TAKEOFF, INFO, 'armed: takeoff')

    def disarm(self, now: float) -> Answer:
        """Motors off, on the ground or after an emergency stop; refused in the air."""
        if self.airborne:
            return self._refuse(f'disarm refused: {self.state}; land or emergency_stop')
        if self.state == DISARMED:
            return Answer(True, 'already disarmed')
        return self._enter(DISARMED, INFO, 'disarmed')

    def emergency_stop(self, now: float, reason: str = 'requested') -> Answer:
        """Motors off at once, latched until disarmed."""
        if self.state == STOPPED:
            return Answer(True, 'already stopped')
        return self._enter(STOPPED, ERROR, f'emergency stop: {reason}')

    def land(self, now: float) -> Answer:
        """Descend at the present position, motors off at the ground."""
        if self.state not in IN_FLIGHT:
            return self._refuse(f'land refused: {self.state}, not in flight')
        if self.state == LANDING:
            return Answer(True, 'already landing')
        return self._land(now, INFO, 'landing on request')

    def select(self, controller: str, now: float | None = None) -> Answer:
        """Select another controller; in flight only one with valid commands."""
        if controller == self.active:
            return Answer(True, f'{controller} is active')
        stream = self.streams.get(controller)
        if stream is None:
            return self._refuse(f"select refused: unknown controller '{controller}'; known: "
                                f"{', '.join(self.streams)}")
        if self.state in IN_FLIGHT and not stream.good:
            return self._refuse(f'select refused: {controller}_node {stream.complaint}; '
                                f'{self.active} stays selected')
        self.active = controller
        self._handover_left = HANDOVER_TIME
        self.say(INFO, f'{controller} selected')
        return Answer(True, f'{controller} selected')

    def _refuse(self, text):
        self.say(WARNING, text)
        return Answer(False, text)

    # The cycle --------------------------------------------------------------------------------

    def update(self, now: float) -> Command | None:
        """
        A finite command within limits, or None: nothing is sent.

        Call it at least every 10 ms.
        """
        dt = self._tick(now)
        self._in_state += dt
        self._look_for_faults(now)
        if self.state in IN_FLIGHT:
            self._react(now)
        command = self._guarded(self._cycle.get(self.state, self._stand)(now, dt), now)
        if self.state in IN_FLIGHT:
            self.airborne = self.state != TAKEOFF or self._takeoff.airborne
            share = 1 - exp(-dt / self.robot.rotors.time_constant)
            self.thrusts += share * ((0.0 if command is None else command.thrust) - self.thrusts)
        return command

    def _guarded(self, command, now):
        """Final check of a new output: finite, inside limits."""
        if command is None or now - self._resumed < LOOK:
            return None
        if command is self._given:
            return self._asked
        self._given = command
        self._in_force = self._asked = asked = within_limits(command, self.robot)
        if asked is None:
            self.emergency_stop(now, f'{self.source} gave a command that is not finite')
            return None
        if self.health.zeros != NO_ZEROS:       # in angles of the encoder that jumped
            limit = self.robot.joints.position_limit
            self._asked = asked = replace(
                asked, tilt=clipped(self.health.read(asked.tilt), -limit, limit))
        self.watch.on_command(asked)
        return asked

    # Faults -----------------------------------------------------------------------------------

    def _look_for_faults(self, now):
        """Results of the detectors, in the air."""
        paused, self._before = now - self._before, now
        if self.airborne and self.imu.lost and 'imu_frozen' not in self.faults:
            self.watch.name('imu_lost', now, f'the raw IMU is {self.imu.text}')
        if self.airborne and self.rotors.lost and 'rotor' in self.bridges:
            self.watch.name('rotor_bridge_silent', now, f'rotor_bridge_node {self.rotors.text}')
        while self.watch.news:
            self.say(ERROR, self.watch.news.pop(0))
        if not self.airborne:
            return
        contact, poses = self.watch.contact.reason, self.backup.poses
        flies = self.state == FLYING or self._in_state < LATE_TIME
        self.watch.paused = self.ages.partly or flies and self.streams[self.active].ages.partly
        if paused > COMMAND_AGE:
            self.watch.name('supervisor_paused', now)
            self.watch.restart()
            self._resumed = now
            self.say(WARNING, f'supervisor_node was not scheduled for {1000 * paused:.0f} ms: the '
                            'actuators had stopped')
            if self.state == FLYING:
                self._fall_back(now, WARNING, 'fallback to hover after the pause')
        # Messages queued during the pause are older. The estimate may be wrong after a fall.
        elif now - self._resumed < RESUMING and not self.mocap.silent \
                and poses[-1][1][2] - self.floor < NEAR_GROUND:
            contact = 'on the floor after the pause'
        if contact and self.state == LANDING and inclination(self.best.quaternion) < ARM_TILT:
            self._enter(DISARMED, INFO, f'on the ground, {contact}: motors off, disarmed')
        elif contact:
            self.watch.name('crash', now)
            self.emergency_stop(now, f'crash: {contact}')
        elif self.health is not self._acted_on:
            self._degrade(now)

    def _degrade(self, now):
        """Land with the working actuators, in the attitude nearest level with a margin."""
        before, self._acted_on, self._given = self._acted_on, self.health, None
        if self.health.healthy:
            return      # a zero has moved, which is corrected in commands and readings
        self._hover.set_health(self.health)
        if self.state != LANDING:
            self._land(now, ERROR, f"{', '.join(self.faults)}: landing with what is left")
        elif before.same_actuators(self.health):
            return
        else:
            self._landing.set_out()
        if self.state == LANDING:
            self.target_override = self._landing.way

    def _react(self, now):
        """Faults that end or change a flight with any controller, the most urgent first."""
        if self.battery_low:
            self.say(WARNING, f'battery low: {self.voltage:.1f} V', 'battery')
        no_rotors = self.unready('rotor')
        if no_rotors and not self.bridges['rotor'].startswith('silent:'):
            if not self.airborne:
                self._enter(DISARMED, ERROR, f'{no_rotors}; still on the ground: motors off')
            else:
                self.watch.name('rotor_bridge_lost', now)
                self.emergency_stop(now, no_rotors)
        elif self.state == LANDING:
            self._limit_landing(now)
        elif reason := self._why_land(no_rotors):
            name, text = reason
            self._land(now, ERROR, text, name)
        elif self.lost and self.state == FLYING:
            self.watch.name('control_lost', now)
            self._fall_back(now, ERROR, f'tumbling or falling under {self.active}_node: fallback '
                                        'to hover')

    def _why_land(self, no_rotors):
        """Name of the fault ('' for a detected one) and text of the most urgent reason."""
        if self.state == FALLBACK and self._in_state > FALLBACK_TIME:
            return 'controller_lost', f'{self.active}_node not good for {self._in_state:.0f} s: ' \
                                      'landing'
        if no_rotors:
            return 'rotor_bridge_lost', f'{no_rotors}: landing while it may follow'
        if 'estimator_wrong' in self.faults and not self.backup.running:
            return '', 'the estimate contradicts MoCap: controlled descent on raw sensors'
        if self.ekf.silent:
            return 'estimator_lost', f'ekf_node {self.ekf.text}: controlled descent on raw sensors'
        if 'mocap_jumped' in self.faults:
            return '', 'MoCap jumped: landing'
        if self.mocap.lost and self.mocap.elapsed > MOCAP_PATIENCE:
            return 'mocap_lost', f'MoCap {self.mocap.text}: landing by dead reckoning'
        if self.joints.silent or self.unready('joint'):
            text = self.unready('joint') or f'joint_bridge_node {self.joints.text}'
            return ('joint_bridge_lost', f'{text}: landing with the joints as they are') \
                if 'joint' in self.bridges else \
                ('joints_lost', f'{text}: landing with the joints where they were commanded')
        if self.battery_empty:
            return 'battery_empty', f'battery empty ({self.voltage:.1f} V): landing'
        if self.outside(0.0):
            return 'fence_left', 'left the fence: landing'
        return None

    def _limit_landing(self, now):
        """Limits of a landing, after it had time to recover the robot."""
        if self._in_state < RECOVERY_TIME:
            return
        if self.outside(FENCE_MARGIN):
            self.emergency_stop(now, 'left the fence while landing')
        elif self.lost:
            self.emergency_stop(now, 'tumbling or falling while landing')
        elif self._in_state > LANDING_LIMIT:
            self.emergency_stop(now, f'no ground within {LANDING_LIMIT:g} s of landing')

    # One function for each state --------------------------------------------------------------

    def _stand(self, now, dt):
        """
        Motors off: zero thrust for a short time, then no command.

        A rotor that ignores its thrust command is turned so that it presses on the floor.
        """
        self.source = 'none'
        if self._in_state > STOP_TIME + 1e-9 or self._in_force is None:
            return None
        tilt = np.array([own if held is None else np.copysign(np.pi, own) for own, held in zip(
            self._in_force.tilt, self.health.held)])
        return Command(now, tilt, np.zeros(4))

    def _take_off(self, now, dt):
        self.source = 'hover'
        command = self._takeoff.step(self.seen, dt)
        if self._takeoff.failure:
            self._enter(DISARMED, ERROR, f'takeoff failed: {self._takeoff.failure}')
            return self._stand(now, dt)
        if self._takeoff.done:
            stream = self.streams[self.active]
            if stream.good:
                self._enter(FLYING, INFO, f'takeoff done: {self.active} flies')
            else:
                self._fall_back(now, WARNING, f'takeoff done, but {self.active}_node '
                                f'{stream.complaint}: hover waits for it')
        return command

    def _fly(self, now, dt):
        stream = self.streams[self.active]
        if (late := self.late) or stream.silence.silent or stream.accepted is None:
            name, text = late or ('controller_silent', f'{self.active}_node {stream.complaint}')
            if late or self.ekf.elapsed <= 0.5 * self.ekf.limit:    # it answers estimates
                self.watch.name(name, now)
            self._fall_back(now, ERROR, f'{text}: fallback to hover')
            return self._hold(now, dt)
        self.source = self.active
        self._hover.observe(self.seen)
        return self._hand_over(stream.accepted)

    def _hand_over(self, asked):
        """
        Limit the change from the executed command after a change of the controller.

        A controller on standby has similar commands, but in a large turn they may differ. The
        limit ends when the new command is reached, or after HANDOVER_TIME.
        """
        before = self._in_force
        if self._handover_left <= 0 or before is None:
            return asked
        step = asked.stamp - before.stamp
        if step <= 0:       # a command for this state was already executed
            return before
        self._handover_left -= step
        change = np.concatenate([asked.tilt - before.tilt, asked.thrust - before.thrust])
        reach = step * np.repeat([TILT_RATE, THRUST_RATE], ROTORS)
        if (np.abs(change) <= reach).all():
            self._handover_left = 0.0
            return asked
        change = np.clip(change, -reach, reach)
        return Command(asked.stamp, before.tilt + change[:ROTORS], before.thrust + change[ROTORS:])

    def _hold(self, now, dt):
        if self.streams[self.active].good and not self.lost and self._in_state >= RESUMING:
            self._enter(FLYING, INFO, f'{self.active}_node good again: it flies')
            return self._fly(now, dt)
        self.source, state = 'hover', self.seen
        if self._target is None:
            reference = halting(state, self._height)
            if reference is not None:
                return self._hover.step(state, reference)
            self._target = PoseTarget(coasted(state), state.quaternion, now)
        return self._hover.step(state, self._target)

    def _descend(self, now, dt):
        self.source, plan = 'hover', self._landing.ramp
        command = self._landing.step(now, dt)
        if self.target_override is not None and self._landing.ramp is not plan:
            self.target_override = self._landing.way
        if self._landing.given_up:
            self.emergency_stop(now, self._landing.given_up)
            return self._stand(now, dt)
        if self._landing.grounded:
            self._enter(DISARMED, INFO, 'on the ground: motors off, disarmed')
            return self._stand(now, dt)
        pilot = self.streams.get(self._pilot)
        if self.target_override is not None and pilot is not None and pilot.good \
                and pilot.accepted is not None and not self.backup.running:
            self.source = self._pilot
            command = self._hand_over(pilot.accepted)
        return command

    # Changes of state -------------------------------------------------------------------------

    def _fall_back(self, now, severity, text):
        """Hover at the present height, in the attitude in which the present turn ends."""
        self._target, self._height = None, float(self.estimate.position[2])
        self._enter(FALLBACK, severity, text)

    def _land(self, now, severity, text, name=''):
        if name:
            self.watch.name(name, now)
        if not self.airborne:
            return self._enter(DISARMED, severity, f'{text}; still on the ground: motors off')
        self._landing = Landing(self, self._hover)
        return self._enter(LANDING, severity, text)

    def _enter(self, state, severity, text):
        self.state, self._in_state, self.target_override = state, 0.0, None
        if state in MOTORS_OFF:
            self.backup.running = self.airborne = False
        if state == FLYING:
            self._handover_left = HANDOVER_TIME
        before = self._in_force
        if state in (FALLBACK, LANDING) and before is not None:
            tilt = self.seen.tilt       # the last command may be far from the joints
            self._in_force = replace(before, tilt=clipped(before.tilt, tilt - AHEAD, tilt + AHEAD))
            self._given = None
        self.say(severity, text)
        return Answer(True, text)

    def _forget_stamps(self, now, by):
        super()._forget_stamps(now, by)
        self._hover.reset()
        self._handover_left = 0.0
        if self.state == LANDING:
            self._landing.set_out()

    # Reports ----------------------------------------------------------------------------------

    @property
    def mode(self) -> Mode:
        """The state with its controller or its last fault."""
        if self.state == FLYING:
            return Mode.of(FLYING, self.active)
        return Mode.of(self.state, next(reversed(self.faults), '')
                       if self.state != TAKEOFF else '')

    def diagnostics(self) -> dict[str, float | int | str]:
        """State, sources and refusals, flat, for operators and logs."""
        values: dict[str, float | int | str] = {
            'state': self.state, 'controller': self.active, 'source': self.source,
            'on_backup_estimator': int(self.backup.running)}
        # [s]: the six digits of a diagnostic number are too few for a stamp
        values.update({f'fault.{name}': f'{at:.3f}' for name, at in self.faults.items()})
        values.update({f'{name}_bridge_node': state for name, state in self.bridges.items()})
        for name, stream in self.streams.items():
            values[f'{name}.good'] = int(stream.good)
            values[f'{name}.silent_ms'] = 1000 * stream.silence.elapsed
            values.update({f'{name}.refused.{reason}': count
                           for reason, count in stream.refused.items()})
        values.update({f'refused.{reason}': count for reason, count in self.refused.items()})
        if self.voltage is not None:
            values['battery_V'] = self.voltage
        return values
