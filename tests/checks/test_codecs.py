"""Every installed codec conforms, and every check of codecs can fail."""

import copy
import importlib.util

import pytest
import torch
from torch import nn

from acwm_codecs.identity import Identity
from acwm_core.checks import check_codec
from acwm_core.checks.codec import CodecChecks
from acwm_core.checks.result import checks_of
from tests.checks.results import Flaws, failures, in_words, installed
from tests.codecs.tiny_autoencoders import save_tiny_codecs
from tests.tiny import MeanCodec

FLAWS = Flaws(check_codec, checks_of(CodecChecks))
FLAWS[MeanCodec] = "no frame is lost", "leaves no trace"


@pytest.fixture(scope="module")
def tiny_weights(tmp_path_factory):
    """Weights that are not downloaded, for the codecs that need `diffusers`."""
    if importlib.util.find_spec("diffusers") is None:
        return {}
    return save_tiny_codecs(tmp_path_factory.mktemp("tiny"))


# Those that take any weights are checked in tests/codecs/test_diffusers_image.py.
PARTS = [part for part in installed("codec") if not part.name.startswith("autoencoder_")]


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_installed_codecs_conform(part, tiny_weights):
    params = {"weights": tiny_weights[part.name]} if part.name in tiny_weights else {}
    assert failures(check_codec(part.name, **params)) == {}


def test_names_of_checks_are_words():
    assert [r.name for r in check_codec(Identity)] == [in_words(check) for check in FLAWS.all]


@FLAWS.caught_by("encodes a clip", "not a Codec")
class NoCodec(nn.Module):
    pass


@FLAWS.caught_by("encodes a clip", "not the shape")
class WrongChannels(Identity):
    def __init__(self):
        super().__init__()
        self.channels += 1


@FLAWS.caught_by("latents have declared shape", "not the shape")
class FirstOfTheBatch(Identity):
    def _encode(self, video):
        return super()._encode(video)[:1]


@FLAWS.caught_by("decoding restores the shape", "comes back")
class HalvesHeight(Identity):
    def decode(self, latents, frames=None):
        return super().decode(latents, frames)[..., ::2, :]


@FLAWS.caught_by("no frame is lost", "come back as")
class DropsOddFrames(Identity):
    def decode(self, latents, frames=None):
        return super().decode(latents, frames and 1 + (frames - 1) // 4 * 4)


@FLAWS.caught_by("decoding frame by frame is decoding", "differ by")
class ForgetsTheFrameBefore(Identity):
    def _decode(self, latents):
        before = torch.cat([latents[:, :1], latents[:, :-1]], 1)
        return super()._decode(0.5 * (latents + before))


@FLAWS.caught_by("a reference belongs to its video", "rest of the batch")
class ShowsOneReferenceToAll(Identity):
    shown = 0

    def with_reference(self, frame):
        seeing = copy.copy(self)
        seeing.shown = frame[:1].mean()
        return seeing

    def _decode(self, latents):
        return 0.9 * super()._decode(latents) + 0.1 * self.shown


@FLAWS.caught_by("encoding is causal", "when later frames are added")
class SeesTheFuture(Identity):
    def _encode(self, video):
        latents = super()._encode(video)
        return latents + 0.1 * latents.mean(1, keepdim=True)


@FLAWS.caught_by("clips of a batch are independent", "rest of the batch")
class BatchStatistics(Identity):
    def _encode(self, video):
        latents = super()._encode(video)
        return latents - latents.mean(0, keepdim=True)


@FLAWS.caught_by("latents are normalised", "not about 0 and 1")
class Unnormalised(Identity):
    def _encode(self, video):
        return 100 * super()._encode(video)


@FLAWS.caught_by("encoding repeats and leaves no trace", "encoding changes seen")
class Counts(Identity):
    def __init__(self):
        super().__init__()
        self.register_buffer("seen", torch.zeros(()))

    def _encode(self, video):
        self.seen += 1
        return super()._encode(video)


@FLAWS.caught_by("encoding repeats and leaves no trace", "the same clip again")
class Samples(Identity):
    def _encode(self, video):
        latents = super()._encode(video)
        return latents + 1e-4 * torch.randn_like(latents)


@FLAWS.caught_by("encoding repeats and leaves no trace", "changes its input")
class InPlace(Identity):
    def _encode(self, video):
        return super()._encode(video.mul_(255).round_().div_(255))


@FLAWS.caught_by("bad video is refused", "is not refused")
class Crops(Identity):
    def encode(self, video):
        height, width = (side // 8 * 8 for side in video.shape[-2:])
        return super().encode(video[..., :height, :width])


@FLAWS.caught_by("fingerprint names the weights", "another fingerprint")
class RandomFingerprint(Identity):
    def __init__(self):
        super().__init__()
        self.drawn = torch.rand(()).item()

    def fingerprint(self):
        return str(self.drawn)


@FLAWS.caught_by("fingerprint names the weights", "leaves the fingerprint alone")
class ForgetsItsWeights(Identity):
    def __init__(self):
        super().__init__()
        self.scale = nn.Parameter(torch.ones(1))
