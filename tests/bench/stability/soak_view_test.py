"""The soak of ``rnd-view``, short."""

from types import SimpleNamespace

import pytest

from rnd_bench.stability.soak_view import soak_view
from support.paths import ASSETS


@pytest.mark.slow
def test_clients_come_and_go():
    growth, longest, ended = soak_view(SimpleNamespace(avatar_file=ASSETS / "avatar.onnx"), 60)
    assert growth.measured is None  # too few
    assert longest.passes and ended.passes
