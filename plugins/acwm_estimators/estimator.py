"""Estimators that read a world with a network that was trained for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import Observation, Physics, StateEstimator
from acwm_core.errors import DataError, ShapeError, unknown_name
from acwm_core.files import training_record
from acwm_core.model.shapes import Clip
from acwm_core.plugins import catalog
from acwm_estimators.curve import evenly, trace
from acwm_estimators.fitted import fitted_physics, layout_from_dict
from acwm_estimators.layout import CurveField, Layout, layout_of
from acwm_estimators.limits import limits_fingerprint, physics_of
from acwm_estimators.network import NetworkOutput, StateNetwork
from acwm_estimators.plugin import WEIGHTS
from acwm_estimators.reading import states_of
from acwm_estimators.targets import lifted
from acwm_estimators.weights import FOLDER, fingerprint, load

BATCH = 16
"""Frames per batch."""


class NetworkEstimator(StateEstimator):
    """Reads masks and states frame by frame, with the network of a layout.

    Args:
        card: the environment's card, with any frame size.
        layout: what is read.
        physics: what can be measured in it.
        weights: the network's weights.

    Raises:
        ShapeError: the card lacks instances that are read, so it belongs to other data.
        DataError: the file does not exist or holds other weights.
    """

    def __init__(
        self, card: EnvironmentCard, layout: Layout, physics: Physics, weights: Path
    ) -> None:
        super().__init__(card)
        self.layout, self.weights, self._physics = layout, weights, physics
        self.instances = layout.instances
        missing = [name for name in self.instances if name not in card.instances]
        if missing:
            raise ShapeError(f"this data of {card.name} has no masks of {', '.join(missing)}")
        self._network = StateNetwork(layout)
        load(self._network, weights)
        self._network.eval().features.fuse()
        self._network.to(memory_format=torch.channels_last)  # pyright: ignore
        ids = [card.instances.index(name) for name in self.instances]
        self._ids = torch.tensor([0, *ids], dtype=torch.uint8)
        height, width = card.frame_size
        self.fields = tuple(sorted(self.estimate(torch.zeros(1, 3, height, width)).states))

    @property
    def physics(self) -> Physics:
        return self._physics

    def packages(self) -> tuple[str, ...]:
        """Its own package, and the one that reads."""
        return tuple(dict.fromkeys([*super().packages(), "acwm_estimators"]))

    def provenance(self) -> dict[str, str]:
        """The hash of the weights."""
        return {"weights": fingerprint(self.weights)}

    def estimate(self, video: Clip) -> Observation:
        if tuple(video.shape[1:]) != (3, *self.card.frame_size):
            height, width = self.card.frame_size
            raise ShapeError(
                f"this estimator of {self.card.name} reads frames [T, 3, {height}, {width}], not "
                f"{list(video.shape)}"
            )
        video = video.float().cpu()
        new = torch.ones(len(video), dtype=torch.bool)
        new[1:] = (video[1:] != video[:-1]).flatten(1).any(1)  # frames that repeat are read once
        parts = [self._read(frames) for frames in video[new].split(BATCH)]
        which = (new.long().cumsum(0) - 1).numpy()
        found = {name: np.concatenate([part[name] for part in parts])[which] for name in parts[0]}
        masks = found.pop("masks")
        return Observation(masks, states_of(found, masks, self.layout, self.card))

    def pixels(self, field: str, values: NDArray[Any]) -> NDArray[np.float64]:
        places = (*self.layout.points, *self.layout.curves)
        (plane,) = [place.plane for place in places if place.field == field]
        height, width = self.card.frame_size
        seen = self.layout.camera.to_frame(lifted(np.asarray(values, np.float64), plane))
        return seen[..., :2] * height + np.array([width, height]) / 2

    @torch.inference_mode()
    def _read(self, frames: Clip) -> dict[str, NDArray[Any]]:
        with torch.autocast("cpu", enabled=False):
            output: NetworkOutput = self._network(frames)
            seen = (
                output.logits_at(self.card.frame_size).max(1).indices
            )  # argmax takes 5 times as long
        found: dict[str, NDArray[Any]] = {"masks": self._ids[seen].numpy()}
        for name, values in output.points.items():
            found[f"points:{name}"] = values.double().numpy()
        for index, values in enumerate(output.locals):
            found[f"local:{index}"] = values.double().numpy()
        found["totals"] = output.totals.double().numpy()
        if output.surface is not None:
            found["surface"] = output.surface.double().numpy()
        if self.layout.curves:
            likely = output.logits.float().softmax(1).numpy()
            for curve in self.layout.curves:
                traced = [self._traced(each, curve) for each in likely]
                found[f"curve:{curve.field}"] = np.stack(traced)
        return found

    def _traced(self, likely: NDArray[np.float32], curve: CurveField) -> NDArray[np.float64]:
        """Nodes `[N, 2]` of a curve in m, from the likelihoods `[1 + I, h, w]` of all instances."""
        body, cover = (1 + self.instances.index(name) for name in (curve.instance, curve.cover))
        path = trace(likely[body].astype(np.float64), likely[cover].astype(np.float64))
        (nodes,) = [field.shape[0] for field in self.card.state if field.name == curve.field]
        if path is None:
            return np.full((nodes, 2), np.nan)
        height, width = likely.shape[1:]
        aspect = self.card.frame_size[1] / self.card.frame_size[0]
        seen = (path / [width, height] - 0.5) * [aspect, 1.0]
        line = self.layout.camera.on_plane(seen, curve.plane)[:, :2]
        return evenly(line, nodes, curve.end)


class Estimator(NetworkEstimator):
    """Reads an environment whose weights ship.

    Args:
        card: card of an environment in `acwm_estimators.plugin.WEIGHTS`, with any frame size.
        weights: a file written by `python -m acwm_estimators.train`; by default the one that ships
            with the package.

    Raises:
        RecipeError: no weights ship for this environment.
        ShapeError, DataError: as for `NetworkEstimator`.
    """

    def __init__(self, card: EnvironmentCard, *, weights: str | None = None) -> None:
        name = card.name
        if name not in WEIGHTS:
            raise unknown_name("estimator", name, WEIGHTS)
        file = Path(weights) if weights else FOLDER / f"{WEIGHTS[name]}.safetensors"
        super().__init__(card, layout_of(name), physics_of(name), file)

    def packages(self) -> tuple[str, ...]:
        """Its own package, that of the environment, which defines the physics, and `acwm_sim`."""
        environment = catalog().component("environment", self.card.name).physics or ""
        return (*super().packages(), "acwm_sim", environment.partition(".")[0])

    def provenance(self) -> dict[str, str]:
        """Hashes of the weights, and of the limits that define violations and contacts."""
        return {**super().provenance(), "limits": limits_fingerprint(self.card.name)}


class FittedEstimator(NetworkEstimator):
    """Reads one's own world, with weights that `acwm train-estimator` wrote.

    Args:
        card: the card of the environment or of the recordings.
        weights: the file, which says what is read.

    Raises:
        ShapeError, DataError: as for `NetworkEstimator`.
    """

    def __init__(self, card: EnvironmentCard, *, weights: str | Path) -> None:
        record = training_record(Path(weights))
        if "layout" not in record:
            raise DataError(
                f"{weights} does not say what it reads: it comes from `acwm_estimators.train`"
            )
        layout = layout_from_dict(record["layout"])
        super().__init__(card, layout, fitted_physics(layout), Path(weights))
