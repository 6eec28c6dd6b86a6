"""What the doctor says of a well machine, of one without OpenGL, and of drivers that crash or hang."""

import importlib.metadata
import re
import signal

import pytest

from rnd_runtime.playback import doctor
from rnd_runtime.playback.rasterizer import make_rasterizer

CRASH = "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)"
RAISE = "raise OSError('libEGL.so.1: cannot open shared object file')"


def _by_label(findings):
    return {finding.label: finding for finding in findings}


def test_a_well_machine_needs_nothing():
    findings = doctor.report()
    well = _by_label(findings)
    for label in ("OpenGL, EGL", "OpenGL, OSMesa"):
        assert "Mesa" in well[label].value or "NVIDIA" in well[label].value
    assert "CPUExecutionProvider" in well["onnxruntime providers"].value
    assert re.fullmatch(r"[1-9]\d*, (omp|tbb|workqueue)", well["numba threads"].value)
    assert well["numpy"].value == importlib.metadata.version("numpy")
    assert len(well) == len(findings)  # no label twice
    assert [finding.advice for finding in findings] == [None] * len(findings)
    with make_rasterizer("auto") as chosen:
        assert well["rasteriser"].value == chosen.name
    assert well["CPU"].value == doctor.machine()


@pytest.mark.parametrize(
    ("probe", "reason"), [(CRASH, f"crashed with signal {int(signal.SIGSEGV)}"), (RAISE, "libEGL.so.1")]
)
def test_without_opengl_it_says_what_to_install(monkeypatch, probe, reason):
    monkeypatch.setattr(doctor, "_GL_PROBE", probe)
    monkeypatch.setattr(doctor, "_CHOICE_PROBE", probe)
    for quick in ("_ONNX_PROBE", "_NUMBA_PROBE"):
        monkeypatch.setattr(doctor, quick, "print('not asked')")
    ill = _by_label(doctor.report())
    assert ill["OpenGL, EGL"].value == ill["OpenGL, OSMesa"].value == "missing"
    assert ill["OpenGL, EGL"].advice.startswith("apt-get install libegl1 libgl1-mesa-dri: ")
    assert ill["OpenGL, OSMesa"].advice.startswith("apt-get install libosmesa6: ")
    assert reason in ill["OpenGL, EGL"].advice
    assert ill["rasteriser"].value == "cpu" and reason in ill["rasteriser"].advice
