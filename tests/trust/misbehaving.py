"""Components that give what their interfaces do not allow, or end the program."""

import sys
from dataclasses import replace

import numpy as np
import torch

from acwm_core.env.physics import Observation
from acwm_core.evaluation.metric import Metric, SetMetric
from acwm_core.plugins import hookimpl
from acwm_planning.planner import Plan, Planner
from tests.core.tiny import SumConditioner
from tests.evaluation.tiny import BlockCodec, Drift, LinearModel
from tests.planning.tiny import Slide, SquareEstimator, ToPlace
from tests.plugins import plugin_of

FOUND = {}


def component(kind, **attributes):
    """A class under a name of its own, with methods replaced."""

    def made(base):
        def register(name, method, gives):
            def give(self, *given, **named):
                usual = getattr(super(made, self), method, None)
                return gives(usual, *given, **named)

            made = type(name, (base,), {method: give, "name": name, **attributes})
            made.__module__ = __name__
            if hasattr(base, "card"):
                made.card = replace(base.card, name=name)
            FOUND.setdefault(kind, {})[name] = f"{__name__}:{name}"
            return made

        return register

    return made


def errors(rollout):
    return (rollout.prediction - rollout.target).abs().mean((1, 2, 3)).double().numpy()


def stop(*_):
    sys.exit(0)


def press(*_):
    raise KeyboardInterrupt


class Errors(Metric):
    def per_frame(self, rollout):
        return errors(rollout)


class Sets(SetMetric):
    def features(self, rollout):
        return np.zeros((2, 3), np.float32)

    def distance(self, features):
        return 0.0


metric = component("metrics")(Errors)
gives_none = metric("gives_none", "per_frame", lambda usual, r: None)
gives_one_for_all = metric("gives_one_for_all", "per_frame", lambda usual, r: np.array([3.0]))
gives_texts = metric("gives_texts", "per_frame", lambda usual, r: np.array(["1"] * len(r.target)))
gives_too_few = metric("gives_too_few", "per_frame", lambda usual, r: errors(r)[1:])
exits = metric("exits", "per_frame", stop)
presses = metric("presses", "per_frame", press)
value_per_frame = metric("value_per_frame", "value", lambda usual, r: errors(r))
negative_weight = metric("negative_weight", "weight", lambda usual, r: -1.0)
no_summary = metric("no_summary", "summarise", lambda usual, *given: None)
strange_provenance = metric("strange_provenance", "provenance", lambda usual: {"network": object()})
of_sets = component("metrics")(Sets)
no_features = of_sets("no_features", "features", lambda usual, r: None)
no_distance = of_sets("no_distance", "distance", lambda usual, f: None)

codec = component("codecs")(BlockCodec)
drops_a_frame = codec("drops_a_frame", "_encode", lambda usual, v: usual(v)[:, 1:])
drops_a_channel = codec("drops_a_channel", "_encode", lambda usual, v: usual(v)[:, :, 1:])
decodes_grey = codec("decodes_grey", "_decode", lambda usual, z: usual(z)[:, :, :1])
climbs = codec("climbs", "fingerprint", lambda usual: "../../climbed")
no_stride = component("codecs", temporal_stride=0)(BlockCodec)(
    "no_stride", "eval", lambda usual: usual()
)

conditioner = component("conditioners")(SumConditioner)
of_one_frame = conditioner(
    "of_one_frame", "forward", lambda usual, a: cut(usual(a), slice(None), slice(1))
)
of_one_width = conditioner("of_one_width", "forward", lambda usual, a: cut(usual(a), ..., slice(1)))
no_conditioning = conditioner("no_conditioning", "forward", lambda usual, a: None)


def cut(made, *places):
    return replace(made, modulation=made.modulation[places])


model = component("models")(LinearModel)
one_channel = model("one_channel", "forward", lambda usual, *given: usual(*given)[:, :, :1])
predicts_less = model("predicts_less", "predict", lambda usual, *a, **k: usual(*a, **k)[:, 1:])
loss_of_many = model("loss_of_many", "loss", lambda usual, *given: usual(*given).repeat(3))
model_exits = model("model_exits", "forward", stop)

world = component("environments")(Drift)
no_state = world("no_state", "_state", lambda usual: None)
presses_while_it_moves = world("presses_while_it_moves", "_advance", press)
half_a_contact = world("half_a_contact", "_contacts", lambda usual: [(0, 1.5)])


class Replaces(Drift):
    """Its card fits what it does wrong."""

    card = replace(Drift.card, name="replaces")

    def _advance(self, action):
        super()._advance(action)
        self.card = replace(self.card, state=(replace(self.card.state[0], shape=(3,)),))

    def _state(self):
        return {"position": np.zeros(3)}


