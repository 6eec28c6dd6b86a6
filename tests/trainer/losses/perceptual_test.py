"""Perceptual distances against torch.nn compositions, the formula in numpy, and LPIPS' published example."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_trainer.losses.perceptual import Perceptual, load_perceptual
from support.paths import SHARED

SHARED_DATA = SHARED / "data" / "perceptual"
needs_shared = pytest.mark.skipif(
    not SHARED_DATA.is_dir(), reason="the shared weights are not here; the self-made ones above are"
)

PUBLISHED = 5e-4  # LPIPS' README prints three digits
SAME_KERNELS = 1e-12  # float64, both sides call torch's convolution
BFLOAT16 = 0.02  # eight bits of a product, averaged over a map
SLOPE = 1e-6  # central differences over 1e-6 in float64, no unit within that of its kink at this seed

NAMES = ("alexnet", "squeezenet1_1", "vgg16")
# LPIPS' slices end here: the last module of each in torchvision's numbering
TAPS = {"alexnet": (1, 4, 7, 9, 11), "squeezenet1_1": (1, 4, 7, 9, 10, 11, 12), "vgg16": (3, 8, 15, 22, 29)}
CHANNELS = {
    "alexnet": (64, 192, 384, 256, 256),
    "squeezenet1_1": (64, 128, 256, 384, 384, 512, 512),
    "vgg16": (64, 128, 256, 512, 512),
}


class Fire(nn.Module):
    def __init__(self, inputs: int, squeezed: int, half: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, half, 1)
        self.expand3x3 = nn.Conv2d(squeezed, half, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x).relu(), self.expand3x3(x).relu()], 1)


def _alexnet() -> list[nn.Module]:
    return [
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(),
    ]


def _squeezenet1_1() -> list[nn.Module]:
    return [
        nn.Conv2d(3, 64, 3, stride=2),
        nn.ReLU(),
        nn.MaxPool2d(3, 2, ceil_mode=True),
        Fire(64, 16, 64),
        Fire(128, 16, 64),
        nn.MaxPool2d(3, 2, ceil_mode=True),
        Fire(128, 32, 128),
        Fire(256, 32, 128),
        nn.MaxPool2d(3, 2, ceil_mode=True),
        Fire(256, 48, 192),
        Fire(384, 48, 192),
        Fire(384, 64, 256),
        Fire(512, 64, 256),
    ]


def _vgg16() -> list[nn.Module]:
    modules: list[nn.Module] = []
    channels = 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width == 0:
            modules.append(nn.MaxPool2d(2))
        else:
            modules += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
    return modules


def _tensors(net: nn.Sequential, name: str, layers: int, heads: bool = True) -> dict[str, torch.Tensor]:
    """What a file of the first ``layers`` slices of the network holds; all the heads, as the real files have."""
    wrapped = nn.Sequential(OrderedDict(features=net[: TAPS[name][layers - 1] + 1]))
    state = {key: value.detach() for key, value in wrapped.state_dict().items()}
    if heads:
        generator = torch.Generator().manual_seed(1)
        for k, channels in enumerate(CHANNELS[name]):
            state[f"lin{k}.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    return state


def write_alexnet(path: Path) -> None:
    """A complete AlexNet with LPIPS heads and random weights."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_file(_tensors(nn.Sequential(*_alexnet()), "alexnet", len(TAPS["alexnet"])), path)


@pytest.fixture(scope="module")
def nets() -> dict[str, nn.Sequential]:
    """The three networks as torch.nn modules with random weights."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        makers = {"alexnet": _alexnet, "squeezenet1_1": _squeezenet1_1, "vgg16": _vgg16}
        return {name: nn.Sequential(*make()) for name, make in makers.items()}


@pytest.fixture(scope="module")
def folder(nets, tmp_path_factory) -> Path:
    """A complete file of each network, with heads, and one of VGG16's first two blocks."""
    path = tmp_path_factory.mktemp("weights")
    for name in NAMES:
        save_file(_tensors(nets[name], name, len(TAPS[name])), path / f"{name}.safetensors")
    save_file(_tensors(nets["vgg16"], "vgg16", 2), path / "vgg16_blocks.safetensors")
    return path


@pytest.fixture(scope="module")
def distances(folder) -> dict[str, Perceptual]:
    return {name: load_perceptual(folder / f"{name}.safetensors") for name in NAMES}


