"""Parameters of evaluation. Does not import torch, so that recipes are checked quickly."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge

from acwm_core.env.episode import SPLITS
from acwm_core.errors import RecipeError, suggest
from acwm_core.evaluation.protocol import protocol_named
from acwm_core.recipe.metrics import metric_configs
from acwm_core.recipe.types import NonNegativeInt, PositiveInt

Several = Annotated[int, Ge(2)]


@dataclass(frozen=True)
class EvaluationConfig:
    """The recipe's section `evaluation`: which clips are predicted and what is measured.

    Attributes:
        protocol: which clips of which episodes are predicted. ``full`` takes all episodes from the
            first frame to the last. Plugins provide others, which may set their own defaults for
            settings that are None.
        metrics: registered names, or dotted names of classes of a registered library, or mappings
            ``{name: lpips, as: lpips_vgg, network: vgg}`` with parameters and a name of its own,
            so that one metric can be measured in several ways. The metric of lowest rank, or else
            the first, ranks the clips. Metrics that cannot be measured on the environment are left
            out. At least one is required; ``base.yaml`` lists the usual ones.
        metric_options: constructor parameters by metric name, such as the weight files that
            perceptual metrics need.
        frames: length of each clip; None takes whole episodes.
        mode: how long clips are predicted: ``stream`` carries the model's state through the whole
            clip, ``windows`` predicts windows as long as the training clips, each from the last
            predicted frames, ``whole`` predicts all frames at once. None takes ``stream`` for
            models trained for it and ``windows`` for others.
        context_frames: number of context frames, the first frames of a clip that the model is
            given. Only the last of them is scored. None takes as many as in training.
        cuts: clips per episode; only for protocols that cut windows.
        steps: sampling steps; None takes the flow's default.
        samples: number of futures that are drawn of each clip. With more than one, the row
            ``model`` has the mean score of the draws, beside the score of their mean frames and of
            the best draw; and metrics that judge draws together are measured. A model that draws
            none is predicted once and scored by the same rules. The test with other actions, the
            curve of sampling steps and videos take one draw.
        steps_sweep: numbers of sampling steps at which a few clips are also predicted, for the
            curve of scores against steps, e.g. ``(1, 2, 5, 10, 20, 50)``, which takes several times
            as long as the evaluation. Empty for no curve; models without sampling steps have none.
            Metrics that read states from video are left out, unless one ranks the clips.
        sweep_episodes: number of clips per split for this curve, the first ones.
        batch_size: clips predicted at once; affects speed and memory, not the results.
        seed: seed of the sampling noise, and of the other episodes drawn for ``shuffled``.
        splits: the test splits, in the order of the report; None takes those in the data.
        episodes: number of episodes per split, under ``full`` the first ones; None takes all.
        videos: how many best, median and worst clips to show as video, of each kind per split.
        counterfactual_metrics: registered names of metrics that compare the effect of other actions
            from the same first frame, in the simulator and in the model.
        counterfactual_episodes: number of clips per split for these, the first ones; 0 for none.
            The simulator provides the truth, so it must be installed.
        noise_floor_episodes: number of episodes per split, the first ones, on which states are also
            read from the true video and the codec's reconstruction. This gives the noise floor of
            metrics that read states; 0 for none. Pixel metrics are measured on all episodes.
        perturbed_episodes: number of clips per split that the simulator repeats from a slightly
            different start, for the predictability horizon; 0 for none.
        ensemble_episodes: number of clips per split whose draws are compared with the simulator's
            own futures, from starts that differ by what a pixel resolves; 0 for none.
        ensemble_starts: number of these starts of each clip. Each costs a simulation.
        severity_episodes: number of episodes at each factor value of `acwm evaluate --sweep`.
        device: where the model runs, e.g. ``"cpu"`` or ``"cuda:1"``; ``"auto"`` takes a GPU if
            there is one.
    """

    protocol: str = "full"
    metrics: tuple[str | dict[str, Any], ...] = ()
    metric_options: dict[str, dict[str, Any]] | None = None
    frames: Several | None = None
    mode: Literal["stream", "windows", "whole"] | None = None
    context_frames: PositiveInt | None = None
    cuts: PositiveInt | None = None
    steps: PositiveInt | None = None
    samples: PositiveInt = 1
    steps_sweep: tuple[PositiveInt, ...] = ()
    sweep_episodes: Several = 4
    batch_size: PositiveInt = 8
    seed: NonNegativeInt = 0
    splits: tuple[str, ...] | None = None
    episodes: Several | None = None
    videos: NonNegativeInt = 1
    counterfactual_metrics: tuple[str | dict[str, Any], ...] = ()
    counterfactual_episodes: NonNegativeInt = 2
    noise_floor_episodes: NonNegativeInt = 8
    perturbed_episodes: NonNegativeInt = 8
    ensemble_episodes: NonNegativeInt = 0
    ensemble_starts: Annotated[int, Ge(4)] = 16
    severity_episodes: Several = 16
    device: str = "auto"

    def __post_init__(self) -> None:
        protocol = protocol_named(self.protocol)
        for name, value in protocol.defaults.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        if self.cuts is not None and not protocol.cuts_windows:
            raise RecipeError(
                f"evaluation.cuts={self.cuts} needs a protocol that cuts windows of episodes; "
                f"{self.protocol} takes one clip of each"
            )
        for name in ("metrics", "counterfactual_metrics"):
            object.__setattr__(self, name, tuple(getattr(self, name)))  # YAML gives lists
            metric_configs(getattr(self, name))
        object.__setattr__(self, "steps_sweep", tuple(sorted({*self.steps_sweep})))
        if self.splits is not None:
            object.__setattr__(self, "splits", tuple(self.splits))
        if self.splits == ():
            raise RecipeError("evaluation.splits=() must name at least one")
        for split in self.splits or ():
            if split not in SPLITS:
                raise RecipeError(f"evaluation.splits: unknown {split!r}{suggest(split, SPLITS)}")

    def to_dict(self) -> dict[str, Any]:
        """The parameters as plain JSON types."""
        return json.loads(json.dumps(asdict(self)))


def setting_overrides(given: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """The overrides for `acwm evaluate` that turn `given` settings (of `to_dict`) into `wanted`."""
    return [
        f"evaluation.{name}={value if isinstance(value, str) else json.dumps(value)}"
        for name, value in wanted.items()
        if name in given and value != given[name]
    ]
