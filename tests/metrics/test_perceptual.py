"""LPIPS and FVD with tiny weights made here, against independent computations."""

import hashlib

import numpy as np
import pytest
import scipy.linalg
import torch
from safetensors.torch import save_file
from torch import nn
from torchmetrics.functional.image import lpips as theirs
from torchmetrics.functional.image.lpips import NetLinLayer, ScalingLayer

from acwm_core.checks import check_metric
from acwm_core.errors import DataError
from acwm_metrics.fvd import FVD, frechet_distance
from acwm_metrics.lpips import LPIPS, NETWORKS
from tests.metrics.test_pixel import predicted

ALEX = [
    *(nn.Conv2d(3, 6, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)),
    *(nn.Conv2d(6, 8, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
    *(nn.Conv2d(8, 7, 3, padding=1), nn.ReLU(), nn.Conv2d(7, 5, 3, padding=1), nn.ReLU()),
    *(nn.Conv2d(5, 4, 3, padding=1), nn.ReLU()),
]
"""AlexNet's convolutions with few channels; the compared outputs follow."""
ALEX_COMPARED = (1, 4, 7, 9, 11)

WIDTHS = (3, 2, 4, 3, 5, 2, 3, 4, 3, 2, 4, 3, 2)
VGG_COMPARED = (3, 8, 15, 22, 29)


def vgg():
    """VGG-16's convolutions with few channels, in torchvision's order."""
    layers, channels, widths = [], 3, iter(WIDTHS)
    for convolutions in (2, 2, 3, 3, 3):
        for width in (next(widths) for _ in range(convolutions)):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        layers.append(nn.MaxPool2d(2, 2))
    return layers


def networks():
    torch.manual_seed(0)
    for name, layers, compared in (("alex", ALEX, ALEX_COMPARED), ("vgg", vgg(), VGG_COMPARED)):
        widths = [[m for m in layers[: k + 1] if isinstance(m, nn.Conv2d)][-1] for k in compared]
        heads = [NetLinLayer(conv.out_channels, use_dropout=True) for conv in widths]
        for head in heads:
            nn.init.uniform_(head.model[1].weight, 0, 1)
        yield name, nn.Sequential(*layers).eval(), compared, [head.eval() for head in heads]


@pytest.fixture(scope="module", params=list(networks()), ids=lambda each: each[0])
def tiny_network(request, tmp_path_factory):
    """Name, layers, compared outputs, heads, and the files of their weights."""
    name, layers, compared, heads = request.param
    folder = tmp_path_factory.mktemp(name)
    state = {f"features.{key}": value for key, value in layers.state_dict().items()}
    torch.save({**state, "classifier.6.bias": torch.zeros(3)}, folder / "backbone.pth")
    linear = {f"lin{k}.{n}": v for k, h in enumerate(heads) for n, v in h.state_dict().items()}
    torch.save(linear, folder / "heads.pth")
    return name, layers, compared, heads, folder


def lpips(network):
    name, *_, folder = network
    files = {part: str(folder / f"{part}.pth") for part in ("backbone", "heads")}
    return LPIPS(network=name, **files)


def clips(frames=3, size=40, seed=1):
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(frames, 3, size, size + 8, generator=generator)
    noise = torch.randn(target.shape, generator=generator) * 0.2
    return predicted((target + noise).clamp(0, 1), target)


def by_parts(network, clip):
    """LPIPS with the scaling and the heads of torchmetrics, in double precision."""
    _, layers, compared, heads, _ = network
    outputs = []
    for video in (clip.video, clip.target):
        hidden, found = ScalingLayer()(video * 2 - 1), []
        for place, layer in enumerate(layers):
            hidden = layer(hidden)
            if place in compared:
                found.append(nn.functional.normalize(hidden, dim=1))
        outputs.append(found)
    pairs = zip(*outputs, heads, strict=True)
    with torch.no_grad():
        return sum(head((a - b) ** 2).mean((1, 2, 3)) for a, b, head in pairs).double().numpy()


def test_lpips_is_that_of_an_independent_computation(tiny_network):
    clip = clips()
    expected = by_parts(tiny_network, clip)
    assert (expected > 1e-3).all()
    np.testing.assert_allclose(lpips(tiny_network).per_frame(clip), expected, rtol=1e-4)


WIDTHS_OF = {
    "alex": (64, 192, 384, 256, 256),
    "vgg": (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512),
}


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_lpips_is_that_of_torchmetrics_with_its_heads(name, tmp_path, monkeypatch):
    """Of a random backbone in torchvision's layout; one file is all that a user brings."""
    torch.manual_seed(0)
    layers, channels, widths = [], 3, iter(WIDTHS_OF[name])
    for layer in ALEX if name == "alex" else vgg():
        if isinstance(layer, nn.Conv2d):
            width = next(widths)
            size, stride, padding = layer.kernel_size, layer.stride, layer.padding
            layer = nn.Conv2d(channels, width, size, stride, padding)
            channels = width
        layers.append(layer)
    backbone = nn.Sequential(*layers)
    state = {f"features.{key}": value for key, value in backbone.state_dict().items()}
    torch.save(state, tmp_path / "backbone.pth")
    monkeypatch.setattr(theirs, "_get_tv_model_features", lambda *args: backbone)
    clip = clips()
    network = theirs._NoTrainLpips(net=name, pretrained=True)
    with torch.no_grad():
        expected = network(clip.video, clip.target, normalize=True).flatten().double().numpy()
    metric = LPIPS(network=name, backbone=str(tmp_path / "backbone.pth"))
    assert (expected > 0).all()
    np.testing.assert_allclose(metric.per_frame(clip), expected, rtol=1e-3)
    assert metric.provenance().keys() == {"network", "backbone", "heads"}


def test_lpips_conforms(tiny_network):
    name, *_, folder = tiny_network
    files = {part: str(folder / f"{part}.pth") for part in ("backbone", "heads")}
    results = list(check_metric("lpips", network=name, **files))
    assert [str(result) for result in results if not result.passed] == []


def test_layers_are_torchvisions():
    indices = {name: [layer.index for layer in layers] for name, layers in NETWORKS.items()}
    convolutions = [k for k, layer in enumerate(vgg()) if isinstance(layer, nn.Conv2d)]
    assert indices == {"alex": [0, 3, 6, 8, 10], "vgg": convolutions}


def test_the_hashes_of_the_files_are_recorded(tiny_network):
    folder = tiny_network[-1]
    facts = lpips(tiny_network).provenance()
    assert facts["network"] == tiny_network[0]
    for part in ("backbone", "heads"):
        content = (folder / f"{part}.pth").read_bytes()
        assert facts[part] == hashlib.sha256(content).hexdigest()


def test_without_weights_they_say_what_to_give():
    card = clips().card
    for metric, words in ((LPIPS(), ["lpips.backbone", "alexnet"]), (FVD(), ["i3d_torchscript"])):
        reason = metric.unavailable(card, None)
        assert all(word in reason for word in words)
        assert metric.provenance() == {} or metric.provenance() == {"network": "alex"}
    first = next(iter(check_metric("lpips")))
    assert "it needs weights" in first.reason


def test_lpips_refuses_frames_its_network_cannot_see(tiny_network):
    small = clips(size=24).card
    assert "at least 32×32 pixels, not 24×32" in lpips(tiny_network).unavailable(small, None)
    assert lpips(tiny_network).unavailable(clips(size=32).card, None) is None
    assert np.isfinite(lpips(tiny_network).per_frame(clips(size=32))).all()


def test_weights_of_something_else_are_refused(tiny_network, tmp_path):
    name, *_, folder = tiny_network
    good = {part: str(folder / f"{part}.pth") for part in ("backbone", "heads")}
    with pytest.raises(DataError, match=r"nowhere\.pth is missing"):
        LPIPS(network=name, **{**good, "heads": "nowhere.pth"})
    with pytest.raises(DataError, match=r"features\.0 does not fit"):
        LPIPS(network=name, backbone=good["heads"], heads=good["heads"])
    with pytest.raises(DataError, match=r"lin0\S* does not fit"):
        LPIPS(network=name, backbone=good["backbone"], heads=good["backbone"])
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(DataError, match=r"text\.pth"):
        LPIPS(network=name, **{**good, "backbone": str(tmp_path / "text.pth")})
    state = torch.load(good["backbone"], weights_only=True)
    save_file(state, tmp_path / "same.safetensors")
    same = LPIPS(network=name, **{**good, "backbone": str(tmp_path / "same.safetensors")})
    assert same.value(clips()) == lpips(tiny_network).value(clips())


class Detector(nn.Module):
    """Takes what I3D takes and checks it; features are means of pixels and of their changes."""

    def __init__(self):
        super().__init__()
        self.mix = nn.Conv3d(3, 4, 1)

    def forward(
        self, video, rescale: bool = True, resize: bool = True, return_features: bool = False
    ):
        assert not rescale
        assert not resize
        assert return_features
        assert video.shape[1] == 3
        assert video.shape[2] >= 10
        assert video.shape[3] == 224
        assert video.shape[4] == 224
        assert bool(video.min() >= -1)
        mixed = torch.tanh(3 * self.mix(nn.functional.avg_pool3d(video, [1, 14, 14])))
        changes = (mixed[:, :, 1:] - mixed[:, :, :-1]).abs().mean([2, 3, 4])
        left, right = mixed[:, :, :, :, :8], mixed[:, :, :, :, 8:]
        return torch.cat([mixed.mean([2, 3, 4]), changes, (left - right).mean([2, 3, 4])], 1)


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    torch.manual_seed(3)
    path = tmp_path_factory.mktemp("fvd") / "i3d_torchscript.pt"
    torch.jit.save(torch.jit.script(Detector().eval()), path)
    return str(path)


@pytest.mark.parametrize("rank", [5, 40])
def test_the_distance_of_gaussians_is_scipys(rank):
    rng = np.random.default_rng(0)
    one = rng.normal(size=(60, rank)) @ rng.normal(size=(rank, 12)) + 1
    other = rng.normal(size=(50, 12)) * np.linspace(0.5, 3, 12)
    covariances = [np.cov(each, rowvar=False) for each in (one, other)]
    root = scipy.linalg.sqrtm(covariances[0] @ covariances[1])
    means = one.mean(0) - other.mean(0)
    expected = means @ means + np.trace(covariances[0] + covariances[1] - 2 * root.real)
    assert frechet_distance(one, other) == pytest.approx(expected, rel=1e-6)
    assert frechet_distance(one, one) == pytest.approx(0, abs=1e-6)


def test_the_distance_of_independent_normals_is_the_analytic_one():
    rng = np.random.default_rng(1)
    scales, shift = np.array([1.0, 2.0, 0.5]), np.array([3.0, 0.0, -1.0])
    one = rng.normal(size=(100_000, 3))
    other = rng.normal(size=(100_000, 3)) * scales + shift
    expected = (shift**2).sum() + ((scales - 1) ** 2).sum()
    assert frechet_distance(one, other) == pytest.approx(expected, rel=0.02)


def test_fvd_compares_the_detectors_features(detector):
    metric = FVD(detector=detector)
    sets = [clips(frames=4, seed=seed) for seed in range(5)]
    features = np.stack([metric.features(clip) for clip in sets])
    assert features.shape == (5, 2, 12)
    script = torch.jit.load(detector)
    video = nn.functional.interpolate(sets[0].target, (224, 224), mode="bilinear")
    video = torch.cat([video, video[-1:].repeat(6, 1, 1, 1)]) * 2 - 1
    with torch.no_grad():
        expected = script(video.permute(1, 0, 2, 3)[None], False, False, True)[0]
    np.testing.assert_allclose(features[0, 1], expected, rtol=1e-4, atol=1e-6)
    made, true = features.astype(np.float64).swapaxes(0, 1)
    assert metric.distance(features) == pytest.approx(frechet_distance(made, true))
    assert np.isnan(metric.value(sets[0]))
    assert np.isnan(metric.distance(features[:1]))


@pytest.mark.ci
def test_fvd_conforms(detector):
    results = list(check_metric("fvd", detector=detector))
    assert [str(result) for result in results if not result.passed] == []


def test_a_detector_that_is_none_is_refused(tmp_path):
    with pytest.raises(DataError, match="is missing"):
        FVD(detector=str(tmp_path / "i3d.pt"))
    (tmp_path / "i3d.pt").write_bytes(b"nothing")
    with pytest.raises(DataError, match="not a TorchScript"):
        FVD(detector=str(tmp_path / "i3d.pt"))
