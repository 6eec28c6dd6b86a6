"""The light stage: coded people, path-traced from many sides under many lights, with the truth beside every picture.

``.subjects`` describes people, ``.garments`` and ``.fabrics`` dress them, ``.cloth`` moves what they wear,
``.render`` films them with Mitsuba 3, ``.estimates`` spoils the truth as estimators would, ``.film`` writes
the capture. The command is ``rnd-stage`` (``.cli``).
"""
