"""Faults of the commands and the battery, and external loads."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.sim.faults.base import Effect, kind, Late, Number, share, vector


@kind('commands_lost')
class CommandsLost(Effect):
    """No command reaches the actuators."""

    def command(self, command, now):
        return []


@kind('commands_drop')
class CommandsDrop(Effect):
    """A share of the commands is lost."""

    numbers = {'share': share('share of lost commands')}

    def command(self, command, now):
        if command is None or self._random.uniform() < self._numbers['share']:
            return []
        return [command]


@kind('commands_delayed')
class CommandsDelayed(Late):
    """Commands reach the actuators late."""

    def command(self, command, now):
        return self._delayed(command, now)


@kind('battery_charge')
class BatteryCharge(Effect):
    """The charge of the battery drops to a fraction of a full one."""

    numbers = {'charge': share('remaining charge as a fraction of a full battery')}

    def start(self, world):
        world.battery.charge = min(world.battery.charge, self._numbers['charge'])


@kind('battery_resistance')
class BatteryResistance(Effect):
    """The battery has additional resistance."""

    numbers = {'resistance': Number('additional resistance', 'ohm', low=0, high=2)}

    def start(self, world):
        world.battery.extra_resistance += self._numbers['resistance']

    def end(self, world):
        world.battery.extra_resistance -= self._numbers['resistance']


@kind('battery_unread')
class BatteryUnread(Effect):
    """No reading of the battery arrives."""

    def battery(self, reading, now):
        return None


@kind('payload')
class Payload(Effect):
    """A mass is attached below the body."""

    numbers = {'mass': Number('attached mass', 'kg', low=0, high=10)}

    @property
    def payload(self):
        return self._numbers['mass']


@kind('push')
class Push(Effect):
    """A force in world and a torque in base_link act."""

    numbers = {**vector('N', 'force', x=0.0, y=0.0, z=0.0),
               **vector('N m', 'torque', roll=0.0, pitch=0.0, yaw=0.0)}

    @property
    def wrench(self):
        return np.array(list(self._numbers.values()))
