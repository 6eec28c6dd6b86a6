"""The graph of an ``avatar.onnx`` at work in onnxruntime. Knows of no kernel, so it can load while numba does."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.avatar.inference import open_session, run_session
from rnd_runtime.core.arrays import shallow_copy
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.kinds import explained
from rnd_runtime.core.threads import cores

from .file import (
    CONSTANT_OUTPUTS,
    NODE_LOGITS,
    NODE_OUTPUTS,
    POSED_OUTPUTS,
    REST_OUTPUTS,
    check_shapes,
    decode_light,
    read_advice,
    read_metadata,
)
from .onnx_parts import OnnxFile, Rows
from .operators import check_operators

Floats32 = NDArray[np.float32]


class Networks:
    """The evaluated graph of one file. Get one with ``load``.

    Attributes:
        metadata, advice, trained_light: of the file; see ``avatar.avatar.Avatar``.
        posed_outside: whether the graph leaves posing to the caller: then the networks are evaluated at nodes.
        materials: ``CONSTANT_OUTPUTS``, whatever the pose.
        rest: ``REST_OUTPUTS``, empty unless ``posed_outside``.
    """

    def __init__(self, file: OnnxFile, size: int, threads: int | None = None, path: Path | None = None) -> None:
        self.metadata, self.advice = read_metadata(file), read_advice(file)
        check_shapes(file, self.metadata)
        check_operators(file, size)
        self.trained_light = decode_light(self.metadata)
        self._file, self._threads, self._path = file, threads or cores(), path
        self._sessions: dict[tuple[str, ...], Any] = {}
        self._rows: Rows | None = None
        self.posed_outside = not {*NODE_OUTPUTS, *REST_OUTPUTS} - file.outputs.keys()
        self._aside = ThreadPoolExecutor(1, "networks")
        sessions = self._aside.submit(lambda: [self._session(part) for part in self._parts])
        self.materials = self._constants(CONSTANT_OUTPUTS)
        self.rest = self._constants(REST_OUTPUTS) if self.posed_outside else []
        sessions.result()

    @classmethod
    def load(cls, path: str | Path, threads: int | None = None) -> Networks:
        """Read ``path``. ``threads``: of onnxruntime; by default one per core.

        Raises ``InputError`` for anything that is not a complete avatar of a known schema.
        """
        try:
            path = existing_file(path, what="avatar")
            content = path.read_bytes()
            return cls(OnnxFile(content), len(content), threads, path)
        except InputError as error:
            raise explained(error, path, "avatar") from error

    @property
    def nodes(self) -> int:
        """How many nodes the networks are evaluated at, where the graph is ``posed_outside``."""
        return self._file.outputs[NODE_OUTPUTS[0]][0] if self._rows is None else len(self._rows.kept)

    def at_nodes(self, kept: Sequence[int]) -> Networks:
        """The same networks at some of the nodes, on one thread."""
        parts = (tuple(output for part in self._parts for output in part),)
        return shallow_copy(self, _rows=Rows(self.nodes, kept), _sessions={}, _parts=parts, _threads=1)

    @property
    def can_leave_out_nodes(self) -> bool:
        """Whether ``at_nodes`` applies: all nodes are treated alike, all or none have the template's skinning."""
        whole = self.posed_outside and self._rows is None
        return (
            whole and self.metadata.variant.dynamic_nodes in (0, self.nodes) and self.nodes != self.metadata.gaussians
        )

    def at(self, inputs: tuple[ArrayLike, ArrayLike, ArrayLike]) -> list[Floats32]:
        """What ``run`` gives for the nodes, Δ logits first unless skinning is static; or the posed outputs."""
        own, *others = self._parts
        aside = [self._aside.submit(self.run, inputs, part) for part in others]
        return self.run(inputs, own) + [value for part in aside for value in part.result()]

    def run(self, inputs: tuple[ArrayLike, ArrayLike, ArrayLike], outputs: Sequence[str]) -> list[Floats32]:
        """Named outputs of the graph for (pose_window, joint_velocity, bone_transforms); nothing else is computed.

        Raises ``InputError`` where the file's graph cannot be evaluated: its indices are checked only then.
        """
        session = self._session(tuple(outputs))
        given = dict(zip(("pose_window", "joint_velocity", "bone_transforms"), inputs))
        values = {wanted.name: np.ascontiguousarray(given[wanted.name], np.float32) for wanted in session.get_inputs()}
        try:
            return self._evaluated(session, outputs, values)
        except InputError as error:
            raise error.at(file=self._path) from error

    def _evaluated(self, session: Any, outputs: Sequence[str], values: dict[str, Floats32]) -> list[Floats32]:
        results: list[Floats32] = run_session(session, outputs, values)
        self._check_promised(outputs, results)
        return results

    def _check_promised(self, outputs: Sequence[str], values: Sequence[NDArray[Any]]) -> None:
        """The kernels that go over ``values`` check no bounds."""
        for name, value in zip(outputs, values):
            promised = self._file.outputs[name]
            if self._rows is not None:
                promised = [len(self._rows.kept), *promised[1:]]
            if promised and list(value.shape) != promised:  # integers' shapes are not read
                raise InputError(name, expected=f"shape {promised}", got=list(value.shape))

    def _constants(self, outputs: Sequence[str]) -> list[Floats32]:
        session = open_session(self._file.extract(outputs), 1)
        if session.get_inputs():
            names = ", ".join(outputs)
            raise InputError("graph outputs", expected=f"{names}: constants", got="some that need a pose")
        return self._evaluated(session, outputs, {})

    def _session(self, outputs: tuple[str, ...]) -> Any:
        """A session that computes ``outputs`` and no more; kept."""
        if outputs not in self._sessions:
            at_once = len(self._parts) if outputs in self._parts else 1
            threads = -(-self._threads // at_once)
            self._sessions[outputs] = open_session(self._file.extract(outputs, self._rows), threads)
        return self._sessions[outputs]

    @cached_property
    def _parts(self) -> tuple[tuple[str, ...], ...]:
        """What is evaluated at once: skinning's network takes about as long as the two others. On a core each, none of
        their hundred operations has to wait for a second thread."""
        if not self.posed_outside:
            return (POSED_OUTPUTS,)
        skinning = (NODE_LOGITS,) if NODE_LOGITS in self._file.outputs else ()
        if skinning and self._threads > 1:
            return skinning, NODE_OUTPUTS
        return ((*skinning, *NODE_OUTPUTS),)
