"""`compact_per_frame` is `compact` on clips of one frame."""

import torch

from acwm_codecs.compact import Compact
from acwm_codecs.compact_per_frame import CompactPerFrame
from acwm_core.checks.trial import moving_discs


@torch.no_grad()
def test_every_frame_is_a_clip_of_its_own():
    video, compact, per_frame = moving_discs(2, 5, 32, 48), Compact(), CompactPerFrame()
    latents = per_frame.encode(video)
    assert latents.shape == (2, 5, 16, 4, 6)
    decoded = per_frame.decode(latents)
    for frame in range(5):
        alone = compact.encode(video[:, frame : frame + 1])
        torch.testing.assert_close(latents[:, frame : frame + 1], alone)
        torch.testing.assert_close(decoded[:, frame : frame + 1], compact.decode(alone))


def test_its_latents_are_never_taken_for_compacts():
    assert CompactPerFrame().fingerprint() != Compact().fingerprint()
    assert CompactPerFrame().fingerprint() == CompactPerFrame().fingerprint()
