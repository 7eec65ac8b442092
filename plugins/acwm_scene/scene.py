"""`SceneDynamics`: reads what is in a scene, moves it by the actions, and draws it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional
from torch.utils import _pytree

from acwm_core.env.card import EnvironmentCard
from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.batch import noise_of_clips, to_device
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import (
    CarriedStates,
    Keypoints,
    LatentStream,
    ModelInputs,
    Predictor,
)
from acwm_core.model.shapes import Latent
from acwm_scene.bodies import BodyGroup
from acwm_scene.carried import SceneStates, SceneStream
from acwm_scene.declared import GroupSpec, default_states, groups_of
from acwm_scene.group import (
    Group,
    as_vectors,
    at_frame,
    flattened,
    picked,
    stacked,
    tree_map,
)
from acwm_scene.layers import FrameDrawing, MatrixConv
from acwm_scene.node_group import NodeGroup
from acwm_scene.points import PointGroup
from acwm_scene.upgrade import upgraded
from acwm_scene.values import ValueGroup

GROUPS: Mapping[str, Callable[..., Group]] = {
    "values": ValueGroup,
    "bodies": BodyGroup,
    "nodes": NodeGroup,
}
"""What makes a group of a kind from its `GroupSpec`."""


class Scene(NamedTuple):
    """What is known after a latent frame: a tree of tensors `[B, …]`.

    Attributes:
        base: the given latent frame that predictions are relative to, `[B, C, h, w]`.
        canvas: what all frames are drawn on, `[B, channels, h, w]`.
        states: of each group in the last video frame, by name.
        memories: what the painter of each group remembers of the given frame, by name.
    """

    base: Tensor
    canvas: Tensor
    states: dict[str, Any]
    memories: dict[str, Any]


class SceneDynamics(Predictor):
    """Reads the scene from the given frame, moves it, and draws every frame from it.

    The picture is no part of what is carried from frame to frame, so that nothing fades: what moves
    wrongly is in the wrong place, and as solid as before. A scene has groups of things: values such
    as the joints of a robot, bodies on a plane, the nodes of a rope or a cloth. Which, and what
    camera looks at them, the environment's card declares; `data.states` may choose among its
    fields. It is for a camera that stands still.

    Args:
        latent_channels: channels C of the codec.
        temporal_stride: video frames per latent frame of the codec.
        specs: the groups that the card declares, by name.
        state_size: number of values S of the states.
        channels: size of the grid that is drawn on and of the layers that look.
        width: size of the conditioner's modulation, and of what the blocks are modulated by.
        blocks: number of residual blocks that draw.
        points: number of points that it finds by itself, beside what is declared; see
            `acwm_scene.points`.
        noise: numbers that the future of each body, or of each other group, depends on; 0 for a
            model that predicts one future.
        stretch: share by which neighbouring nodes of a rope or cloth may move apart, relative to
            the given frame; None is unlimited.
        unit: metres that count as one in bodies and nodes; by default it follows from the camera.
        every: every n-th node of a rope or cloth, along each side, is moved.

    Attributes:
        noise: numbers that a draw depends on, of all groups together.

    Raises:
        RecipeError: a size below 1, or a negative noise or stretch.
    """

    layers, heads = 0, 1
    causal = True
    fitted_parameters = ("temporal_stride", "specs", "state_size")

    def __init__(
        self,
        *,
        latent_channels: int,
        temporal_stride: int = 4,
        specs: Mapping[str, GroupSpec] | None = None,
        state_size: int = 1,
        channels: int = 96,
        width: int = 192,
        blocks: int = 4,
        points: int = 0,
        noise: int = 0,
        stretch: float | None = None,
        unit: float | None = None,
        every: int = 2,
    ) -> None:
        super().__init__()
        if min(channels, width, blocks, every) < 1:
            raise RecipeError("channels, width, blocks and every of a scene must be at least 1")
        if points < 0:
            raise RecipeError(f"model.points is {points}; it must be 0 or more")
        if noise < 0 or not (stretch is None or stretch >= 0) or not (unit is None or unit > 0):
            raise RecipeError("model.noise and model.stretch are 0 or more, and model.unit above 0")
        self.latent_channels, self.stride, self.width = latent_channels, temporal_stride, width
        self.state_size = state_size
        if specs is None:
            specs = {"values": GroupSpec("values", columns=tuple(range(state_size)))}
        if not specs and not points:
            raise RecipeError(
                "a scene learns from states: name them in data.states; or let it find points by "
                "itself, by model.points=16; or choose a model without states, such as by "
                "+recurrent"
            )
        self.columns = {name: list(spec.columns) for name, spec in specs.items()}
        sizes = {"latent_channels": latent_channels, "stride": temporal_stride}
        sizes |= {"channels": channels, "width": width, "noise": noise}
        options = {"stretch": stretch, "unit": unit, "every": every}
        groups = {name: GROUPS[spec.kind](spec, **sizes, **options) for name, spec in specs.items()}
        self.point_size = 0
        if points:
            declared = {
                name: groups[name].encode(torch.zeros(1, 1, len(spec.columns)))
                for name, spec in specs.items()
            }
            size = as_vectors(declared).shape[2] if declared else 0
            groups["points"] = group = PointGroup(points, declared=size, **sizes)
            self.point_size = group.size
            self.columns["points"] = [*range(state_size, state_size + group.size)]
        self.groups = nn.Module()  # a ModuleDict has an attribute `values` of its own
        for name, group in groups.items():
            self.groups.add_module(name, group)
        self.drawing = FrameDrawing(latent_channels, channels=channels, width=width, blocks=blocks)
        self.keypoint_names = tuple(
            name for group in groups.values() for name in group.keypoint_names
        )
        self.noise = sum(group.noise for group in groups.values())
        self.samples = self.noise > 0

    @classmethod
    def fitted(cls, data: ModelInputs) -> dict[str, Any]:
        """The groups that the card declares; see `acwm_scene.declared`."""
        return {
            "latent_channels": data.latent_channels,
            "temporal_stride": data.temporal_stride,
            **groups_of(data.environment, data.states),
        }

    @classmethod
    def default_states(
        cls,
        environment: EnvironmentCard,
        changing: Collection[str],
        *,
        points: int = 0,
        **parameters: Any,
    ) -> tuple[str, ...]:
        """What moves, as the card declares it; none if the scene finds points by itself.

        See `acwm_scene.declared.default_states`.
        """
        if points:
            return ()
        return default_states(environment, changing)

    def upgrade(self, weights: dict[str, Tensor]) -> dict[str, Tensor]:
        """Weights of the models that scenes replace, under their present names."""
        return upgraded(weights, self.columns, self.state_dict())

    # Reading, moving, drawing ------------------------------------------------------------------

    def read(self, given: Latent) -> Scene:
        """The scene that the last of the given latent frames `[B, K, C, h, w]` shows."""
        if given.ndim != 5 or given.shape[2] != self.latent_channels:
            raise ShapeError(
                f"{type(self).__name__} takes latents [B, L, {self.latent_channels}, h, w], "
                f"not {list(given.shape)}"
            )
        return self._begun(
            given[:, -1], {name: group.read(given) for name, group in self._groups()}
        )

    def move(self, scene: Scene, actions: Mapping[str, Tensor]) -> tuple[Scene, dict[str, Any]]:
        """The scene one latent frame later, and the courses of its video frames.

        Args:
            scene: after the latent frame before.
            actions: for each group one of the rows of its embedded actions, `[B, …]`.

        Returns:
            The scene, and courses `[B, stride, …]`, by group.
        """
        states, courses = self.move_states(scene.states, actions)
        return scene._replace(states=states), courses

    def move_states(
        self, states: Mapping[str, Any], actions: Mapping[str, Tensor]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """The states of each group one latent frame later, and their courses; see `move`.

        Points come last, and move with regard to what is declared.
        """
        moved, courses = dict[str, Any](), dict[str, Any]()
        with torch.autocast(next(iter(actions.values())).device.type, enabled=False):
            for name, group in self._groups():
                action = actions[name]
                if isinstance(group, PointGroup) and courses:
                    action = group.with_declared(action[:, None], as_vectors(courses))[:, 0]
                moved[name], courses[name] = group.move(states[name], action)
        return moved, courses

    def agents_of(self, columns: Collection[int]) -> str | None:
        """The group whose agents alone these columns of the states tell of, if there is one."""
        for name, _ in self._groups():
            if columns and {*columns} <= {*self.agent_columns(name).tolist()}:
                return name
        return None

    def agent_columns(self, name: str) -> Tensor:
        """The columns of the states that tell of the agents of a group."""
        size = dict(self._groups())[name].agent_size
        return torch.tensor(self.columns[name][:size], dtype=torch.long)

    def move_agents(
        self, states: dict[str, Any], actions: Mapping[str, Tensor], name: str
    ) -> tuple[dict[str, Any], Tensor]:
        """The agents of one group a latent frame later.

        Returns:
            The states of all groups, in which all else is as it was, and values
            `[B, stride, S]`, NaN of all else.
        """
        group = dict(self._groups())[name]
        with torch.autocast(actions[name].device.type, enabled=False):
            moved, values = group.move_agents(states[name], actions[name])
        whole = values.new_full((*values.shape[:2], self.state_size), math.nan)
        whole[..., self.agent_columns(name)] = values
        return {**states, name: moved}, whole

    def draw(self, scene: Scene, courses: Mapping[str, Any]) -> Tensor:
        """The latent frame `[B, C, h, w]` of courses `[B, stride, …]`, the last frame first."""
        size = scene.base.shape[-2:]
        painted = [
            group.paint(scene.memories[name], courses[name], size) for name, group in self._groups()
        ]
        maps, vectors = zip(*painted, strict=True)
        return scene.base + self.drawing(
            scene.canvas, sum(maps[1:], maps[0]), sum(vectors[1:], vectors[0])
        )

    # What a `Predictor` does -------------------------------------------------------------------

    def forward(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[Generator] = (),
    ) -> Latent:
        """Predict the latent frames after the given ones, `[B, L − K, C, h, w]`."""
        count = frames - given.shape[1]
        numbers = torch.arange(1, count + 1, device=given.device).expand(len(given), -1)
        return self._predicted(given, conditioning, frames, numbers, generators)

    def predict_frames(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        numbers: Tensor,
        generators: Sequence[Generator] = (),
    ) -> Latent:
        """Move the whole scene, and draw only some frames; see `Predictor.predict_frames`."""
        return self._predicted(given, conditioning, frames, numbers + 1, generators)

    def predict_states(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[Generator] = (),
    ) -> Tensor:
        """The states that it would draw; see `Predictor.predict_states`.

        Raises:
            RecipeError: it learnt no states but its points, or the weights do not hold their
                scale.
        """
        self._check_states()
        return self.decode(self._foretold(given, conditioning, frames, generators))[:, 1:]

    def read_keypoints(self, latents: Latent) -> Keypoints:
        """Where the things of its groups are; see `Predictor.read_keypoints`."""
        frames, aspect = latents.flatten(0, 1)[:, None], latents.shape[4] / latents.shape[3]
        courses = {
            name: tree_map(
                lambda values: values.unflatten(0, latents.shape[:2]),
                group.frame(group.read(frames)),
            )
            for name, group in self._groups()
            if group.keypoint_names
        }
        return self._keypoints(courses, aspect)

    def predict_keypoints(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[Generator] = (),
    ) -> Keypoints:
        """Where they are when it has moved them; see `Predictor.predict_keypoints`."""
        courses = self._foretold(given, conditioning, frames, generators)
        later = tree_map(lambda values: values[:, self.stride :: self.stride], courses)
        return self._keypoints(later, given.shape[4] / given.shape[3])

    def carry_states(self, given: Latent, generators: Sequence[Generator] = ()) -> CarriedStates:
        """The states alone, step by step; see `Predictor.carry_states`.

        Raises:
            RecipeError: as `predict_states`.
        """
        self._check_states()
        scene = self._with_draw(self.read(given), self._drawn(given, generators))
        return SceneStates(self, scene.states)

    def stream(
        self, given: Latent, *, context: int, generators: Sequence[Generator] = ()
    ) -> LatentStream:
        """Stream from the scene. `context` is ignored, as the scene holds all that is known."""
        return SceneStream(self, self._with_draw(self.read(given), self._drawn(given, generators)))

    def matrices(self) -> list[nn.Parameter]:
        """The weights of the convolutions in the blocks and in the head that draw."""
        return [module.weight for module in self.modules() if isinstance(module, MatrixConv)]

    def initial_state(
        self, given: Latent, conditioning: Conditioning, *draw: Tensor
    ) -> tuple[Tensor, ...]:
        """The first state of a stream that begins with latents `[B, K, C, h, w]`, as tensors.

        `draw` is the noise of a model that draws, `[B, noise]`.
        """
        scene = self._with_draw(self.read(given), draw[0] if draw else None)
        tensors, self._form = cast(Any, _pytree).tree_flatten(scene)
        return tuple(tensors)

    def next_state(
        self, state: tuple[Tensor, ...], conditioning: Conditioning
    ) -> tuple[Latent, tuple[Tensor, ...]]:
        """The next latent frame `[B, 1, C, h, w]` and its state, given the last conditioning."""
        scene = cast(Any, _pytree).tree_unflatten(list(state), self._form)
        latent, scene = self.next_frame(scene, conditioning)
        return latent, tuple(cast(Any, _pytree).tree_leaves(scene))

    def next_frame(self, scene: Scene, conditioning: Conditioning) -> tuple[Latent, Scene]:
        """The next latent frame `[B, 1, C, h, w]` and its scene, given the last conditioning."""
        actions = {name: rows[:, -1] for name, rows in self.embed(conditioning).items()}
        scene, courses = self.move(scene, actions)
        last_first = tree_map(lambda values: torch.stack(values.unbind(1)[::-1], 1), courses)
        return self.draw(scene, last_first)[:, None], scene

    # What training needs -----------------------------------------------------------------------

    def embed(self, conditioning: Conditioning) -> dict[str, Tensor]:
        """The embedded actions of a clip as each group takes them, `[B, L, …]`.

        Raises:
            RecipeError: the conditioner gives no modulation.
        """
        if conditioning.modulation is None:
            raise RecipeError(
                "a scene takes actions as a modulation, which this conditioner does not give: set "
                "conditioner=adaln"
            )
        return {name: group.embed(conditioning.modulation) for name, group in self._groups()}

    @property
    def points(self) -> PointGroup | None:
        """The points that it finds by itself, if it does."""
        return dict(self._groups()).get("points")  # pyright: ignore[reportReturnType]

    def with_points(self, states: Tensor, latents: Latent, frames: Tensor | None = None) -> Tensor:
        """States `[B, T, S]`, and after them the points that it reads from latents.

        Args:
            states: as they were recorded; S may be 0.
            latents: of the clips, `[B, L, C, h, w]`.
            frames: numbers of the latent frames to read, `[B, N]`; the points of others are then 0.
                All by default.

        Returns:
            `[B, T, S + point_size]`; all video frames of a latent frame have its points.
        """
        if self.points is None:
            return states
        if frames is None:
            frames = torch.arange(latents.shape[1], device=latents.device).expand(len(latents), -1)
        chosen = latents.take_along_dim(frames[..., None, None, None], 1)
        read = self.points.sight(chosen.flatten(0, 1)).flatten(1).unflatten(0, frames.shape)
        whole = read.new_zeros(*latents.shape[:2], self.point_size)
        whole = whole.scatter(1, frames[..., None].expand_as(read), read)
        whole = whole.repeat_interleave(self.stride, 1)[:, self.stride - 1 :]
        return torch.cat([states, whole], 2)

    def encode(self, states: Tensor) -> dict[str, Any]:
        """The courses in states `[B, T, S]`, as they were recorded, by group.

        The states of points come last; see `with_points`.
        """
        size = self.state_size + self.point_size
        if states.shape[2] != size:
            raise ShapeError(f"states have {states.shape[2]} values, not {size}")
        return {
            name: group.encode(states[..., self.columns[name]].float())
            for name, group in self._groups()
        }

    def states_of(self, states: Mapping[str, Any]) -> Tensor:
        """The values `[B, S]` of the states of each group, without points."""
        frames = {name: stacked([group.frame(states[name])]) for name, group in self._groups()}
        return self.decode(frames)[:, 0]

    def decode(self, courses: Mapping[str, Any]) -> Tensor:
        """The inverse of `encode`, `[B, T, S]`, without points."""
        parts = {name: group.decode(courses[name]) for name, group in self._groups()}
        first = next(iter(parts.values()))
        parts.pop("points", None)
        states = first.new_empty(*first.shape[:2], self.state_size)
        for name, values in parts.items():
            states[..., self.columns[name]] = values
        return states

    def draw_true(self, given: Latent, states: Tensor, numbers: Tensor) -> Latent:
        """The latent frames `[B, N, C, h, w]` that true states show (teacher forcing).

        While it is trained, true states are as wrong as the given frame is read.

        Args:
            given: the first K latent frames, `[B, K, C, h, w]`.
            states: in all video frames of the clips, `[B, T, S]`, as they were recorded.
            numbers: of the frames, counted from the first one after the given ones, `[B, N]`.
        """
        now = (given.shape[1] - 1) * self.stride
        base, whole = given[:, -1], self.encode(states)
        courses, begun = dict[str, Any](), dict[str, Any]()
        for name, group in self._groups():
            later = tree_map(lambda values: values[:, now:], whole[name])
            courses[name] = group.as_read(base, later)
            first = at_frame(courses[name], 0)
            begun[name] = group.begin(first, at_frame(whole[name], now - 1) if now else first)
        return self._drawn_courses(self._begun(base, begun), courses, numbers + 1)

    def reading_loss(self, latents: Tensor, states: Tensor, numbers: Tensor) -> Tensor:
        """The error of the states read from some frames of clips, a scalar.

        Args:
            latents: of clips, `[B, L, C, h, w]`.
            states: as they were recorded, `[B, T, S]`.
            numbers: of the latent frames to read, `[B, N]`.
        """
        frames = latents.take_along_dim(numbers[..., None, None, None], 1).flatten(0, 1)
        courses = self.encode(states)
        losses = [
            group.reading_loss(frames, flattened(picked(courses[name], self.stride * numbers)))
            for name, group in self._groups()
        ]
        return torch.stack(losses).sum()

    def motion_loss(
        self, states: Tensor, conditioning: Conditioning, random: Generator, *, progress: float
    ) -> Tensor:
        """The error of how actions move things, without pictures, a scalar; see `Group`."""
        actions, declared = self.embed(conditioning), self.encode(states)
        declared.pop("points", None)
        if self.points and declared:
            later = as_vectors(declared)[:, 1:]
            actions["points"] = self.points.with_declared(actions["points"], later, random)
        losses = [
            group.motion_loss(
                states[..., self.columns[name]].float(), actions[name], random, progress
            )
            for name, group in self._groups()
        ]
        return torch.stack(losses).sum()

    def motion_parameters(self) -> list[nn.Parameter]:
        """The weights of what moves things."""
        return [
            parameter
            for _, group in self._groups()
            for module in group.movers()
            for parameter in module.parameters()
        ]

    def prepare(self, mean: Tensor, std: Tensor) -> None:
        """Take the scale of the states, `[S]` each, in groups that do not know one yet."""
        for name, group in self._groups():
            if not group.is_prepared:
                group.prepare(mean[self.columns[name]], std[self.columns[name]])

    # Inner workings ----------------------------------------------------------------------------

    def _groups(self) -> list[tuple[str, Group]]:
        return cast(list[tuple[str, Group]], [*self.groups.named_children()])

    def _check_states(self) -> None:
        """Refuse to tell states that it does not know."""
        if not self.state_size:
            raise RecipeError("this scene predicts only points that it found itself, and no states")
        if not all(group.is_prepared for _, group in self._groups()):
            raise RecipeError(
                "these weights do not hold the scale of their states, as an earlier version made "
                "them, so no states can be predicted: train further by training.init_from"
            )

    def _predicted(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        numbers: Tensor,
        generators: Sequence[Generator],
    ) -> Latent:
        """The frames with these numbers, 1 for the first one after the given ones."""
        scene = self._with_draw(self.read(given), self._drawn(given, generators))
        courses = self._moved(scene, self.embed(conditioning), given.shape[1], frames)
        return self._drawn_courses(scene, courses, numbers)

    def _foretold(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[Generator],
    ) -> dict[str, Any]:
        """The courses `[B, 1 + T, …]` from the last given frame on; see `predict_states`."""
        actions = self.embed(conditioning)
        number = len(next(iter(actions.values())))
        scene = self.read(given)
        if len(given) < number:
            scene = tree_map(lambda values: values.expand(number, *values.shape[1:]), scene)
        scene = self._with_draw(scene, self._drawn(given, generators))
        return self._moved(scene, actions, given.shape[1], frames)

    def _keypoints(self, courses: Mapping[str, Any], aspect: float) -> Keypoints:
        """Those of all groups; where one has fewer features, 0 without a weight."""
        keypoints = [
            group.keypoints(courses[name], aspect)
            for name, group in self._groups()
            if group.keypoint_names
        ]
        if not keypoints:
            raise RecipeError("this scene has only values, which have no place in a picture")
        size = max(part.values.shape[-1] for part in keypoints)

        def together(parts: Iterable[Tensor], axis: int) -> Tensor:
            return torch.cat(
                [functional.pad(values, (0, size - values.shape[-1])) for values in parts], axis
            )

        return Keypoints(
            together((part.values for part in keypoints), 2),
            together((part.weights for part in keypoints), 0),
            torch.cat([part.shares for part in keypoints]),
        )

    def _begun(self, base: Tensor, states: dict[str, Any]) -> Scene:
        features = self.drawing.stem(base)
        canvases, memories = list[Tensor](), dict[str, Any]()
        for name, group in self._groups():
            past = group.past(states[name], self.stride)
            canvas, memories[name] = group.canvas(features, past)
            canvases.append(canvas)
        return Scene(base, features + sum(canvases[1:], canvases[0]), states, memories)

    def _moved(
        self, scene: Scene, actions: Mapping[str, Tensor], known: int, frames: int
    ) -> dict[str, Any]:
        """The courses from the scene on, `[B, 1 + T, …]`."""
        passed = [
            {name: stacked([group.frame(scene.states[name])]) for name, group in self._groups()}
        ]
        for frame in range(known, frames):
            now = {name: rows[:, frame] for name, rows in actions.items()}
            scene, courses = self.move(scene, now)
            passed.append(courses)
        return tree_map(lambda *values: torch.cat(values, 1), *passed)

    def _drawn_courses(self, scene: Scene, courses: Mapping[str, Any], numbers: Tensor) -> Latent:
        """The latent frames with these numbers, 1 for the first one after the given ones."""
        count = numbers.shape[1]
        rows = numbers[..., None] * self.stride - torch.arange(self.stride, device=numbers.device)
        picked_courses = {name: flattened(picked(course, rows)) for name, course in courses.items()}
        fixed = (scene.base, scene.canvas, scene.memories)
        base, canvas, memories = tree_map(lambda tensor: tensor.repeat_interleave(count, 0), fixed)
        return self.draw(Scene(base, canvas, {}, memories), picked_courses).unflatten(
            0, numbers.shape
        )

    def _drawn(self, given: Latent, generators: Sequence[Generator]) -> Tensor | None:
        """The numbers `[B, noise]` of one of the futures."""
        if not self.samples:
            return None
        return to_device(noise_of_clips((self.noise,), generators), given)

    def _with_draw(self, scene: Scene, draw: Tensor | None) -> Scene:
        if draw is None:
            return scene
        parts = draw.split([group.noise for _, group in self._groups()], 1)
        states = {
            name: group.with_draw(scene.states[name], part) if group.noise else scene.states[name]
            for (name, group), part in zip(self._groups(), parts, strict=True)
        }
        return scene._replace(states=states)
