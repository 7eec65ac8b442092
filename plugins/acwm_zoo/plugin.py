"""Registers the models in `models/`, the Hub, and the commands that make and publish models."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry
from acwm_zoo.shipped import about, shipped


@hookimpl
def register_trained_models(registry: Registry) -> None:
    """Add the models of this package by folder name, and those of the Hub."""
    for name in shipped():
        registry.add(name, "acwm_zoo.shipped:folder", summary=about(name), model=name)
    registry.add(
        "hf",
        "acwm_zoo.hub:fetch",
        summary="hf://ORG/NAME: runs that were published on the Hugging Face Hub",
        extra="hub",
        requires=("huggingface_hub",),
    )


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm demo`, `acwm ship` and `acwm push`."""
    registry.add("demo", "acwm_zoo.demo:demo", summary="simulate, train, evaluate and report")
    registry.add("ship", "acwm_zoo.commands:ship", summary="package a run as a small trained model")
    registry.add("push", "acwm_zoo.commands:push", summary="publish a run on the Hugging Face Hub")
