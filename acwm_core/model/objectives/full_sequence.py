"""Flow matching of whole clips, as in the paper."""

from __future__ import annotations

import torch
from torch import Tensor

from acwm_core.model.objectives.flow import TRAINING_POINTS, FlowMatching


class FullSequence(FlowMatching):
    """Flow matching with one noise level per clip: all frames are denoised together.

    The model may look both ways in time. It never sees a clean past beside noise, apart from the
    given frames, and so cannot be streamed.
    """

    def draw(self, frames: int, generator: torch.Generator) -> Tensor:
        """Draw one point of the schedule for all frames."""
        return torch.randint(TRAINING_POINTS, (1,), generator=generator).expand(frames)
