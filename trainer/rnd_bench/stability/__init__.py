"""The cases in which methods of this kind break.

``rnd-bench stability`` runs them at full size, ``tests/bench/stability`` on a small avatar: the same functions.
"""
