"""The ACWM diffusion transformer."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Cache, Denoiser, InputKind
from acwm_core.model.shapes import Latent, Modulation, Sigmas
from acwm_dit.attention import spatial_rotation, temporal_rotation
from acwm_dit.blocks import FinalLayer, Layer
from acwm_dit.cache import TemporalCache
from acwm_dit.linear import Linear

FREQUENCIES = 256
"""Sinusoids of the timestep embedding."""

TIMESTEPS = 1000
"""Noise level 1 is timestep 1000, the scale on which the published weights were trained."""


class DiT(Denoiser):
    """The video diffusion transformer of ACWM-Phys (arXiv 2605.08567), in any size.

    Latents are cut into patches. Each layer attends over the patches of every frame, then over the
    frames at every patch position. Positions are rotary, so any length and frame size works. The
    timestep of each latent frame, plus the conditioner's modulation if it gives one, modulates
    every sub-block (AdaLN-Zero). An untrained model returns zeros.

    Args:
        latent_channels: channels C of the codec.
        width: token width D.
        layers: number of layers, each with a spatial and a temporal sub-block.
        heads: attention heads; the width per head must be a multiple of 4.
        patch_size: side of a patch in latent pixels.
        causal: whether a latent frame sees only itself and earlier ones. With None, the recipe's
            objective decides; outside of a recipe the model is then not causal.
        inputs: further latents, whose patches are added to those of the noisy ones, and levels,
            which are embedded like the noise level. None works as for `causal`.

    Raises:
        RecipeError: a size below 1, or heads that do not divide the width into multiples of 4.
    """

    def __init__(
        self,
        *,
        latent_channels: int,
        width: int = 128,
        layers: int = 3,
        heads: int = 2,
        patch_size: int = 2,
        causal: bool | None = None,
        inputs: Mapping[str, InputKind] | None = None,
    ) -> None:
        super().__init__()
        if min(width, layers, heads, patch_size) < 1:
            raise RecipeError("width, layers, heads and patch_size of a DiT must be at least 1")
        if width % heads or width // heads % 4:
            raise RecipeError(
                f"width {width} over {heads} heads leaves {width / heads:g} channels per head; "
                "it must be a multiple of 4"
            )
        self.latent_channels = latent_channels
        self.width = width
        self.layers = layers
        self.heads = heads
        self.patch_size = patch_size
        self.causal = bool(causal)
        self.inputs = dict(inputs or {})
        patch_values = latent_channels * patch_size**2
        self.patch_embedding = Linear(patch_values, width)
        self.timestep_embedding = _embedding(width)
        for name, kind in self.inputs.items():
            embedding = Linear(patch_values, width) if kind == "latent" else _embedding(width)
            self.add_module(_module_of(name), embedding)
        self.blocks = nn.ModuleList(Layer(width, heads, causal=self.causal) for _ in range(layers))
        self.final = FinalLayer(width, patch_values)
        self._initialise()

    def forward(
        self, latents: Latent, sigma: Sigmas, conditioning: Conditioning, **inputs: Tensor
    ) -> Latent:
        """Evaluate the model; see `Denoiser.forward`."""
        return self._evaluate(latents, sigma, conditioning, inputs, None)

    def new_cache(self, context: int) -> Cache:
        """A cache of the keys and values of temporal attention; see `Denoiser.new_cache`.

        Raises:
            RecipeError: the model is not causal, or the context is below 2.
        """
        if not self.causal:
            raise RecipeError("only a DiT with causal=true can be evaluated frame by frame")
        return TemporalCache(self.layers, context)

    def extend(
        self,
        latents: Latent,
        sigma: Sigmas,
        conditioning: Conditioning,
        cache: Cache,
        **inputs: Tensor,
    ) -> Latent:
        """Evaluate the frames that follow those in `cache`; see `Denoiser.extend`."""
        assert isinstance(cache, TemporalCache)
        cache.expect(latents.shape[1], latents.device)
        return self._evaluate(latents, sigma, conditioning, inputs, cache)

    def _evaluate(
        self,
        latents: Latent,
        sigma: Sigmas,
        conditioning: Conditioning,
        inputs: Mapping[str, Tensor],
        cache: TemporalCache | None,
    ) -> Latent:
        self._check(latents, sigma)
        frames, rows, columns = self._grid(latents)
        size, device = self.width // self.heads, latents.device
        space = spatial_rotation(rows, columns, size, device)
        time = temporal_rotation(frames, size, device, cache.frames if cache else 0)
        condition = self._condition(sigma, conditioning, inputs, latents.dtype)
        # Under autocast the projection is bfloat16, but the residual stream stays in float32.
        tokens = self.patch_embedding(self._fold(latents)).to(latents.dtype)
        for name in self._named("latent"):
            tokens = tokens + self.get_submodule(_module_of(name))(self._fold(inputs[name]))
        tokens = conditioning.inject_input(tokens)
        for index, block in enumerate(self.blocks):
            past = cache.layers[index] if cache else None
            tokens = block(tokens, condition, space, time, past)
            tokens = conditioning.inject(index, tokens)
        return self._unfold(self.final(tokens, condition), rows, columns).to(latents.dtype)

    def _condition(
        self,
        sigma: Sigmas,
        conditioning: Conditioning,
        inputs: Mapping[str, Tensor],
        dtype: torch.dtype,
    ) -> Modulation:
        """The condition of all blocks, `[B, L, D]`, with its SiLU already applied."""
        embedding = self.timestep_embedding(sinusoids(sigma * TIMESTEPS).to(dtype))
        if conditioning.modulation is not None:
            embedding = embedding + conditioning.modulation
        for name in self._named("level"):
            level = sinusoids(inputs[name] * TIMESTEPS).to(dtype)
            embedding = embedding + self.get_submodule(_module_of(name))(level)
        return nn.functional.silu(embedding)

    def _named(self, kind: InputKind) -> list[str]:
        return [name for name, each in self.inputs.items() if each == kind]

    def _grid(self, latents: Latent) -> tuple[int, int, int]:
        _, frames, _, height, width = latents.shape
        return frames, height // self.patch_size, width // self.patch_size

    def _fold(self, latents: Latent) -> Tensor:
        """Cut `[B, L, C, h, w]` into patches `[B, L, N, C·p·p]`, row by row, channels slowest."""
        p = self.patch_size
        patches = latents.unflatten(-1, (-1, p)).unflatten(-3, (-1, p))  # B L C rows p columns p
        return patches.permute(0, 1, 3, 5, 2, 4, 6).flatten(4).flatten(2, 3)

    def _unfold(self, patches: Tensor, rows: int, columns: int) -> Latent:
        """Join patches `[B, L, N, p·p·C]`, channels fastest, to `[B, L, C, h, w]`."""
        p = self.patch_size
        grid = patches.unflatten(-1, (p, p, -1)).unflatten(2, (rows, columns))  # B L r c p p C
        return grid.permute(0, 1, 6, 2, 4, 3, 5).flatten(5).flatten(3, 4)

    def _check(self, latents: Latent, sigma: Sigmas) -> None:
        shape = list(latents.shape)
        if latents.ndim != 5 or shape[2] != self.latent_channels:
            raise ShapeError(f"DiT takes latents [B, L, {self.latent_channels}, h, w], not {shape}")
        if shape[3] % self.patch_size or shape[4] % self.patch_size:
            raise ShapeError(
                f"DiT cuts latents into patches of {self.patch_size}, which {shape[3]}×{shape[4]} "
                "does not divide into; choose another frame size or patch_size=1"
            )
        if list(sigma.shape) != shape[:2]:
            raise ShapeError(f"sigma must be [B, L] = {shape[:2]}, not {list(sigma.shape)}")

    def _initialise(self) -> None:
        """Initialise as DiT does: every block starts as the identity, and the output is zero."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        levels = tuple(f"{_module_of(name)}." for name in ["sigma", *self._named("level")])
        for name, parameter in self.named_parameters():
            if name.startswith(levels) and name.endswith(".weight"):
                nn.init.normal_(parameter, std=0.02)
            elif "modulation." in name or name.startswith("final."):
                nn.init.zeros_(parameter)


def _module_of(name: str) -> str:
    """The module that embeds an input; the published weights call a noise level a timestep."""
    return f"{name.replace('sigma', 'timestep')}_embedding"


def _embedding(width: int) -> nn.Sequential:
    return nn.Sequential(Linear(FREQUENCIES, width), nn.SiLU(), Linear(width, width))


def sinusoids(timesteps: Tensor) -> Tensor:
    """Embed timesteps `[…]` as cosines, then sines, `[…, FREQUENCIES]`, periods 2π … 2π·10⁴."""
    half = FREQUENCIES // 2
    indices = torch.arange(half, device=timesteps.device, dtype=torch.float32)
    angles = timesteps[..., None].float() * torch.exp(-math.log(10_000) * indices / half)
    return torch.cat([angles.cos(), angles.sin()], -1)
