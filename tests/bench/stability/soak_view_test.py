"""The soak of ``rnd-view``, short."""

from types import SimpleNamespace

import pytest

from rnd_bench.stability.soak_view import soak_view
from support.paths import ASSETS


@pytest.mark.slow
def test_clients_come_and_go():
    growth, usual, longest, refused, ended, to_end = soak_view(SimpleNamespace(avatar_file=ASSETS / "avatar.onnx"), 0.1)
    assert growth.measured is None  # too few
    assert usual.measured <= longest.measured and refused.passes and ended.passes and to_end.passes
