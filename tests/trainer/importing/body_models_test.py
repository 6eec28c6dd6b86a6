"""Body models from all file formats, against the published formulas."""

from __future__ import annotations

import pickle  # noqa: TID251  # writes what others' programs write
import sys
import types

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPLH_NAMES, SMPLX_NAMES
from rnd_trainer.importing import body_models
from rnd_trainer.importing.body_models import convert_body_model, load_body_model
from support.known_scene import coarse_body, smpl_arrays

RNG = np.random.default_rng(3)


def _family(joints: int) -> dict[str, np.ndarray]:
    """The members of a small SMPL-H or SMPL-X file: the scene's body with further joints at the wrists and head."""
    if joints == 24:
        return smpl_arrays()
    base = smpl_arrays()
    count = len(base["v_template"])
    names = SMPLH_NAMES if joints == 52 else SMPLX_NAMES
    parents = list(base["kintree_table"][0][:22].astype(int))
    parents[0] = -1
    for name in names[22:]:
        if name in ("jaw", "left_eye", "right_eye"):
            parents.append(15)
        elif name.endswith("1"):
            parents.append(20 if name.startswith("left") else 21)
        else:
            parents.append(len(parents) - 1)
    weights = np.zeros((count, joints))
    weights[:, :22] = base["weights"][:, :22]
    weights[:, [20, 21]] += base["weights"][:, 22:]
    regressor = np.concatenate([base["J_regressor"][:22], base["J_regressor"][[20] * (joints - 22)]])
    tree = np.stack([np.array(parents) % 2**32, np.arange(joints)])
    return {
        **{name: base[name] for name in ("v_template", "f")},
        "weights": weights,
        "J_regressor": regressor,
        "kintree_table": tree,
        "shapedirs": RNG.normal(size=(count, 3, 16 if joints == 52 else 20)) * 0.01,
    }


def published(arrays: dict[str, np.ndarray], betas) -> np.ndarray:
    """Vertices [V, 3] at rest by Loper et al. 2015, equation 8, a coefficient at a time."""
    return arrays["v_template"] + sum(beta * arrays["shapedirs"][:, :, k] for k, beta in enumerate(betas))


class Ch:
    """Stands for ``chumpy.ch.Ch`` while a file is written."""

    def __init__(self, x):
        self.x = x


class Select:
    """Stands for ``chumpy.reordering.Select``."""

    def __init__(self, a, idxs, preferred_shape):
        self.a, self.idxs, self.preferred_shape = a, idxs, preferred_shape


class csc_matrix:
    """Stands for ``scipy.sparse.csc.csc_matrix``, as SciPy of Python 2 pickled it."""

    def __init__(self, dense):
        from scipy.sparse import csc_matrix as sparse

        made = sparse(dense)
        self._shape, self.format, self.maxprint = made.shape, "csc", 50
        self.data, self.indices, self.indptr = made.data, made.indices, made.indptr


Ch.__module__, Select.__module__, csc_matrix.__module__ = "chumpy.ch", "chumpy.reordering", "scipy.sparse.csc"


def _write_pickle(path, arrays, monkeypatch) -> None:
    """As SMPL's .pkl: shapes in chumpy, the regressor sparse, protocol 2."""
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    for kind in (Ch, Select, csc_matrix):
        module = types.ModuleType(kind.__module__)
        setattr(module, kind.__name__, kind)
        monkeypatch.setitem(sys.modules, kind.__module__, module)
    shape_dirs = arrays["shapedirs"]
    content = dict(arrays)
    content["v_template"] = Ch(arrays["v_template"])
    content["shapedirs"] = Select(Ch(shape_dirs), np.arange(shape_dirs.size), shape_dirs.shape)
    content["J_regressor"] = csc_matrix(arrays["J_regressor"])
    content["bs_style"], content["bs_type"] = "lbs", "lrotmin"
    path.write_bytes(pickle.dumps(content, protocol=2))


@pytest.mark.parametrize(
    ("joints", "family", "names"), [(24, "SMPL", SMPL_NAMES), (52, "SMPL-H", SMPLH_NAMES), (55, "SMPL-X", SMPLX_NAMES)]
)
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_shapes_agree_with_the_published_formula(tmp_path, monkeypatch, joints, family, names, suffix) -> None:
    arrays = _family(joints)
    path = tmp_path / f"model{suffix}"
    if suffix == ".npz":
        np.savez(path, **arrays, bs_type=np.array("lrotmin"), joint2num=np.array({"pelvis": 0}, dtype=object))
    else:
        _write_pickle(path, arrays, monkeypatch)
    model = load_body_model(path)
    assert model.family == family and model.template.skeleton.names == names
    betas = RNG.normal(size=10)
    shaped = model.shaped(betas)
    assert_allclose(shaped.vertices, published(arrays, betas), atol=1e-9)
    assert_allclose(shaped.skeleton.rest_joints, arrays["J_regressor"] @ shaped.vertices, atol=1e-9)
    assert_allclose(shaped.skinning_weights, arrays["weights"], atol=1e-6)


