"""The light stage: coded people, path-traced from many sides under many lights, with the truth beside every picture.

:mod:`.subjects` describes people, :mod:`.garments` and :mod:`.fabrics` dress them, :mod:`.cloth` moves what they wear,
:mod:`.render` films them with Mitsuba 3, :mod:`.estimates` spoils the truth as estimators would, :mod:`.film` writes
the capture. The command is ``rnd-stage`` (:mod:`.cli`).
"""
