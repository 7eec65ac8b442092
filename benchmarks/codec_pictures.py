"""Pictures of what a codec loses: frames, their reconstruction, and the difference."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

MOMENTS = 4
MAGNIFIED = 5
"""Factor by which differences are amplified, around grey."""


def picture(video: Tensor, reconstruction: Tensor) -> NDArray[np.uint8]:
    """Three rows of frames, ``[H, W, 3]`` uint8, from two videos ``[T, 3, h, w]`` in [0, 1].

    Small frames are enlarged by repeating pixels.
    """
    moments = torch.linspace(0, len(video) - 1, MOMENTS).round().long()
    truth, made = video[moments], reconstruction[moments]
    difference = 0.5 + MAGNIFIED * (made - truth)
    rows = [torch.cat(list(frames), dim=2) for frames in (truth, made, difference)]
    sheet = torch.cat(rows, dim=1).clamp(0, 1).permute(1, 2, 0)
    times = max(1, 240 // video.shape[-2])
    sheet = sheet.repeat_interleave(times, 0).repeat_interleave(times, 1)
    return (255 * sheet).round().byte().numpy()
