"""Registers the kinds planner and cost, and some of each."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_kinds(registry: Registry) -> None:
    """Add the kinds of component that planning consists of."""
    registry.add(
        "planner",
        "acwm_planning.planner:Planner",
        summary="finds the cheapest actions",
        check="acwm_planning.checks:check_planner",
    )
    registry.add(
        "cost",
        "acwm_planning.planner:Cost",
        summary="how far imagined futures are from a goal",
    )


@hookimpl
def register_planners(registry: Registry) -> None:
    """Add planners."""
    sampling = "acwm_planning.sampling"
    registry.add(
        "random_shooting", f"{sampling}:RandomShooting", summary="the best of random candidates"
    )
    registry.add(
        "cem",
        f"{sampling}:CrossEntropy",
        summary="cross-entropy method: a Gaussian fitted to its best candidates",
    )
    registry.add(
        "icem",
        f"{sampling}:ImprovedCrossEntropy",
        summary="cem with coloured noise, warm starts and kept elites (Pinneri et al. 2020)",
    )
    registry.add(
        "mppi",
        f"{sampling}:PathIntegral",
        summary="the mean of all candidates, cheap ones weighing more (Williams et al. 2017)",
    )
    registry.add(
        "gradient",
        "acwm_planning.gradient:Gradient",
        summary="Adam on the actions, through the model, from several starts",
    )


@hookimpl
def register_costs(registry: Registry) -> None:
    """Add costs."""
    registry.add(
        "latent",
        "acwm_planning.costs:LatentDistance",
        summary="distance between the latents of the prediction and of the goal's picture",
    )
    registry.add(
        "state",
        "acwm_planning.costs:StateDistance",
        summary="the task's distance between states that an estimator reads",
    )
    registry.add(
        "points",
        "acwm_planning.costs:KeypointDistance",
        summary="distance between the points that a model finds in both pictures",
    )
    registry.add(
        "reward",
        "acwm_planning.rewards.cost:RewardCost",
        summary="what a learnt reward lacks of the highest recorded one: cost.head=FOLDER",
    )
    registry.add(
        "callable",
        "acwm_planning.costs:UserCost",
        summary="your own function: cost.function=module:name",
    )


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm train-reward`, before policies."""
    registry.add(
        "train-reward",
        "acwm_planning.rewards.commands:train_reward",
        summary="learn a reward from a recorded column, for plans and policies",
    )
