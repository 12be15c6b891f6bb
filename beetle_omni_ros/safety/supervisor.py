"""
The supervisor: selects the command of the actuators and reacts to faults.

A pure state machine that reads no clock and no topic. All times are arguments, so that the node
and the in-process evaluation run the same code with the same results. See docs/safety.md.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, Fallback, PoseTarget, Target
from beetle_omni_ros.robot.allocation import ActuatorHealth, ALL_HEALTHY, NO_ZEROS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.events import Answer, ERROR, INFO, WARNING
from beetle_omni_ros.safety.handover import Handover
from beetle_omni_ros.safety.inputs import Inputs
from beetle_omni_ros.safety.landing import Landing
from beetle_omni_ros.safety.limits import within_limits
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.ramp import inclination
from beetle_omni_ros.safety.support import SupportGauge
from beetle_omni_ros.safety.takeoff import Takeoff
from beetle_omni_ros.safety.watch.faults import CRASH, DISPLACED

DISARMED, TAKEOFF, FLYING = 'disarmed', 'takeoff', 'flying'
FALLBACK, LANDING, STOPPED = 'fallback', 'landing', 'emergency_stop'
RESUMING = 0.1      # [s] after a pause until every source has sent a message again
IN_FLIGHT = (TAKEOFF, FLYING, FALLBACK, LANDING)


class Supervisor(Inputs):
    """
    Arms, selects, checks, falls back, lands.

    Args:
        parameters: thresholds.
        robot: the model of the robot.
        fallback: for takeoff, fallback and landing; a HoverController or similar.
        controllers: names of the controllers that may be active; None: those on standby.
        pilot: the controller that lands with failed actuators, if it sends valid commands, else
            the fallback; None: the registry's choice among ``controllers``.

    Attributes:
        state: 'disarmed', 'takeoff', 'flying', 'fallback', 'landing' or 'emergency_stop'.
        source: of the executed command: a controller's name, 'hover' or 'none'.
        events, vehicle, active: see Inputs.

    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 fallback: Fallback, controllers: Sequence[str] | None = None,
                 pilot: str | None = None):
        controllers = tuple(registry.standing_by() if controllers is None else controllers)
        super().__init__(parameters, robot, controllers)
        self._pilot = registry.pilot(controllers) if pilot is None else pilot
        self._hover = fallback
        self._gauge = SupportGauge(self._allocator, robot.gravity, robot.rotors.time_constant)
        self._handover = Handover(parameters.handover)
        self.state, self.source = DISARMED, 'none'
        # Objects of the present state, created when it is entered.
        self._takeoff: Takeoff
        self._landing: Landing
        self._target: PoseTarget
        self._stop_left = 0.0
        self._landing_for = self._fallback_for = 0.0
        self._health = ALL_HEALTHY
        self._landing_way: Target | None = None
        self._resuming = 0.0    # remaining time of the check after a pause of this process [s]
        self._before: float | None = None   # time of the update before [s]

    # Requests ---------------------------------------------------------------------------------

    def arm(self, now: float) -> Answer:
        """Start the motors and take off, or return the reason of the refusal."""
        if self.state != DISARMED:
            return self._refuse(now, f'arm refused: {self.state}, not disarmed')
        reason = self.actuators.why_not_arm or self.vehicle.why_not_arm() or self._moved_zero
        if reason:
            return self._refuse(now, f'arm refused: {reason}')
        self._takeoff = Takeoff(self._parameters.takeoff, self._allocator, self._hover,
                                self.vehicle.seen(None))
        self._in_force = None
        self._floor = float(self.vehicle.known.position[2])
        self.watch.reset()
        self._health = ALL_HEALTHY
        self._hover.set_health(ALL_HEALTHY)
        self._landing_for = self._fallback_for = 0.0
        return self._enter(TAKEOFF, now, INFO, 'armed: takeoff')

    @property
    def _moved_zero(self):
        """'' or the encoder that cannot be trusted on the ground any more."""
        moved = [f'gimbal{k + 1}' for k, zero in enumerate(self._health.zeros) if zero]
        return f"the encoder of {' and '.join(moved)} jumped in the last flight: check it, then " \
               'restart supervisor_node' if moved else ''

    def disarm(self, now: float) -> Answer:
        """Motors off, on the ground or after an emergency stop; refused in the air."""
        if self.state in IN_FLIGHT and not self._on_ground:
            return self._refuse(now, f'disarm refused: {self.state}; land or emergency_stop')
        if self.state == DISARMED:
            return Answer(True, 'already disarmed')
        return self._motors_off(DISARMED, now, INFO, 'disarmed')

    def emergency_stop(self, now: float, reason: str = 'requested') -> Answer:
        """Motors off at once, latched until disarmed."""
        if self.state == STOPPED:
            return Answer(True, 'already stopped')
        return self._motors_off(STOPPED, now, ERROR, f'emergency stop: {reason}')

    def land(self, now: float) -> Answer:
        """Descend at the present position, motors off at the ground."""
        if self.state not in IN_FLIGHT:
            return self._refuse(now, f'land refused: {self.state}, not in flight')
        if self.state == LANDING:
            return Answer(True, 'already landing')
        return self._land(now, INFO, 'landing on request')

    def select(self, controller: str, now: float | None = None) -> Answer:
        """Select another controller; in flight only one with valid commands."""
        now = self._now if now is None else now
        if controller == self.active:
            return Answer(True, f'{controller} is active')
        reason = self._selection.why_not(controller, self.state in IN_FLIGHT)
        if reason:
            return self._refuse(now, f'select refused: {reason}')
        self._selection.active = controller
        self._handover.start()
        self._say(now, INFO, f'{controller} selected')
        return Answer(True, f'{controller} selected')

    # The cycle --------------------------------------------------------------------------------

    def update(self, now: float) -> Command | None:
        """
        Select the command of the actuators; call it at least every 10 ms.

        Returns:
            a finite command within limits, or None: nothing is sent.

        """
        dt = self._tick(now)
        if self._now is None:
            return None
        now = self._now
        if self.vehicle.joints.silent:
            self.vehicle.modelled_tilt = self.watch.silent_joints(now)
        self._look_for_faults(now, dt)
        if self.state in IN_FLIGHT:
            self._watch(now)
        command = {TAKEOFF: self._take_off, FLYING: self._fly, FALLBACK: self._hold,
                   LANDING: self._descend}.get(self.state, self._stand)(now, dt)
        command = self._guarded(command, now)
        asked = self._as_read(command)
        if asked is not None:
            self.watch.on_command(asked)
        if self.state in IN_FLIGHT:
            self._gauge.update(command, self.vehicle.attitude(now), dt,
                               self.vehicle.specific_force_up,
                               learn=self.state in (FLYING, FALLBACK))
        return asked

    def _as_read(self, command):
        """A command in encoder angles, if the zero of an encoder has moved."""
        if command is None or self._health.zeros == NO_ZEROS:
            return command
        return within_limits(replace(command, tilt=self._health.read(command.tilt)), self._robot,
                             stopped=True)

    def diagnostics(self) -> dict[str, float | int | str]:
        """State, sources and refusals, flat, for operators and logs."""
        values: dict[str, float | int | str] = {
            'state': self.state, 'controller': self.active, 'source': self.source,
            'estimator': self.vehicle.status or 'no message yet',
            'on_backup_estimator': int(self.vehicle.backup.running)}
        values.update({f'fault.{name}': at for name, at in self.faults.items()})
        values.update(self.actuators.diagnostics())
        values.update(self._selection.diagnostics())
        for reason, count in self.vehicle.refused.items():
            values[f'refused.{reason}'] = count
        if self.vehicle.voltage is not None:
            values['battery_V'] = self.vehicle.voltage
        return values

    @property
    def airborne(self) -> bool:
        """Whether the robot flies, as far as known."""
        return self.state in IN_FLIGHT and not self._on_ground

    @property
    def faults(self) -> dict[str, float]:
        """Faults of this flight: name -> time of detection [s]."""
        return self.watch.faults

    def _look_for_faults(self, now, dt):
        """React to the detectors."""
        paused, self._before = now - (now if self._before is None else self._before), now
        if self.airborne and self.vehicle.imu_lost \
                and not self.faults.keys() & {'imu_frozen', 'imu_axis_frozen'}:
            self.watch.name('imu_lost', now, f'the raw IMU is {self.vehicle.imu.text}')
        for text in self.watch.news():
            self._say(now, ERROR, text)
        if not self.airborne:
            return
        self._landing_for = self._landing_for + dt if self.state == LANDING else 0.0
        self._fallback_for = self._fallback_for + dt if self.state == FALLBACK else 0.0
        if paused > self._parameters.commands.age_limit:
            self._resume(now, paused)
        elif self._resuming > 0:
            self._look_down(now, dt)
        if self.watch.contact:
            self._crash(now, self.watch.contact)
        elif self.watch.health is not self._health and self.watch.health != self._health:
            self._degrade(now)

    def _degrade(self, now):
        """Fly with the working actuators: land in the attitude nearest level with a margin."""
        moved = self._health.same_actuators(self.watch.health)
        self._health = health = self.watch.health
        if health.healthy:
            return      # a zero has moved, which is corrected in commands and readings
        near = self._parameters.detection.contact.near_ground
        if health.rotors.count(False) > 1 and self._height is not None and self._height < near:
            # With two rotors no attitude can be held.
            return self._crash(now, 'a second rotor is lost at the floor')
        self._hover.set_health(health)
        self._selection.expect_jump()
        if self.state != LANDING:
            self._land(now, ERROR, f"{', '.join(self.faults)}: landing with what is left")
        if self.state == LANDING and not moved:
            self._landing.degrade(health, now, self._in_force)
            self._landing_way = self._landing.way

    @property
    def reported_state(self) -> str:
        """The state with its controller ('flying:nmpc') or its last fault ('landing:crash')."""
        if self.state == FLYING:
            return f'{FLYING}:{self.active}'
        fault = next(reversed(self.faults), '') if self.state != TAKEOFF else ''
        return f'{self.state}:{fault}' if fault else self.state

    @property
    def health(self) -> ActuatorHealth:
        """Health of the actuators, which controllers receive, too."""
        return self._health

    @property
    def target_override(self) -> Target | None:
        """Target of the controllers that replaces the operator's target, or None."""
        return self._landing_way if self.state == LANDING else None

    def _resume(self, now, paused):
        """React to a pause of this process, in which the actuators have stopped."""
        self.watch.name('supervisor_paused', now, '')
        self.watch.restart(now)
        self._say(now, ERROR, f'supervisor_node was not scheduled for {1000 * paused:.0f} ms: '
                              'the actuators had stopped')
        self._resuming = RESUMING
        if self.state == FLYING:
            self._fall_back(now, ERROR, 'fallback to hover after the pause')

    def _look_down(self, now, dt):
        """Whether the robot lies on the floor; messages queued during the pause are older."""
        self._resuming -= dt
        # The estimate may be wrong after a fall, MoCap is not.
        heights = [self._height]
        if not self.vehicle.mocap.silent and self.vehicle.backup.last_position is not None:
            heights.append(float(self.vehicle.backup.last_position[2]) - self._floor)
        near = self._parameters.detection.contact.near_ground
        if any(height is not None and height < near for height in heights):
            self._resuming = 0.0
            self._crash(now, 'on the floor after the pause')

    def _crash(self, now, why):
        """Motors off after a crash; a soft and upright landing is no crash."""
        upright = inclination(self.vehicle.attitude(now)) < self._parameters.arming.tilt
        if self.state == LANDING and upright:
            self._motors_off(DISARMED, now, INFO, f'on the ground, {why}: motors off, disarmed')
            return
        self.watch.name(CRASH, now, '')
        self.emergency_stop(now, f'crash: {why}')

    def _watch(self, now):
        """Faults that end or change a flight, with any controller."""
        vehicle, envelope = self.vehicle, self._parameters.envelope
        if vehicle.battery_low:
            self._say(now, WARNING, f'battery low: {vehicle.voltage:.1f} V', 'battery')
        no_rotors, no_joints = map(self.actuators.fault, ('rotor', 'joint'))
        if no_rotors and not self.actuators.rotors_may_turn:
            return self._lose_rotors(now, no_rotors)
        if self._beyond_limits(now) or self.state == LANDING:
            return
        if no_rotors:
            self._land(now, ERROR, f'{no_rotors}: landing while it may follow',
                       'rotor_bridge_lost')
            return
        if 'estimator_wrong' in self.faults and not vehicle.backup.running:
            self._land(now, ERROR, 'the estimate contradicts MoCap: controlled descent on raw '
                                   'sensors')
        elif vehicle.estimate.silent:
            why = f' (last refused: {vehicle.last_refusal})' if vehicle.last_refusal else ''
            self._land(now, ERROR, f'ekf_node {vehicle.estimate.text}{why}: controlled descent '
                                   'on raw sensors', 'estimator_lost')
        elif DISPLACED in self.faults:
            self._land(now, ERROR, 'the position of MoCap jumped: landing')
        elif vehicle.mocap_lost and vehicle.mocap.elapsed > self._parameters.state.mocap_patience:
            self._land(now, ERROR, f'MoCap {vehicle.mocap.text}: landing by dead reckoning',
                       'mocap_lost')
        elif no_joints:
            self._land(now, ERROR, f'{no_joints}: landing with the joints as they are',
                       'joint_bridge_lost')
        elif vehicle.joints.silent:
            self._land(now, ERROR, f'joint_bridge_node {vehicle.joints.text}: landing with the '
                                   'joints assumed where they were commanded', 'joints_lost')
        elif vehicle.battery_empty:
            self._land(now, ERROR, f'battery empty ({vehicle.voltage:.1f} V): landing',
                       'battery_empty')
        elif vehicle.outside_fence and envelope.fence_reaction != 'none':
            self._react(envelope.fence_reaction, now, 'left the fence', 'fence_left')
        elif vehicle.lost and envelope.lost_reaction != 'none':
            self._react(envelope.lost_reaction, now, 'tumbling or falling', 'control_lost')

    def _beyond_limits(self, now):
        """Limits that also apply in landing and fallback; whether one was exceeded."""
        vehicle, envelope = self.vehicle, self._parameters.envelope
        limits = self._parameters.landing
        if self.state == LANDING and self._landing_for > envelope.recovery_time:
            if vehicle.far_outside_fence:
                self.emergency_stop(now, 'left the fence while landing')
            elif vehicle.lost or vehicle.runs_away:
                self.emergency_stop(now, 'tumbling, falling or too fast while landing')
            elif self._landing_for > limits.time_limit:
                self.emergency_stop(now, f'no ground within {limits.time_limit:g} s of landing')
            else:
                return False
            return True
        if self.state == FALLBACK and self._fallback_for > envelope.fallback_time:
            self._land(now, ERROR, f'{self.active}_node not good for '
                                   f'{envelope.fallback_time:g} s: landing', 'controller_lost')
            return True
        return False

    def _lose_rotors(self, now, why):
        if self._on_ground:
            self._motors_off(DISARMED, now, ERROR, f'{why}; still on the ground: motors off')
        else:
            self.watch.name('rotor_bridge_lost', now, '')
            self.emergency_stop(now, why)

    def _react(self, reaction, now, why, name):
        self.watch.name(name, now, '')
        if reaction == 'emergency_stop':
            self.emergency_stop(now, why)
        elif reaction == 'landing':
            self._land(now, ERROR, f'{why}: landing')
        elif self.state == FLYING:
            self._fall_back(now, ERROR, f'{why} under {self.active}_node: fallback to hover')

    # One function for each state --------------------------------------------------------------

    def _stand(self, now, dt):
        """
        Motors off: zero thrust for a short time, then no command.

        A rotor that ignores its thrust command is turned so that it presses on the floor.
        """
        self.source = 'none'
        if self._stop_left <= 0 or self._in_force is None:
            return None
        self._stop_left -= dt
        tilt = np.array([own if held is None else np.copysign(np.pi, own) for own, held in zip(
            self._in_force.tilt, self._health.held)])
        return Command(now, tilt, np.zeros(4))

    def _take_off(self, now, dt):
        self.source = 'hover'
        command = self._takeoff.step(self.vehicle.seen(self._in_force), self._in_force, dt)
        if self._takeoff.failure:
            self._motors_off(DISARMED, now, ERROR, f'takeoff failed: {self._takeoff.failure}')
            return self._stand(now, dt)
        if self._takeoff.done:
            stream = self._selection.stream
            if stream.good:
                self._enter(FLYING, now, INFO, f'takeoff done: {self.active} flies')
            else:
                self._fall_back(now, WARNING, f'takeoff done, but {self.active}_node '
                                f'{stream.complaint}: hover waits for it', self._takeoff.target)
        return command

    def _fly(self, now, dt):
        stream = self._selection.stream
        command = stream.in_force
        if command is None:
            estimate = self.vehicle.estimate
            cause = ''
            if estimate.elapsed > 0.5 * estimate.limit:     # a controller answers estimates
                cause = f' (ekf_node {estimate.text} too)'
            else:
                self.watch.name('controller_silent', now, '')
            self._fall_back(now, ERROR, f'{self.active}_node {stream.complaint}{cause}: '
                                        'fallback to hover')
            return self._hold(now, dt)
        self.source = self.active
        self._hover.observe(self.vehicle.seen(self._in_force))
        return self._handover.limit(command, self._in_force)

    def _hold(self, now, dt):
        if self._selection.stream.good and not self.vehicle.lost and self._resuming <= 0:
            self._enter(FLYING, now, INFO, f'{self.active}_node good again: it flies')
            return self._fly(now, dt)
        self.source = 'hover'
        return self._hover.step(self.vehicle.seen(self._in_force), self._target)

    def _descend(self, now, dt):
        self.source = 'hover'
        command = self._landing.step(now, dt, self._in_force)
        if self._landing.given_up:
            self.emergency_stop(now, self._landing.given_up)
            return self._stand(now, dt)
        pilot = self._selection.good(self._pilot) if self._landing_way is not None else None
        if pilot is not None and not self.vehicle.backup.running:
            self.source = self._pilot
            command = self._handover.limit(pilot, self._in_force)
        if self._landing.grounded:
            self._motors_off(DISARMED, now, INFO, 'on the ground: motors off, disarmed')
            return self._stand(now, dt)
        return command

    # Changes of state -------------------------------------------------------------------------

    def _fall_back(self, now, severity, text, position=None):
        """Hover at the present pose, or at ``position``."""
        state = self.vehicle.known
        self._target = PoseTarget(state.position if position is None else position,
                                  state.quaternion, now)
        self._enter(FALLBACK, now, severity, text)

    def _land(self, now, severity, text, name=''):
        if name:
            self.watch.name(name, now, '')
        if self._on_ground:
            return self._motors_off(DISARMED, now, severity, f'{text}; still on the ground: '
                                                             'motors off')
        self._landing = Landing(self._parameters, self._robot, self._hover, self._allocator,
                                self._gauge, self.vehicle, self.events, self._floor)
        self._landing_way = None
        answer = self._enter(LANDING, now, severity, text)
        self._landing.start(now, self._in_force, 'estimator_wrong' in self.faults)
        return answer

    def _motors_off(self, state, now, severity, text):
        self._stop_left = self._parameters.stop_time
        self.vehicle.backup.stop()
        return self._enter(state, now, severity, text)

    def _enter(self, state, now, severity, text):
        self.state = state
        if state == FLYING:
            self._handover.start()
        self._say(now, severity, text)
        return Answer(True, text)

    @property
    def _on_ground(self):
        return self.state == TAKEOFF and not self._takeoff.airborne

    def _clock_went_back(self, now, by):
        self._hover.reset()
        self._handover.stop()
        if self.state == TAKEOFF:
            self._takeoff.clock_went_back(by)
        if self.state == LANDING:
            self._landing.set_out(now, self._in_force)

    # Helpers ----------------------------------------------------------------------------------

    def _guarded(self, command, now):
        """Final check of the output: finite, inside limits, not too old."""
        if command is None:
            return None
        if now - command.stamp > self._parameters.commands.age_limit:
            self._say(now, ERROR, f'the command of {self.source} is '
                                  f'{1000 * (now - command.stamp):.0f} ms old: nothing sent',
                      'old command')
            return None
        stopped = self.source == 'none'
        if command is not self._in_force or stopped:    # each command is checked once
            self._in_force = within_limits(command, self._robot, stopped=stopped)
        if self._in_force is None:
            self.emergency_stop(now, f'{self.source} gave a command that is not finite')
        return self._in_force

    def _refuse(self, now, text):
        self._say(now, WARNING, text)
        return Answer(False, text)
