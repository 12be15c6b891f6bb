"""Faults of the commands and the battery, and external loads."""

import numpy as np

from beetle_omni_ros.sim.faults.base import Effect, Late, Number, share, vector


class CommandsLost(Effect, kind='commands_lost'):
    """No command reaches the actuators."""

    def command(self, command, now):
        return []


class CommandsDrop(Effect, kind='commands_drop'):
    """A share of the commands is lost."""

    numbers = {'share': share('share of lost commands')}

    def command(self, command, now):
        if command is None or self._random.uniform() < self._numbers['share']:
            return []
        return [command]


class CommandsDelayed(Late, kind='commands_delayed'):
    """Commands reach the actuators late."""

    def command(self, command, now):
        return self._delayed(command, now)


class BatteryCharge(Effect, kind='battery_charge'):
    """The charge of the battery drops to a fraction of a full one."""

    numbers = {'charge': share('remaining charge as a fraction of a full battery')}

    def start(self, world):
        world.battery.charge = min(world.battery.charge, self._numbers['charge'])


class BatteryResistance(Effect, kind='battery_resistance'):
    """The battery has additional resistance."""

    numbers = {'resistance': Number('additional resistance', 'ohm', low=0, high=2)}

    def start(self, world):
        world.battery.extra_resistance += self._numbers['resistance']

    def end(self, world):
        world.battery.extra_resistance -= self._numbers['resistance']


class BatteryUnread(Effect, kind='battery_unread'):
    """No reading of the battery arrives."""

    def battery(self, reading, now):
        return None


class Payload(Effect, kind='payload'):
    """A mass is attached below the body."""

    numbers = {'mass': Number('attached mass', 'kg', low=0, high=10)}

    @property
    def payload(self):
        return self._numbers['mass']


class Push(Effect, kind='push'):
    """A force in world and a torque in base_link act."""

    numbers = {**vector('N', 'force', x=0.0, y=0.0, z=0.0),
               **vector('N m', 'torque', roll=0.0, pitch=0.0, yaw=0.0)}

    @property
    def wrench(self):
        return np.array(list(self._numbers.values()))
