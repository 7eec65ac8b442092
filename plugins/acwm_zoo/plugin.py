"""Registers the models in `models/`, the Hub, and the commands that make and publish models."""

from acwm_core.plugins import Registry, hookimpl
from acwm_zoo.shipped import INSTALL, about, known, shipped


@hookimpl
def register_trained_models(registry: Registry) -> None:
    """Add the models of this package by folder name, and those of the Hub."""
    installed = shipped()
    for name in known():
        registry.add(
            name,
            "acwm_zoo.shipped:folder",
            summary=about(name),
            requires=() if name in installed else ("acwm_models",),
            install=INSTALL,
            model=name,
        )
    registry.add(
        "hf",
        "acwm_zoo.hub:fetch",
        summary="hf://ORG/NAME: runs that were published on the Hugging Face Hub",
        extra="hub",
        requires=("huggingface_hub",),
    )


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm demo`, `acwm ship`, `acwm push` and `acwm import-checkpoint`."""
    registry.add("demo", "acwm_zoo.demo:demo", summary="simulate, train, evaluate and report")
    registry.add("ship", "acwm_zoo.commands:ship", summary="package a run as a small trained model")
    registry.add("push", "acwm_zoo.commands:push", summary="publish a run on the Hugging Face Hub")
    registry.add(
        "import-checkpoint",
        "acwm_zoo.import_checkpoint:import_checkpoint",
        summary="make a run folder of a published checkpoint",
        after="fit",
    )


@hookimpl
def register_kinds(registry: Registry) -> None:
    """Add the kind of component that reads checkpoints of other programs."""
    registry.add(
        "importer",
        "acwm_zoo.importer:CheckpointImporter",
        summary="reads checkpoints of other programs",
        check="acwm_zoo.checks:check_importer",
    )


@hookimpl
def register_importers(registry: Registry) -> None:
    """Register the importer of published weights."""
    registry.add(
        "published_dit",
        "acwm_zoo.published_dit:PublishedCheckpoint",
        summary="training checkpoints of the published ACWM-DiT (latest.pt)",
    )