class SameArrays(Drift):
    """Hands out the same arrays every time, and changes what it was given."""

    card = replace(Drift.card, name="same_arrays")

    def _start(self, factors, rng):
        super()._start(factors, rng)
        factors["colour"] = 90
        self._shown = None

    def _render(self):
        made = super()._render()
        self._shown = self._shown or made
        for kept, new in zip(self._shown, made, strict=True):
            kept[:] = new
        return self._shown


task = {}


def solves(name, method, gives):
    task[name] = f"{__name__}:{name}"
    return component("tasks")(ToPlace)(name, method, gives)()


success_in_words = solves(
    "success_in_words", "success", lambda usual, seen, goal: np.array(["no"] * len(seen.masks))
)
success_nan = solves(
    "success_nan", "success", lambda usual, seen, goal: np.full(len(seen.masks), np.nan)
)
never = solves("never", "success", lambda usual, seen, goal: np.zeros(len(seen.masks), np.bool_))
distance_of_one = solves(
    "distance_of_one", "distance", lambda usual, seen, goal: usual(seen, goal)[:1]
)
no_goal = solves("no_goal", "sample_goal", lambda usual, environment, rng: None)
wild = solves("wild", "solution", lambda usual, *given: lambda: np.array([9.0, 0.0]))
one_for_both = solves("one_for_both", "solution", lambda usual, *given: lambda: np.array([0.5]))
in_digits = solves("in_digits", "solution", lambda usual, *given: lambda: ["1", "1"])
steps_nan = solves("steps_nan", "solution", lambda usual, *given: lambda: np.array([np.nan, 0]))
untold = solves("untold", "distance", lambda usual, seen, goal: usual(seen, goal) * np.nan)
endless = solves("endless", "distance", lambda usual, seen, goal: usual(seen, goal) + np.inf)
beyond = solves("beyond", "distance", lambda usual, seen, goal: usual(seen, goal) - 99)
small_picture = solves(
    "small_picture",
    "sample_goal",
    lambda usual, *given: usual(*given)._replace(frame=np.zeros((4, 4, 3), np.uint8)),
)
grey_picture = solves(
    "grey_picture",
    "sample_goal",
    lambda usual, *given: usual(*given)._replace(frame=np.zeros((32, 32, 3))),
)


def describes(name, **attributes):
    task[name] = f"{__name__}:{name}"
    return type(name, (ToPlace,), {"name": name, **attributes})()


tolerance_nan = describes("tolerance_nan", tolerance=float("nan"))
tolerance_in_words = describes("tolerance_in_words", tolerance="1.5")
steps_in_words = describes("steps_in_words", max_steps="12")
half_a_step = describes("half_a_step", max_steps=3.5)


class Misled(Slide):
    card = replace(Slide.card, name="misled")


class Sights(SquareEstimator):
    """Sees what `WRONG` makes of it, at first one frame alone."""

    def estimate(self, video):
        return WRONG["now"](super().estimate(video))


def seen(masks=lambda usual: usual, position=lambda usual: usual):
    return lambda usual: Observation(
        masks(usual.masks), {"position": position(usual.states["position"])}
    )


WRONG = {
    "one_place": seen(position=lambda usual: usual[:1]),
    "short": seen(lambda usual: usual[:1], lambda usual: usual[:1]),
    "half_masks": seen(masks=lambda usual: usual + 0.5),
    "far": seen(position=lambda usual: usual + np.inf),
    "text": seen(position=lambda usual: usual.astype(str)),
}
WRONG["now"] = WRONG["short"]


class Plans(Planner):
    actions_per_plan = 2

    def reset(self):
        pass

    def plan(self, cost, low, high, rng):
        return Plan(self.actions(low), 0.0, 1)

    def actions(self, low):
        return torch.zeros(4, len(low))


planner = component("planners")(Plans)
plans_nan = planner("plans_nan", "actions", lambda usual, low: usual(low) * float("nan"))
plans_nothing = planner("plans_nothing", "actions", lambda usual, low: usual(low)[:0])
plans_out_of_bounds = planner("plans_out_of_bounds", "actions", lambda usual, low: usual(low) + 9)
plans_another_shape = planner(
    "plans_another_shape", "actions", lambda usual, low: torch.zeros(4, 7)
)
no_plan = planner("no_plan", "plan", lambda usual, *given: None)

FOUND.pop("tasks")
FOUND["environments"] |= {
    n: f"{__name__}:{c}" for n, c in (("replaces", "Replaces"), ("same_arrays", "SameArrays"))
}
FOUND["estimators"] = {"misled": f"{__name__}:Sights"}
MisbehavingPlugin = plugin_of(**FOUND)


class MisledPlugin:
    """The environment whose estimator and tasks are wrong."""

    @staticmethod
    @hookimpl
    def register_environments(registry):
        tasks = {"place": "tests.planning.tiny:PLACE", **task}
        registry.add("misled", f"{__name__}:Misled", tasks=tasks)
