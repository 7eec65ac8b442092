"""Checks of a codec: what latent caches, models and rollouts require of it."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from acwm_core.checks.result import NotTried, Suite, expect, expect_equal, expect_is_a
from acwm_core.checks.trial import moving_discs
from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.codec import Codec
from acwm_core.model.shapes import Video


class CodecChecks(Suite):
    """Checks of an `acwm_core.model.codec.Codec` in evaluation mode, without gradients."""

    kind = "codec"

    @functools.cached_property
    def _codec(self) -> Codec:
        return self.make().eval().requires_grad_(False)

    @property
    def _full(self) -> int:
        return self._codec.video_frames(3)

    def _clip(self, frames: int | None = None, batch: int = 1) -> Video:
        """A clip about 48 pixels high and wider than high, in a size that the codec accepts."""
        stride = self._codec.spatial_stride
        rows = max(4, 48 // stride)
        return moving_discs(batch, frames or self._full, rows * stride, (rows + 2) * stride)

    def encodes_a_clip(self) -> None:
        """Construct the codec and encode a clip to finite latents."""
        expect_is_a(self._codec, Codec)
        expect(self._codec.encode(self._clip()).isfinite().all(), "latents are not finite")

    def latents_have_declared_shape(self) -> None:
        """Match `channels`, `spatial_stride` and `temporal_stride` for every size and length."""
        for batch, frames in ((1, 1), (2, self._full), (1, self._codec.video_frames(2))):
            self._codec.encode(self._clip(frames, batch))  # raises on another shape

    def decoding_restores_the_shape(self) -> None:
        """Decode to video in [0, 1] with the length and size of the encoded video."""
        video = self._clip()
        decoded = self._codec(video)
        expect_equal("video comes back", [*decoded.shape], [*video.shape])
        expect(((decoded >= 0) & (decoded <= 1)).all(), "decoded video leaves [0, 1]")

    def no_frame_is_lost(self) -> None:
        """Accept any length, and let every frame influence the latents."""
        for frames in range(1, self._full + 1):
            video = self._clip(frames)
            latents = self._codec.encode(video)
            length = self._codec.decode(latents, frames).shape[1]
            expect_equal("frames come back as", length, frames)
            for frame in range(frames) if frames == self._full else [frames - 1]:
                changed = video.clone()
                changed[:, frame] = 1 - changed[:, frame]
                traceless = torch.equal(self._codec.encode(changed), latents)
                expect(not traceless, f"frame {frame} of {frames} leaves no trace in the latents")

    def decoding_frame_by_frame_is_decoding(self) -> None:
        """Decode latent frames one by one to the same video as together, or refuse to."""
        try:
            decode = self._codec.frame_decoder()
        except RecipeError as error:
            raise NotTried(str(error)) from None
        latents = self._codec.encode(self._clip(batch=2))
        single = torch.cat([decode(latents[:, i : i + 1]) for i in range(latents.shape[1])], 1)
        together = self._codec.decode(latents)
        expect_equal("one by one they decode to", [*single.shape], [*together.shape])
        _expect_same(single, together, "pixels differ by {} if latent frames come one by one")

    def a_reference_belongs_to_its_video(self) -> None:
        """Decode every video with its own reference, one by one too; latents do not depend on it.

        Only of a codec that decodes with a reference.
        """
        video = self._clip(batch=2)
        latents, codec = self._codec.encode(video), self._codec.with_reference(video[:, 0])
        if codec is self._codec:
            raise NotTried("it decodes latents alone")
        _expect_same(codec.encode(video), latents, "latents change by {} with a reference")
        together = codec.decode(latents)
        expect_equal("video comes back", [*together.shape], [*video.shape])
        alone = self._codec.with_reference(video[1:, 0]).decode(latents[1:])
        _expect_same(together[1:], alone, "pixels change by {} with the rest of the batch")
        shared = self._codec.with_reference(video[:1, 0]).decode(latents)
        _expect_same(together[:1], shared[:1], "pixels differ by {} if all share a reference")
        decode = codec.frame_decoder()
        single = torch.cat([decode(latents[:, i : i + 1]) for i in range(latents.shape[1])], 1)
        _expect_same(single, together, "pixels differ by {} if latent frames come one by one")

    def encoding_is_causal(self) -> None:
        """Encode a prefix of the video to the prefix of the latents."""
        codec, video = self._codec, self._clip()
        for length in (1, 2):
            alone = codec.encode(video[:, : codec.video_frames(length)])
            what = f"the first {length} latent frames change by {{}} when later frames are added"
            _expect_same(codec.encode(video)[:, :length], alone, what)

    def clips_of_a_batch_are_independent(self) -> None:
        """Encode a clip the same way whatever else is in the batch."""
        video = self._clip(batch=2)
        together, alone = self._codec.encode(video)[1:], self._codec.encode(video[1:])
        _expect_same(together, alone, "latents change by {} with the rest of the batch")

    def latents_are_normalised(self) -> None:
        """Give latents with roughly zero mean and unit variance, to an order of magnitude.

        The synthetic scene is far from the training data of a learned codec, so only a missing
        normalisation fails here.
        """
        latents = self._codec.encode(self._clip(batch=4))
        mean, spread = latents.mean().item(), latents.std().item()
        moments = f"latents have mean {mean:.2g} and standard deviation {spread:.2g}"
        expect(abs(mean) < 3 and 0.1 < spread < 10, f"{moments}, not about 0 and 1")

    def encoding_repeats_and_leaves_no_trace(self) -> None:
        """Encode the same clip to the same latents, without changing the input or weights."""
        video, kept = self._clip(), self._clip()
        before = {name: value.clone() for name, value in self._codec.state_dict().items()}
        same = torch.equal(self._codec.encode(video), self._codec.encode(video))
        expect(same, "encoding the same clip again gives other latents")
        expect(torch.equal(video, kept), "encoding changes its input video")
        for name, value in self._codec.state_dict().items():
            expect(torch.equal(value, before[name]), f"encoding changes {name}")

    def bad_video_is_refused(self) -> None:
        """Raise `ShapeError` for sizes not divisible by the stride, and for a missing axis."""
        stride, video = self._codec.spatial_stride, self._clip()
        bad = [video[0], video[:, :, :2]]
        if stride > 1:
            bad.append(video[..., : video.shape[-1] - stride // 2])
        for wrong in bad:
            try:
                self._codec.encode(wrong)
            except ShapeError:
                continue
            expect(False, f"video of shape {list(wrong.shape)} is not refused")

    def fingerprint_names_the_weights(self) -> None:
        """Return the same fingerprint for equal codecs, and another once a weight differs."""
        codec, equal = self._codec, self.make().eval()
        fingerprint = codec.fingerprint()
        expect(fingerprint and fingerprint == codec.fingerprint(), "its fingerprint is not stable")
        expect(equal.fingerprint() == fingerprint, "an equal codec has another fingerprint")
        weights = [p for p in equal.state_dict().values() if p.is_floating_point() and p.numel()]
        if weights:
            largest = max(weights, key=torch.numel)
            largest[(0,) * largest.ndim] += 1
            same = equal.fingerprint() == fingerprint
            expect(not same, "a changed weight leaves the fingerprint alone")


def _expect_same(first: Tensor, second: Tensor, reason: str) -> None:
    error = (first - second).abs().max().item()  # latents have a spread of about 1
    expect(error < 2e-3, reason.format(f"{error:.2g}"))
