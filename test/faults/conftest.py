"""Names shared by the tests of this folder."""

import pytest

from beetle_omni_ros.sim.fault_lists import FaultList


@pytest.fixture(scope='session')
def listed():
    """The shipped list."""
    return FaultList.load()
