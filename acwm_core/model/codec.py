"""The `Codec` interface: encodes video to normalised latents, and decodes them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import nn

from acwm_core.errors import RecipeError, ShapeError, check_shape
from acwm_core.model.shapes import Frame, Latent, Video

FrameDecoder = Callable[[Latent], Video]
"""Maps the next latent frames `[B, k, C, h, w]` to their video frames."""


class Codec(nn.Module, ABC):
    """A video autoencoder between `Video` in [0, 1] and `Latent` of zero mean and unit variance.

    The codec applies the latent statistics itself, so callers never rescale latents. Latent frame 0
    encodes only video frame 0; each further one encodes `temporal_stride` video frames. Codecs are
    causal in time: the encoding of a prefix is the prefix of the encoding.

    Attributes:
        channels: latent channels C.
        spatial_stride: H / h = W / w.
        temporal_stride: video frames per latent frame after the first.
        memoryless: whether each latent frame depends only on its own video frames, so that
            overlapping clips share latents and need not be encoded separately.
        encodes_in_bfloat16: whether latents for training are equally good if they are computed in
            bfloat16, on a CPU that has it.
    """

    channels: int
    spatial_stride: int
    temporal_stride: int
    memoryless: bool = False
    encodes_in_bfloat16: bool = False

    @abstractmethod
    def _encode(self, video: Video) -> Latent:
        """Encode a video of 1 + k · temporal_stride frames whose sides `spatial_stride` divides."""

    @abstractmethod
    def _decode(self, latents: Latent) -> Video:
        """Decode to 1 + (L − 1) · temporal_stride frames; values may leave [0, 1] slightly."""

    @abstractmethod
    def fingerprint(self) -> str:
        """A short hash of configuration and weights, of encoder and decoder."""

    def latents_fingerprint(self) -> str:
        """Names the latents: equal for codecs with equal latents, so that models fit them all.

        That of all weights, unless a codec knows that it shares its latents with another.
        """
        return self.fingerprint()

    def encode(self, video: Video) -> Latent:
        """Encode `[B, T, 3, H, W]` to `[B, L, C, h, w]`, L = `latent_frames(T)`.

        If the video does not fill the last latent frame, its last frame is repeated;
        `decode(…, frames=T)` cuts the repeats off again. No frame is ever dropped.

        Raises:
            ShapeError: not five axes, not three colour channels, or a height or width that is not
                a multiple of `spatial_stride`.
        """
        self._check_video(video)
        frames = video.shape[1]
        missing = self.video_frames(self.latent_frames(frames)) - frames
        if missing:
            video = torch.cat([video, video[:, -1:].expand(-1, missing, -1, -1, -1)], dim=1)
        length, size = self.latent_frames(frames), self.latent_size(*video.shape[3:])
        latents = self._encode(video)
        check_shape(self, "_encode", latents, len(video), length, self.channels, *size)
        return latents.float()

    def decode(self, latents: Latent, frames: int | None = None) -> Video:
        """Decode `[B, L, C, h, w]` to video in [0, 1], cut to `frames` if given.

        Raises:
            ShapeError: wrong number of axes or channels, or fewer frames than asked for.
        """
        self._check_latents(latents)
        decodable = self.video_frames(latents.shape[1])
        if frames is not None and not 1 <= frames <= decodable:
            raise ShapeError(
                f"{latents.shape[1]} latent frames decode to {decodable} frames, not {frames}"
            )
        sides = [side * self.spatial_stride for side in latents.shape[3:]]
        video = self._decode(latents)
        check_shape(self, "_decode", video, len(latents), decodable, 3, *sides)
        return video[:, :frames].float().clamp(0, 1)

    def with_reference(self, frame: Frame) -> Codec:
        """This codec, as it decodes what follows a known frame `[B, 3, H, W]` in [0, 1].

        A model predicts what follows frames that it was given, so a decoder may take from the last
        of them what does not move. Such a codec overrides this method. Most codecs decode latents
        alone, and return themselves.

        Args:
            frame: one per video to decode, or one for all.
        """
        return self

    def latent_frames(self, frames: int) -> int:
        """Number L of latent frames that encode `frames` video frames."""
        return 1 + -(-(frames - 1) // self.temporal_stride)

    def video_frames(self, latent_frames: int) -> int:
        """Number of video frames that `latent_frames` latent frames decode to."""
        return 1 + (latent_frames - 1) * self.temporal_stride

    def latent_size(self, height: int, width: int) -> tuple[int, int]:
        """``(h, w)`` of the latents of an H × W video."""
        return height // self.spatial_stride, width // self.spatial_stride

    def forward(self, video: Video) -> Video:
        """Encode and decode a video: its reconstruction, of the same length.

        It is decoded as a rollout from its first frame is: with that frame as the reference.
        """
        latents = self.encode(video)
        return self.with_reference(video[:, 0]).decode(latents, frames=video.shape[1])

    def frame_decoder(self) -> FrameDecoder:
        """Return a decoder that takes the latent frames of a video one by one, in constant memory.

        The decoder takes latent frames `[B, k, C, h, w]` in order, any number per call, and returns
        their video frames in [0, 1]: one for the very first latent frame, `temporal_stride` for
        every further one. Together they equal the result of `decode`. Each call of this method
        starts a new video; several decoders may be in use at once.

        Raises:
            RecipeError: this codec only decodes whole videos.
        """
        decode = self._frame_decoder()

        def checked(latents: Latent) -> Video:
            self._check_latents(latents)
            return decode(latents).float().clamp(0, 1)

        return checked

    def _frame_decoder(self) -> FrameDecoder:
        """As `frame_decoder`, but unchecked; a codec that is not memoryless must override it."""
        if not self.memoryless:
            raise RecipeError(
                f"{type(self).__name__} decodes whole videos only, not frame by frame"
            )
        started = False

        def decode(latents: Latent) -> Video:
            nonlocal started
            first, started = not started, True
            return self._decode(latents) if first else self._decode_later(latents)

        return decode

    def _decode_later(self, latents: Latent) -> Video:
        """Decode latent frames other than a video's first; for memoryless codecs only."""
        if self.temporal_stride == 1:
            return self._decode(latents)
        return self._decode(torch.cat([latents[:, :1], latents], dim=1))[:, 1:]

    def _check_latents(self, latents: Latent) -> None:
        if latents.ndim != 5 or latents.shape[2] != self.channels:
            raise ShapeError(
                f"{type(self).__name__} decodes [B, L, {self.channels}, h, w], "
                f"not {list(latents.shape)}"
            )

    def _check_video(self, video: Video) -> None:
        shape = list(video.shape)
        if video.ndim != 5 or shape[2] != 3 or shape[1] < 1:
            raise ShapeError(f"a codec encodes video [B, T, 3, H, W], not {shape}")
        if not video.is_floating_point():
            raise ShapeError(f"a codec encodes floats in [0, 1], not {video.dtype}: divide by 255")
        if shape[3] % self.spatial_stride or shape[4] % self.spatial_stride:
            raise ShapeError(
                f"{type(self).__name__} needs frame sides that are multiples of "
                f"{self.spatial_stride}, not {shape[3]}×{shape[4]}"
            )
