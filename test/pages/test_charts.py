"""Packed numbers of a page: accuracy and size."""

import base64
import gzip

from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from beetle_omni_ros.runs.charts import data_block, Numbers, STEPS

# On a busy computer the time of an example is meaningless.
BUSY = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
FLOATS = st.one_of(st.floats(-1e6, 1e6), st.just(np.nan), st.just(np.inf))


def unpack(numbers, where):
    """Read a series as the script does."""
    planes = np.frombuffer(gzip.decompress(base64.b64decode(numbers.blob())), np.uint8)
    low, high = planes.reshape(2, -1).astype(np.uint16)
    steps = (low | high << 8).astype(np.int16)[where['at']:where['at'] + where['count']]
    total = np.cumsum(steps, dtype=np.int16)
    values = where['low'] + where['step'] * (total + 32767.0)
    return np.where(total == -32768, np.nan, 10 ** values if where['log'] else values)


@BUSY
@given(st.lists(st.lists(FLOATS, max_size=20), min_size=1, max_size=4))
def test_values_round_trip_within_half_a_quantum(series):
    numbers = Numbers()
    places = [numbers.add(np.array(values)) for values in series]
    for values, where in zip(series, places, strict=True):
        values, back = np.array(values, dtype=float), unpack(numbers, where)
        known = np.isfinite(values)
        assert np.isnan(back[~known]).all()
        spread = np.ptp(values[known]) if known.any() else 0.0
        assert np.abs(back[known] - values[known]).max(initial=0) <= 0.51 * spread / STEPS + 1e-9


@BUSY
@given(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=30))
def test_logarithmic_values_keep_their_relative_precision(values):
    numbers = Numbers()
    where = numbers.add(np.array([*values, 0.0, -1.0]), log=True)
    back = unpack(numbers, where)
    assert back[:-2] == pytest.approx(values, rel=2e-4) and np.isnan(back[-2:]).all()


def test_noise_is_stored_in_few_bits_and_constants_in_none():
    noise, still = Numbers(), Numbers()
    noise.add(np.random.default_rng(0).uniform(size=12_000))
    still.add(np.full(12_000, 3.0))
    assert len(noise.blob()) < 2.1 * 4 / 3 * 12_000 and len(still.blob()) < 300


def test_no_text_can_end_the_data_block():
    block = data_block({'label': '</script><script>alert(1)</script>'}, Numbers())
    assert block.count('</script>') == 2 and 'alert(1)</' not in block
