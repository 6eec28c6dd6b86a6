"""Where methods of this kind fail: one function for each row of the stability suite.

``tests/stability`` runs them on a small avatar, ``rnd-bench --stability`` at full size; both call the same functions
(``rows.ROWS``), which return what they measured and never raise for a failed line.
"""
