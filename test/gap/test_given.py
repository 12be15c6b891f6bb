"""Names of recordings, and duplicate recordings."""

from pathlib import Path

import pytest

from beetle_omni_ros.runs.bag import names_of


@pytest.mark.parametrize('paths, names', [
    (['/a/one', '/a/two'], ['one', 'two']),
    (['/a/one/bag', '/a/two/bag'], ['one/bag', 'two/bag']),
    (['/a/1/x/bag', '/b/1/x/bag'], ['a/1/x/bag', 'b/1/x/bag']), (['/a/one'], ['one'])])
def test_recordings_have_distinct_names(paths, names):
    assert names_of([Path(path) for path in paths]) == names
