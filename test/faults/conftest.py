"""Names shared by the tests of this folder."""

import pytest

from beetle_omni_ros.sim.faults.listed import FaultList


@pytest.fixture(scope='session')
def listed():
    """The shipped list."""
    return FaultList.load()
