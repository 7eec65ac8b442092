"""A codec that computes in a moment, for tests of latents; importable by other processes."""

import torch

from acwm_core.model.codec import Codec


class Blocks(Codec):
    """Means over 8×8 blocks and groups of frames; optionally with a memory of all frames before."""

    channels, spatial_stride = 3, 8

    def __init__(self, temporal_stride=4, *, remembers=False, gain=1.0):
        super().__init__()
        self.temporal_stride, self.memoryless, self.gain = temporal_stride, not remembers, gain
        self.remembers, self.encoded = remembers, 0

    def _encode(self, video):
        self.encoded += video.shape[0] * video.shape[1]
        first = video[:, :1].expand(-1, self.temporal_stride, -1, -1, -1)
        groups = (
            torch.cat([first, video[:, 1:]], 1).unflatten(1, (-1, self.temporal_stride)).mean(2)
        )
        small = torch.nn.functional.avg_pool2d(groups.flatten(0, 1), 8).unflatten(
            0, groups.shape[:2]
        )
        return self.gain * (small.cumsum(1) if self.remembers else small)

    def _decode(self, latents):
        raise NotImplementedError

    def fingerprint(self):
        return f"blocks-{self.temporal_stride}-{self.remembers}-{self.gain}"