@pytest.fixture
def small(nets, tmp_path) -> Path:
    """AlexNet's first layer with its heads: the cheapest real layout."""
    save_file(_tensors(nets["alexnet"], "alexnet", 1), tmp_path / "small.safetensors")
    return tmp_path / "small.safetensors"


def _image(height: int, width: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(height, width, 3, dtype=torch.float64, generator=generator)


def _expected_features(net: nn.Sequential, name: str, image: torch.Tensor) -> list[torch.Tensor]:
    """ImageNet's mean and deviation in 0…1 are LPIPS' shift and scale in −1…1."""
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    x = torch.from_numpy((image.numpy() - mean) / deviation).permute(2, 0, 1)[None]
    maps = []
    with torch.no_grad():
        for index, module in enumerate(net.double()):
            x = module(x)
            if index in TAPS[name]:
                maps.append(x[0])
    net.float()
    return maps


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [(37, 44), (48, 35), (33, 31)])
def test_features_are_those_of_torch_modules(name, size, nets, distances) -> None:
    image = _image(*size)  # sides whose halves are odd and even, so that ceil and floor differ
    found = distances[name].to(dtype=torch.float64).features(image)
    expected = _expected_features(nets[name], name, image)
    assert [f.shape for f in found] == [e.shape for e in expected]
    assert [f.shape[0] for f in found] == list(CHANNELS[name])
    assert max(float((f - e).abs().max()) for f, e in zip(found, expected)) < SAME_KERNELS


