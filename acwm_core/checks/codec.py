"""`check_codec`: what latent caches, models and rollouts rely on in a codec."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from acwm_core.checks.result import (
    CheckFailure,
    CheckResult,
    expect,
    expect_is_a,
    factory,
    run_checks,
)
from acwm_core.checks.scene import moving_discs
from acwm_core.codec import Codec
from acwm_core.errors import RecipeError, ShapeError
from acwm_core.shapes import Video

TOLERANCE = 2e-3
"""Largest difference between latents that count as equal; their own spread is about 1."""


class CodecTrial:
    """A codec in evaluation mode and a clip that fits it.

    Args:
        make: constructs the codec, always the same.
    """

    def __init__(self, make: Callable[..., Codec]) -> None:
        self.make = make

    @functools.cached_property
    def codec(self) -> Codec:
        """One instance."""
        return self.make().eval()

    def clip(self, frames: int, batch: int = 1, seed: int = 0) -> Video:
        """A clip about 48 pixels high and wider than high, of sides that the codec takes."""
        stride = self.codec.spatial_stride
        cells = max(4, 48 // stride)
        return moving_discs(batch, frames, cells * stride, (cells + 2) * stride, seed)

    @property
    def full(self) -> int:
        """A length that fills three latent frames."""
        return self.codec.video_frames(3)

    def encode(self, video: Video) -> Tensor:
        """Encode without gradients."""
        with torch.no_grad():
            return self.codec.encode(video)


def check_codec(codec: str | Callable[..., Codec], **params: Any) -> Iterator[CheckResult]:
    """Check a codec against the contract of `acwm_core.codec.Codec`.

    Args:
        codec: a registered name, or the class.
        **params: constructor parameters.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the name cannot be resolved.
    """
    return run_checks(CHECKS, CodecTrial(functools.partial(factory("codec", codec), **params)))


def encodes_a_clip(trial: CodecTrial) -> None:
    """Construct the codec and encode a clip to finite latents."""
    expect_is_a(trial.codec, Codec)
    latents = trial.encode(trial.clip(trial.full))
    expect(latents.isfinite().all(), "latents are not finite")


def latents_have_declared_shape(trial: CodecTrial) -> None:
    """Keep to `channels`, `spatial_stride` and `temporal_stride` at every size and length."""
    codec = trial.codec
    for batch, frames in ((1, 1), (2, trial.full), (1, codec.video_frames(2))):
        video = trial.clip(frames, batch)
        shape = list(trial.encode(video).shape)
        height, width = codec.latent_size(*video.shape[-2:])
        declared = [batch, codec.latent_frames(frames), codec.channels, height, width]
        expect(shape == declared, f"{frames} frames encode to {shape}, declared are {declared}")


def decoding_restores_the_shape(trial: CodecTrial) -> None:
    """Decode to video in [0, 1] of the length and size that was encoded."""
    video = trial.clip(trial.full)
    with torch.no_grad():
        decoded = trial.codec(video)
    expect(decoded.shape == video.shape, f"{list(video.shape)} comes back {list(decoded.shape)}")
    expect(((decoded >= 0) & (decoded <= 1)).all(), "decoded video leaves [0, 1]")


def no_frame_is_lost(trial: CodecTrial) -> None:
    """Take any length, and let every frame show in the latents."""
    for frames in range(1, trial.full + 1):
        with torch.no_grad():
            decoded = trial.codec.decode(trial.encode(trial.clip(frames)), frames=frames)
        expect(decoded.shape[1] == frames, f"{frames} frames come back as {decoded.shape[1]}")
    lasts = [(frames, frames - 1) for frames in range(1, trial.full)]
    for frames, frame in lasts + [(trial.full, frame) for frame in range(trial.full)]:
        video = trial.clip(frames)
        changed = video.clone()
        changed[:, frame] = 1 - changed[:, frame]
        traceless = torch.equal(trial.encode(changed), trial.encode(video))
        expect(not traceless, f"frame {frame} of {frames} leaves no trace in the latents")


def decoding_frame_by_frame_is_decoding(trial: CodecTrial) -> None:
    """Decode latent frames that come one by one as they are decoded together, or refuse to."""
    try:
        decode = trial.codec.frame_decoder()
    except RecipeError:
        return
    latents = trial.encode(trial.clip(trial.full, batch=2))
    with torch.no_grad():
        frames = range(latents.shape[1])
        single = torch.cat([decode(latents[:, frame : frame + 1]) for frame in frames], 1)
        together = trial.codec.decode(latents)
    shapes = f"{list(single.shape)} and {list(together.shape)}"
    expect(single.shape == together.shape, f"one by one and together they decode to {shapes}")
    error = (single - together).abs().max().item()
    expect(error < TOLERANCE, f"pixels differ by {error:.2g} if latent frames come one by one")


def encoding_is_causal(trial: CodecTrial) -> None:
    """Encode a prefix of the video to the prefix of the latents."""
    video = trial.clip(trial.full)
    whole = trial.encode(video)
    for length in (1, 2):
        prefix = trial.encode(video[:, : trial.codec.video_frames(length)])
        error = (whole[:, :length] - prefix).abs().max().item()
        expect(
            error < TOLERANCE,
            f"the first {length} latent frames change by {error:.2g} when later frames are added",
        )


def clips_of_a_batch_are_independent(trial: CodecTrial) -> None:
    """Encode a clip alike whatever else is in the batch."""
    video = trial.clip(trial.full, batch=2)
    error = (trial.encode(video)[1:] - trial.encode(video[1:])).abs().max().item()
    expect(error < TOLERANCE, f"latents change by {error:.2g} with the rest of the batch")


def latents_are_normalised(trial: CodecTrial) -> None:
    """Give latents near zero mean and unit variance, to an order of magnitude.

    A synthetic scene is far from the data of a learned codec, so only a forgotten normalisation
    fails here.
    """
    latents = trial.encode(trial.clip(trial.full, batch=4))
    mean, spread = latents.mean().item(), latents.std().item()
    expect(
        abs(mean) < 3 and 0.1 < spread < 10,
        f"latents have mean {mean:.2g} and standard deviation {spread:.2g}, not about 0 and 1",
    )


def encoding_repeats_and_leaves_no_trace(trial: CodecTrial) -> None:
    """Encode the same clip to the same latents, without a change to the input or the weights."""
    video = trial.clip(trial.full)
    kept = video.clone()
    before = {name: value.clone() for name, value in trial.codec.state_dict().items()}
    first, second = trial.encode(video), trial.encode(video)
    expect(torch.equal(first, second), "the same clip encodes to other latents a second time")
    expect(torch.equal(video, kept), "encoding changes the video that it is given")
    for name, value in trial.codec.state_dict().items():
        expect(torch.equal(value, before[name]), f"encoding changes {name}")


def bad_video_is_refused(trial: CodecTrial) -> None:
    """Raise `ShapeError` for sides that do not divide, and for video without its batch axis."""
    stride, video = trial.codec.spatial_stride, trial.clip(trial.full)
    bad = [video[0], video[:, :, :2]]
    if stride > 1:
        bad.append(video[..., : video.shape[-1] - stride // 2])
    for wrong in bad:
        try:
            trial.encode(wrong)
        except ShapeError:
            continue
        raise CheckFailure(f"video of shape {list(wrong.shape)} is not refused")


def fingerprint_names_the_weights(trial: CodecTrial) -> None:
    """Return the same fingerprint for equal codecs, and another once a weight differs."""
    codec, twin = trial.codec, trial.make().eval()
    fingerprint = codec.fingerprint()
    expect(fingerprint and fingerprint == codec.fingerprint(), "its fingerprint is not stable")
    expect(twin.fingerprint() == fingerprint, "an equal codec has another fingerprint")
    weights = [p for p in twin.state_dict().values() if p.is_floating_point() and p.numel()]
    if weights:
        with torch.no_grad():
            largest = max(weights, key=torch.numel)
            largest[(0,) * largest.ndim] += 1
        expect(twin.fingerprint() != fingerprint, "a changed weight leaves the fingerprint alone")


CHECKS = (
    encodes_a_clip,
    latents_have_declared_shape,
    decoding_restores_the_shape,
    no_frame_is_lost,
    decoding_frame_by_frame_is_decoding,
    encoding_is_causal,
    clips_of_a_batch_are_independent,
    latents_are_normalised,
    encoding_repeats_and_leaves_no_trace,
    bad_video_is_refused,
    fingerprint_names_the_weights,
)
