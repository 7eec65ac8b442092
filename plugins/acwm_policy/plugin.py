"""Registers the kind learner and some learners."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_kinds(registry: Registry) -> None:
    """Add the kind of component that learns policies."""
    registry.add(
        "learner",
        "acwm_policy.learner:Learner",
        summary="learns a policy",
        check="acwm_policy.checks:check_learner",
    )


@hookimpl
def register_learners(registry: Registry) -> None:
    """Add learners."""
    for name, target, summary in (
        ("sac", "SoftActorCritic", "soft actor-critic of stable-baselines3"),
        ("ppo", "ProximalPolicy", "proximal policy optimisation of stable-baselines3"),
        ("td3", "TwinDelayed", "twin delayed DDPG of stable-baselines3"),
    ):
        registry.add(
            name,
            f"acwm_policy.library:{target}",
            summary=summary,
            extra="policies",
            requires=("stable_baselines3",),
        )
    registry.add(
        "backprop",
        "acwm_policy.backprop:Backprop",
        summary="gradients through the dream: short-horizon actor-critic (Xu et al. 2022)",
    )
    registry.add(
        "clone",
        "acwm_policy.clone:Clone",
        summary="does what was done in recordings (behaviour cloning)",
    )
