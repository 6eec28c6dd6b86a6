"""Failure modes of avatars: ``rnd-bench stability`` at full size, ``tests/bench/stability`` on a small avatar."""
