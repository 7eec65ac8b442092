"""Checks of a conditioner: what models require of it."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from acwm_core.checks.result import NotTried, Suite, expect, expect_equal, expect_is_a
from acwm_core.checks.trial import batch_error, noise, shaken, without_gradient
from acwm_core.model.conditioner import Conditioner, Conditioning

FIT = {"action_size": 3, "temporal_stride": 4, "width": 16, "layers": 2, "heads": 2}
"""Sizes of the environment, codec and model for which conditioners are built here."""

WIDTHS = 16, 24
"""Widths after the two layers of a model whose layers are not equally wide."""

STRIDE, TOKENS, WIDTH = FIT["temporal_stride"], 5, FIT["width"]

FAINT = 1e-5
"""Largest difference between effects that count as equal; effects have a size of about 1."""


class ConditionerChecks(Suite):
    """Checks of an `acwm_core.model.conditioner.Conditioner` by its effect on random tokens.

    Weights are perturbed first: gates that start closed would hide the actions.
    """

    kind = "conditioner"

    @functools.cached_property
    def _conditioner(self) -> Conditioner:
        return shaken(self.make(**FIT)).eval()

    def _actions(self, latent_frames: int = 4, batch: int = 1) -> Tensor:
        """Random actions in [-1, 1] for this many latent frames, `[B, T, A]`."""
        rows = 1 + (latent_frames - 1) * STRIDE
        generator = torch.Generator().manual_seed(latent_frames)
        return torch.rand(batch, rows, FIT["action_size"], generator=generator) * 2 - 1

    def _effect(self, actions: Tensor) -> Tensor:
        """The effect on a model: tokens `[B, L, N, D]` after the last layer, plus modulation."""
        conditioning = self._conditioner(actions)
        frames = 1 + (actions.shape[1] - 1) // STRIDE
        tokens = noise((1, 1, TOKENS, WIDTH), seed=1).expand(len(actions), frames, -1, -1)
        tokens = conditioning.inject_input(tokens)
        for layer in range(FIT["layers"]):
            tokens = conditioning.inject(layer, tokens)
        if conditioning.modulation is not None:
            tokens = tokens + conditioning.modulation.unsqueeze(2)
        return tokens

    def _responses(self) -> Iterator[tuple[int, list[float]]]:
        actions = self._actions()
        usual = self._effect(actions)
        for row in range(actions.shape[1]):
            other = actions.clone()
            other[:, row] = -other[:, row]
            change = (self._effect(other) - usual)[0].detach().abs()
            yield row, [float(frame.max()) for frame in change]

    def embeds_actions(self) -> None:
        """Construct the conditioner and embed actions as modulation, context or both."""
        expect_is_a(self._conditioner, Conditioner)
        conditioning = self._conditioner(self._actions())
        expect_is_a(conditioning, Conditioning)
        named = conditioning.conditioner is self._conditioner
        expect(named, "the Conditioning names another conditioner")
        empty = conditioning.modulation is None and conditioning.context is None
        expect(not empty, "it returns neither modulation nor context")

    def shapes_follow_the_length(self) -> None:
        """Give one entry per latent frame, with the model's width, for any length."""
        for batch, frames in ((1, 1), (2, 2), (1, 5)):
            conditioning = self._conditioner(self._actions(frames, batch))
            modulation, context = conditioning.modulation, conditioning.context
            if modulation is not None:
                expect_equal("modulation is", [*modulation.shape], [batch, frames, WIDTH])
            if context is not None:
                fits = context.ndim == 4 and context.shape[:2] == (batch, frames)
                expect(fits, f"context is {list(context.shape)}, not [B, L, K, D]")

    def tokens_keep_their_shape(self) -> None:
        """Return finite tokens of unchanged shape at the input and after every layer."""
        effect = self._effect(self._actions(batch=2))
        expect_equal("tokens come back", [*effect.shape], [2, 4, TOKENS, WIDTH])
        expect(effect.isfinite().all(), "the effect on the tokens is not finite")

    def fits_layers_of_different_widths(self) -> None:
        """With an `inject`, take `widths` and keep the shape of tokens that are so wide."""
        if type(self._conditioner).inject is Conditioner.inject:
            raise NotTried("it does not act after layers")
        conditioning = self.make(**FIT, widths=WIDTHS)(self._actions())
        for layer, width in enumerate(WIDTHS):
            tokens = noise((1, 4, TOKENS, width), seed=1)
            injected = conditioning.inject(layer, tokens)
            expect_equal("tokens come back", [*injected.shape], [*tokens.shape])

    def every_action_counts(self) -> None:
        """Let each action that leads to a frame change something."""
        for row, changes in [*self._responses()][:-1]:
            expect(max(changes) > FAINT, f"action {row} has no effect")

    def later_actions_have_no_effect(self) -> None:
        """Let no latent frame depend on actions that start at or after its end."""
        for row, changes in self._responses():
            for frame, change in enumerate(changes):
                end = frame * STRIDE
                what = f"latent frame {frame} ends at video frame {end}, but action {row}, which "
                expect(change < FAINT or row < end, f"{what}acts later, changes it")

    def recent_actions_suffice_if_it_says_so(self) -> None:
        """With a `history`, embed a latent frame the same way without any earlier actions."""
        history = self._conditioner.history
        if history is None:
            raise NotTried("it does not declare its `history`")
        expect_is_a(history, int)
        steps = max(1, history) + 1  # a stream keeps these, for its last two latent frames
        actions = self._actions(latent_frames=steps + 3)
        whole, recent = self._effect(actions), self._effect(actions[:, -1 - steps * STRIDE :])
        error = batch_error(whole[:, -2:], recent[:, -2:])
        what = f"without the actions before its {history} latent steps"
        expect(error < FAINT, f"the effect changes by {error:.2g} {what}")

    def clips_of_a_batch_are_independent(self) -> None:
        """Embed a clip the same way whatever else is in the batch."""
        actions = self._actions(batch=2)
        error = batch_error(self._effect(actions)[1:], self._effect(actions[1:]))
        expect(error < 1e-4, f"the effect changes by {error:.2g} with the rest of the batch")

    def gradient_reaches_every_parameter(self) -> None:
        """Give every parameter a gradient."""
        left_out = without_gradient(self._conditioner, self._effect(self._actions(batch=2)))
        expect(not left_out, f"no gradient reaches {', '.join(left_out[:3])}")
