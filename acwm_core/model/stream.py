"""`Stream`: predicts video latent frame by latent frame, as actions arrive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import torch

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.codec import Codec
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import DynamicsModel, Keypoints
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.shapes import Actions, Latent, Video, float32_by_default


class Streamed(Protocol):
    """What a stream asks of a `WorldModel`, whose attributes these are."""

    @property
    def codec(self) -> Codec: ...  # noqa: D102
    @property
    def model(self) -> DynamicsModel: ...  # noqa: D102
    @property
    def conditioner(self) -> Conditioner: ...  # noqa: D102
    @property
    def objective(self) -> Objective[Any]: ...  # noqa: D102
    def normalise(self, actions: Actions) -> Actions: ...  # noqa: D102
    def checked(self, actions: Actions) -> Actions: ...  # noqa: D102


def continued(actions: Actions, rows: int) -> Actions:
    """`actions` `[B, T, A]` with the last one repeated for `rows` more rows."""
    return torch.cat([actions, actions[:, -1:].expand(-1, rows, -1)], dim=1)


class Stream:
    """A running rollout: each step takes the actions of one latent frame and returns its frames.

    The model caches what it computed for earlier frames, so a step takes the same time and memory
    however long the video is.

    Args:
        world: the world model, whose dynamics model is causal.
        given: the first K frames, `[B, K, 3, H, W]` in [0, 1]; they form whole latent frames.
        actions: raw actions between them, `[B, K − 1, A]`.
        steps: network evaluations per latent frame; the model's default if None.
        context: number of latent frames that a frame sees, including itself; at least 2.
        generators: generators of the noise, one per batch element, on the CPU.

    Attributes:
        given: the codec's reconstruction of the given frames, `[B, K, 3, H, W]`.
        first: the reconstruction of the first frame, `[B, 3, H, W]`.
    """

    def __init__(
        self,
        world: Streamed,
        given: Video,
        actions: Actions,
        *,
        steps: int | None,
        context: int,
        generators: Sequence[torch.Generator],
    ) -> None:
        self._world = world
        stride, frames = world.codec.temporal_stride, given.shape[1]
        if list(actions.shape[:2]) != [len(given), frames - 1]:
            raise ShapeError(
                f"between {frames} frames there are actions {[len(given), frames - 1, 'A']}, not "
                f"{list(actions.shape)}"
            )
        between = torch.split(world.normalise(actions), stride, 1)
        self._recent = [*between] if frames > 1 else []
        with torch.no_grad():
            latents = world.codec.encode(given)
            self._latents = world.objective.stream(
                world.model, latents, generators, steps=steps, context=context
            )
            self._decode = world.codec.with_reference(given[:, -1]).frame_decoder()
            self.given = self._decode(latents)
        self.first, self._untold = self.given[:, 0], latents.shape[1]
        if world.conditioner.history is None:
            raise RecipeError(
                f"{type(world.conditioner).__name__} embeds all actions since the start (its "
                "history is None), so it cannot be streamed"
            )

    @torch.no_grad()
    @float32_by_default()
    def step(self, actions: Actions) -> Video:
        """Predict the frames that the actions of one latent step lead to.

        Args:
            actions: raw actions `[B, temporal_stride, A]`; the first acts on the last frame so far.

        Returns:
            `[B, temporal_stride, 3, H, W]` in [0, 1].

        Raises:
            ShapeError: the number of actions or of batch elements is wrong.
            ShapeError: actions have the wrong size, are not finite, or out of bounds.
        """
        return self._decode(self._advance(actions, check=True))

    @torch.no_grad()
    def play(self, actions: Actions, together: int = 1, *, check: bool = True) -> Iterator[Video]:
        """Step through actions `[B, T, A]`; each leads to one more frame.

        If they do not fill the last latent step, the last action is repeated and the extra frames
        are dropped.

        Args:
            actions: raw actions.
            together: number of latent frames to decode at once, which is faster than one by one.
            check: whether to refuse actions out of their bounds.

        Yields:
            The T frames, up to `together` · `temporal_stride` at a time.
        """
        stride = self._world.codec.temporal_stride
        if actions.ndim != 3:
            raise ShapeError(f"actions are [B, T, A], not {list(actions.shape)}")
        for start in range(0, actions.shape[1], together * stride):
            rows = actions[:, start : start + together * stride]
            filled = continued(rows, -rows.shape[1] % stride)
            latents = [self._advance(step, check) for step in torch.split(filled, stride, 1)]
            yield self._decode(torch.cat(latents, 1))[:, : rows.shape[1]]

    def keypoints(self) -> Keypoints | None:
        """The things that can be moved, as they are in the last frame; None if none can be."""
        with torch.inference_mode():
            return self._latents.keypoints()

    def move_keypoint(self, number: int, place: Sequence[float]) -> None:
        """Move a thing that the model sees, such as a learnt point; the next frame shows it there.

        Args:
            number: of the keypoint in `keypoints`.
            place: right and down, each from -1 to 1 in the picture.

        Raises:
            RecipeError: there is no such thing, or the place is outside the picture.
        """
        keypoints = self.keypoints()
        count = 0 if keypoints is None else keypoints.values.shape[2]
        if not 0 <= number < count:
            raise RecipeError(
                f"this model has {count} things to move, numbered from 0: there is no {number}"
            )
        if len(place) != 2 or not all(-1 <= part <= 1 for part in place):
            raise RecipeError(f"a place is two numbers from -1 to 1, not {list(place)}")
        with torch.inference_mode():
            self._latents.move_keypoint(number, torch.tensor(place, device=self.given.device))

    def _advance(self, actions: Actions, check: bool) -> Latent:
        """Predict the latent frame that the actions of one latent step lead to."""
        wanted = [len(self.given), self._world.codec.temporal_stride]
        if actions.ndim != 3 or list(actions.shape[:2]) != wanted:
            raise ShapeError(f"a step takes actions {[*wanted, 'A']}, not {list(actions.shape)}")
        actions = self._world.normalise(self._world.checked(actions) if check else actions)
        # Latents do not leave this class, so the faster mode is safe; frames are ordinary tensors.
        with torch.inference_mode():
            return self._latents.advance(self._embed(actions))

    def _embed(self, actions: Actions) -> Conditioning:
        """Embed the actions of the last latent frame (at first, of all given ones) and the next.

        The last frame is embedded again, as a conditioner may look one step ahead. As in clips, the
        actions end with a row of zeros, which leads to no frame.
        """
        history = self._world.conditioner.history
        assert history is not None
        # One step more than both depend on, because the first latent frame of a clip is special.
        self._recent = [*self._recent, actions][-max(history, 1) - self._untold :]
        end = self._world.normalise(torch.zeros_like(actions[:, :1]))
        known, wanted = len(self._recent) + 1, self._untold + 1
        self._untold = 1
        rows, width = torch.cat([*self._recent, end], 1), self._world.model.width
        embedded = self._world.conditioner.condition(rows, known, width)
        return embedded.frames(known - wanted, known)
