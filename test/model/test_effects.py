"""Facts about an effect are in its declaration only, not in tables of names elsewhere."""

import numpy as np
import pytest

from beetle_omni_ros.model.effects import CATALOGUE


@pytest.mark.parametrize('name', CATALOGUE)
def test_a_declaration_is_complete_and_consistent(name):
    effect = CATALOGUE[name]
    assert effect.source
    for spec in effect.parameters.values():
        neutral = np.array(spec.neutral, dtype=float)
        assert np.isnan(neutral).all() == bool(spec.number)
        assert np.all(np.isnan(neutral) | (neutral >= spec.low) & (neutral <= spec.high))
