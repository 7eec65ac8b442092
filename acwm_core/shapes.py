"""Names of tensor shapes, used in every signature that takes or gives tensors.

Axes: B batch, T video frames, H W pixels, L latent frames, C latent channels, h w latent pixels,
A action dimensions, N tokens of one latent frame, D model width.

Conventions: video is float in [0, 1] at every public boundary. ``actions[:, i]`` takes frame i to
frame i + 1, so T frames have T rows and the last row is zero. ``sigma`` is the noise level of a
latent frame: 0 is clean, 1 is noise.
"""

from jaxtyping import Float
from torch import Tensor

Video = Float[Tensor, "B T 3 H W"]
"""Video in [0, 1]."""

Clip = Float[Tensor, "T 3 H W"]
"""One video in [0, 1], without the batch axis."""

Frame = Float[Tensor, "B 3 H W"]
"""One frame per batch element, in [0, 1]."""

Latent = Float[Tensor, "B L C h w"]
"""Codec output with zero mean and unit variance per channel."""

Actions = Float[Tensor, "B T A"]
"""Raw actions in the units that the environment card names."""

Sigmas = Float[Tensor, "B L"]
"""Noise level per latent frame, in [0, 1]."""

Tokens = Float[Tensor, "B L N D"]
"""Patch tokens of each latent frame."""

Modulation = Float[Tensor, "B L D"]
"""One conditioning vector per latent frame."""