@pytest.mark.parametrize("name", NAMES)
def test_distance_is_the_papers_formula(name, nets, distances) -> None:
    a, b = _image(34, 37), _image(34, 37, seed=1)
    state = _tensors(nets[name], name, len(TAPS[name]))
    expected = 0.0
    maps = zip(_expected_features(nets[name], name, a), _expected_features(nets[name], name, b))
    for k, (x, y) in enumerate(maps):
        x, y = x.numpy(), y.numpy()
        unit_x, unit_y = (m / (np.sqrt((m**2).sum(0)) + 1e-10) for m in (x, y))
        weight = state[f"lin{k}.weight"].numpy().astype(np.float64)[0]
        expected += float((weight * (unit_x - unit_y) ** 2).sum(0).mean())
    distance = distances[name].to(dtype=torch.float64)
    assert expected > 0.01
    assert float(distance(a, b)) == pytest.approx(expected, rel=1e-9)
    assert float(distance(b, a)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_equal_images_are_at_zero_with_zero_gradient(name, distances) -> None:
    image = _image(34, 37).float().requires_grad_()
    distance = distances[name](image, image.detach().clone())
    assert distance.shape == () and float(distance.detach()) == 0
    distance.backward()
    assert torch.equal(image.grad, torch.zeros_like(image))


@pytest.mark.parametrize("name", NAMES)
def test_gradient_is_the_slope(name, distances) -> None:
    distance = distances[name].to(dtype=torch.float64)
    image, target = _image(33, 34).requires_grad_(), _image(33, 34, seed=1)
    (gradient,) = torch.autograd.grad(distance(image, target), image)
    step = 1e-6
    for seed in (2, 3):
        direction = _image(33, 34, seed=seed) - 0.5
        with torch.no_grad():
            ahead, behind = (distance(image + s * step * direction, target) for s in (1, -1))
        slope = float(ahead - behind) / (2 * step)
        assert float((gradient * direction).sum()) == pytest.approx(slope, rel=SLOPE, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_bfloat16_is_near_float64(name, distances, monkeypatch) -> None:
    """Also on a processor that only emulates it."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True}, raising=False)
    exact, coarse = distances[name].to(dtype=torch.float64), distances[name].in_bfloat16()
    image, target = _image(96, 80).requires_grad_(), _image(96, 80, seed=1)
    seen = image.detach().float().requires_grad_()
    far, ours = exact(image, target), coarse(seen, target.float())
    assert float(ours.detach()) == pytest.approx(float(far.detach()), rel=BFLOAT16)
    far.backward()
    ours.backward()
    along = torch.nn.functional.cosine_similarity(seen.grad.double().flatten(), image.grad.flatten(), dim=0)
    assert float(along) > 0.95


def test_a_processor_without_bfloat16_keeps_its_weights(distances, monkeypatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict, raising=False)
    assert distances["alexnet"].in_bfloat16() is distances["alexnet"]


def test_dead_features_give_no_nan(nets, tmp_path) -> None:
    state = _tensors(nets["alexnet"], "alexnet", 2)
    state["features.3.bias"] = torch.full((192,), -1e6)
    save_file(state, tmp_path / "dead.safetensors")
    image = _image(20, 20).float().requires_grad_()
    distance = load_perceptual(tmp_path / "dead.safetensors")(image, _image(20, 20, seed=1).float())
    distance.backward()
    assert float(distance.detach()) > 0  # the first layer still sees the difference
    assert torch.isfinite(image.grad).all() and float(image.grad.abs().max()) > 0


@pytest.mark.parametrize("name", NAMES)
def test_smallest_is_the_size_at_which_torch_gives_up(name, nets, distances, tmp_path) -> None:
    for layers in range(1, len(TAPS[name]) + 1):
        part = distances[name]
        if layers < part.layers:
            save_file(_tensors(nets[name], name, layers), tmp_path / "part.safetensors")
            part = load_perceptual(tmp_path / "part.safetensors")
        net, side = nets[name][: TAPS[name][layers - 1] + 1], part.smallest
        assert part.features(torch.zeros(side, side, 3))[-1].shape[1:] == (1, 1)
        if side > 1:
            with pytest.raises(RuntimeError):
                net(torch.zeros(1, 3, side - 1, side - 1))
            for height, width in ((side - 1, 99), (99, side - 1)):
                with pytest.raises(InputError, match=rf"at least {side} × {side} pixels, got {width} × {height}"):
                    part.features(torch.zeros(height, width, 3))


@pytest.mark.parametrize(("name", "layers"), [("alexnet", 3), ("squeezenet1_1", 4), ("vgg16", 3)])
def test_grids_centre_each_cell_in_its_receptive_field(name, layers, nets, tmp_path) -> None:
    """NaN reaches every cell whose receptive field contains its pixel."""
    save_file(_tensors(nets[name], name, layers, heads=False), tmp_path / "part.safetensors")
    net = load_perceptual(tmp_path / "part.safetensors").to(dtype=torch.float64)  # float32 may take Winograd
    assert len(net.grids) == layers
    offsets: list[list[float]] = [[] for _ in net.grids]
    coarsest = net.grids[-1][0]
    for column in range(120, 120 + coarsest):
        image = torch.zeros(net.smallest, 256, 3, dtype=torch.float64)
        image[:, column] = float("nan")
        for k, ((stride, offset), features) in enumerate(zip(net.grids, net.features(image))):
            cells = features.isnan().any(0).any(0).nonzero()[:, 0]
            offsets[k] += [stride * int(j) + offset - (column + 0.5) for j in cells]
    assert [float(np.mean(o)) for o in offsets] == [0.0] * layers
    assert [min(o) == -max(o) for o in offsets] == [True] * layers


def test_complete_networks_are_lpips_and_parts_are_not(distances, folder, nets, tmp_path) -> None:
    for name in NAMES:
        assert distances[name].backbone == name
        assert distances[name].is_lpips
        assert distances[name].layers == len(TAPS[name])
    part = load_perceptual(folder / "vgg16_blocks.safetensors")  # its five heads: three have no layer
    assert (part.backbone, part.is_lpips, part.layers) == ("vgg16[:2]", False, 2)
    a, b = _image(20, 20).float(), _image(20, 20, seed=1).float()
    assert 0 < float(part(a, b)) < float(distances["vgg16"](a, b))
    save_file(_tensors(nets["alexnet"], "alexnet", 5, heads=False), tmp_path / "bare.safetensors")
    bare = load_perceptual(tmp_path / "bare.safetensors")
    assert (bare.backbone, bare.is_lpips) == ("alexnet", False)
    assert len(bare.features(_image(31, 31).float())) == 5
    with pytest.raises(InputError, match=r"bare\.safetensors: .*expected LPIPS heads.*alexnet without heads"):
        bare(_image(31, 31).float(), _image(31, 31).float())


@pytest.mark.parametrize("zipped", [True, False])
def test_torchvisions_pth_is_read_without_its_classifier(zipped, nets, small, tmp_path) -> None:
    state = OrderedDict(_tensors(nets["alexnet"], "alexnet", 1, heads=False))
    state["features.0.weight"] = nn.Parameter(state["features.0.weight"])  # torchvision's old files hold these
    state["classifier.1.weight"] = torch.zeros(4, 4)
    torch.save(state, tmp_path / "alexnet.pth", _use_new_zipfile_serialization=zipped)
    image = _image(16, 16).float()
    net = load_perceptual(tmp_path / "alexnet.pth")
    assert torch.equal(net.features(image)[0], load_perceptual(small).features(image)[0])
    assert not net.heads and not net.features(image)[0].requires_grad


def test_files_that_cannot_be_read_are_refused(small, tmp_path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.pth: perceptual weights not found"):
        load_perceptual(tmp_path / "nowhere.pth")
    with pytest.raises(InputError, match="got a folder"):
        load_perceptual(tmp_path)
    other = small.with_suffix(".npz")
    other.write_bytes(small.read_bytes())
    with pytest.raises(InputError, match=r"expected \.safetensors or \.pth, got \.npz"):
        load_perceptual(other)
    pickled = tmp_path / "list.pth"
    torch.save([torch.zeros(3)], pickled)
    with pytest.raises(InputError, match="expected a dictionary of tensors, got list"):
        load_perceptual(pickled)
    torch.save({"state_dict": {"features.0.weight": torch.zeros(3)}}, pickled)
    with pytest.raises(InputError, match=r"expected a dictionary of tensors, got dict with state_dict: dict"):
        load_perceptual(pickled)


@pytest.mark.parametrize("suffix", [".safetensors", ".pth"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_file_is_refused(suffix, share, small, tmp_path) -> None:
    whole = small
    if suffix == ".pth":
        whole = small.with_suffix(".pth")
        torch.save(load_file(small), whole)
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    with pytest.raises(InputError, match=rf"cut{suffix}: not a whole {suffix} file of weights") as caught:
        load_perceptual(cut)
    assert "\n" not in str(caught.value)


def test_a_pickle_that_runs_code_is_refused_and_not_run(tmp_path) -> None:
    owned = tmp_path / "owned"
    hostile = tmp_path / "hostile.pth"
    hostile.write_bytes(b"\x80\x02cos\nsystem\n(S'touch " + str(owned).encode() + b"'\ntR.")
    with pytest.raises(InputError, match=r"hostile\.pth: not a whole \.pth file of weights"):
        load_perceptual(hostile)
    assert not owned.exists()


def _changed(name: str, value: torch.Tensor | None):
    def change(state: dict[str, torch.Tensor]) -> None:
        state.pop(name, None)
        if value is not None:
            state[name] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_changed("features.0.bias", None), r"got features\.0\.bias missing"),
        (_changed("features.0.weight", torch.zeros(96, 3, 7, 7)), r"got features\.0\.weight \(96, 3, 7, 7\)"),
        (_changed("features.4.weight", torch.zeros(64)), r"got features\.4\.weight \(64,\)"),  # batch norm
        (_changed("features.3.weight", torch.zeros(192, 64, 5, 5)), r"got features\.3\.bias missing"),
        (_changed("features.0.bias", torch.full((64,), float("nan"))), r"features\.0\.bias: expected finite"),
        (_changed("lin0.weight", torch.full((1, 64, 1, 1), float("inf"))), r"lin0\.weight: expected finite"),
        (_changed("lin0.weight", None), r"head lin0\.weight: expected \(1, 64, 1, 1\), got none"),
        (_changed("lin0.weight", torch.zeros(64)), r"head lin0\.weight: expected \(1, 64, 1, 1\), got \(64,\)"),
        (lambda state: [state.pop(k) for k in list(state) if k.startswith("f")], r"got no features\.\*"),
    ],
)
def test_tensors_of_no_known_network_are_refused(change, message, small) -> None:
    state = load_file(small)
    change(state)
    save_file(state, small)
    with pytest.raises(InputError, match=r"small\.safetensors: .*" + message) as caught:
        load_perceptual(small)
    assert "\n" not in str(caught.value)


def _example(name: str) -> torch.Tensor:
    return torch.from_numpy(read_image(SHARED_DATA / f"ex_{name}.png").astype(np.float32) / 255)


@needs_shared
@pytest.mark.parametrize(("name", "far", "near"), [("alexnet", 0.722, 0.138), ("squeezenet1_1", 0.711, 0.148)])
def test_lpips_of_its_own_example(name, far, near) -> None:
    lpips = load_perceptual(SHARED_DATA / f"{name}.safetensors")
    assert lpips.is_lpips and lpips.backbone == name
    assert float(lpips(_example("ref"), _example("p0"))) == pytest.approx(far, abs=PUBLISHED)
    assert float(lpips(_example("ref"), _example("p1"))) == pytest.approx(near, abs=PUBLISHED)