@pytest.mark.parametrize(("columns", "shapes"), [(10, 10), (16, 16), (20, 10), (400, 300)])
def test_smplx_expressions_are_not_shape_parameters(tmp_path, columns, shapes) -> None:
    """v1.0 holds ten of either, v1.1 300 and 100."""
    arrays = _family(55)
    arrays["shapedirs"] = RNG.normal(size=(len(arrays["v_template"]), 3, columns))
    np.savez(tmp_path / "m.npz", **arrays)
    model = load_body_model(tmp_path / "m.npz")
    assert (model.shape_dirs == arrays["shapedirs"][..., :shapes]).all()


def test_a_body_npz_has_one_shape(tmp_path) -> None:
    coarse_body().save(tmp_path / "body.npz")
    model = load_body_model(tmp_path / "body.npz")
    assert model.family == "template"
    assert_allclose(model.shaped(np.ones(10)).vertices, coarse_body().vertices, atol=1e-6)


def test_a_pickle_with_code_is_refused_and_not_executed(tmp_path) -> None:
    class Bomb:
        def __reduce__(self):
            return (print, ("executed",))

    path = tmp_path / "smpl.pkl"
    path.write_bytes(pickle.dumps(dict(smpl_arrays(), J=Bomb())))
    with pytest.raises(InputError, match=r"smpl.pkl.*print"):
        load_body_model(path)


def test_wrong_members_are_refused(tmp_path) -> None:
    arrays = smpl_arrays()

    def refusal(**changes) -> str:
        np.savez(tmp_path / "m.npz", **{k: v for k, v in (arrays | changes).items() if v is not None})
        with pytest.raises(InputError) as caught:
            load_body_model(tmp_path / "m.npz")
        assert "m.npz" in str(caught.value)
        return str(caught.value)

    assert "J_regressor" in refusal(J_regressor=None)
    assert "got 23" in refusal(weights=arrays["weights"][:, :23])
    model_file = tmp_path / "smpl.npz"
    np.savez(model_file, **arrays)
    with pytest.raises(InputError, match="at most 10"):
        load_body_model(model_file).shaped(np.ones(12))
    load_body_model(model_file).shaped(np.concatenate([np.ones(10), np.zeros(6)]))  # unused ones do no harm


def test_anny_stands_in_a_t_pose() -> None:
    pytest.importorskip("anny")
    body = load_body_model("anny").template
    names, joints = list(body.skeleton.names), body.skeleton.rest_joints
    assert set(SMPL_NAMES[:22]) <= set(names)
    for side, sign in (("left", 1), ("right", -1)):
        arm = joints[names.index(f"{side}_wrist")] - joints[names.index(f"{side}_shoulder")]
        assert arm[0] * sign > 0.3 and abs(arm[1]) < 0.01 and abs(arm[2]) < 0.01
    assert 1.4 < np.ptp(body.vertices[:, 1]) < 2.0
    toes, heel = joints[names.index("left_foot")], joints[names.index("left_ankle")]
    assert toes[2] > heel[2]  # faces +Z


def test_a_converted_body_is_the_shaped_one(tmp_path) -> None:
    np.savez(tmp_path / "smpl.npz", **smpl_arrays())
    description = convert_body_model(tmp_path / "smpl.npz", tmp_path / "body.npz", (0.8, -0.5), "mine")
    assert "SMPL, 2340 vertices, 24 joints" in description
    body = Body.load(tmp_path / "body.npz")
    assert_allclose(body.vertices, published(smpl_arrays(), (0.8, -0.5)), atol=1e-6)
    assert body.license == "mine"


def test_conversions_without_effect_are_refused(tmp_path, monkeypatch) -> None:
    coarse_body().save(tmp_path / "body.npz")
    before = (tmp_path / "body.npz").read_bytes()
    monkeypatch.setattr(body_models, "anny_body", coarse_body)
    for model, out, betas, words in (
        ("body.npz", "body.npz", (), "another file than what is read"),
        ("body.npz", "body.txt", (), r"a name that ends in \.npz"),
        ("body.npz", "out.npz", (0.5, -0.2), r"--betas: expected none, .*body\.npz has one shape, got 0\.5 -0\.2"),
        ("anny", "out.npz", (1.0,), "--betas: expected none, as anny has one shape"),
    ):
        source = model if model == "anny" else tmp_path / model
        with pytest.raises(InputError, match=words):
            convert_body_model(source, tmp_path / out, betas)
    assert (tmp_path / "body.npz").read_bytes() == before and len(list(tmp_path.iterdir())) == 1
