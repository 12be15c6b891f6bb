"""Faults of the command's way, the pack, and what comes from outside."""

from __future__ import annotations

from collections import deque

import numpy as np

from beetle_omni_ros.sim.faults.base import Effect, kind, Number, share, vector

ROUNDING = 1e-9     # [s]


@kind('commands_lost')
class CommandsLost(Effect):
    """No command arrives."""

    doc = 'no command reaches the actuators'

    def command(self, command, now):
        """Nothing."""
        return []


@kind('commands_drop')
class CommandsDrop(Effect):
    """Some commands are lost."""

    doc = 'a share of the commands is lost'
    numbers = {'share': share('of the commands that are lost')}

    def command(self, command, now):
        """Sometimes nothing."""
        if command is None or self._random.uniform() < self._numbers['share']:
            return []
        return [command]


@kind('commands_delayed')
class CommandsDelayed(Effect):
    """Commands arrive late."""

    doc = 'commands reach the actuators late'
    numbers = {'delay': Number('in addition', 's', low=0, high=5)}

    def start(self, world):
        """Nothing on its way."""
        self._way: deque = deque()

    def command(self, command, now):
        """What has arrived by now."""
        if command is not None:
            self._way.append((now + self._numbers['delay'], command))
        arrived = []
        while self._way and self._way[0][0] <= now + ROUNDING:
            arrived.append(self._way.popleft()[1])
        return arrived


@kind('battery_charge')
class BatteryCharge(Effect):
    """The pack has less left than was thought."""

    doc = 'the charge of the pack drops to a fraction of a full one'
    numbers = {'charge': share('that is left')}

    def start(self, world):
        """Take the charge."""
        world.battery.charge = min(world.battery.charge, self._numbers['charge'])


@kind('battery_resistance')
class BatteryResistance(Effect):
    """A bad contact."""

    doc = 'the pack has more resistance'
    numbers = {'resistance': Number('in addition', 'ohm', low=0, high=2)}

    def start(self, world):
        """Add it."""
        world.battery.extra_resistance += self._numbers['resistance']

    def end(self, world):
        """Take it out."""
        world.battery.extra_resistance -= self._numbers['resistance']


@kind('battery_unread')
class BatteryUnread(Effect):
    """No voltage is told."""

    doc = 'no reading of the pack arrives'

    def battery(self, reading, now):
        """Nothing."""
        return None


@kind('payload')
class Payload(Effect):
    """Something is put on."""

    doc = 'a mass is attached below the body'
    numbers = {'mass': Number('attached', 'kg', low=0, high=10)}

    @property
    def payload(self):
        """The mass."""
        return self._numbers['mass']


@kind('push')
class Push(Effect):
    """An external wrench: gust, impact, cable."""

    doc = 'a force in world and a torque in base_link act'
    numbers = {**vector('N', 'force', x=0.0, y=0.0, z=0.0),
               **vector('N m', 'torque', roll=0.0, pitch=0.0, yaw=0.0)}

    @property
    def wrench(self):
        """The wrench."""
        return np.array(list(self._numbers.values()))
