"""The hooks a plugin may implement, one per kind of component.

A plugin is any module or object named in the entry-point group ``acwm``::

    from acwm_core.hooks import hookimpl

    @hookimpl
    def register_environments(registry):
        registry.add("my_task", "my_package.my_task:MyTask", summary="…")
"""

import pluggy

from acwm_core.registry import Registry

PROJECT = "acwm"
"""Name of the pluggy project and of the entry-point group."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec(historic=True)
def register_environments(registry: Registry) -> None:
    """Add environments; targets are subclasses of `acwm_core.environment.Environment`."""


@hookspec(historic=True)
def register_codecs(registry: Registry) -> None:
    """Add codecs; targets are subclasses of `acwm_core.codec.Codec`."""


@hookspec(historic=True)
def register_models(registry: Registry) -> None:
    """Add dynamics models; targets are subclasses of `acwm_core.dynamics.DynamicsModel`."""


@hookspec(historic=True)
def register_conditioners(registry: Registry) -> None:
    """Add conditioners; targets are subclasses of `acwm_core.conditioner.Conditioner`."""


@hookspec(historic=True)
def register_metrics(registry: Registry) -> None:
    """Add metrics; targets are subclasses of `acwm_core.metric.Metric`."""


@hookspec(historic=True)
def register_estimators(registry: Registry) -> None:
    """Add estimators; targets are subclasses of `acwm_core.estimator.StateEstimator`.

    An estimator has the name of its environment.
    """


@hookspec(historic=True)
def register_importers(registry: Registry) -> None:
    """Add importers; targets are subclasses of `acwm_core.training.importer.CheckpointImporter`."""


@hookspec(historic=True)
def register_executors(registry: Registry) -> None:
    """Add executors; targets are subclasses of `acwm_core.executors.Executor`."""


@hookspec(historic=True)
def register_dataset_importers(registry: Registry) -> None:
    """Add formats to import; targets are subclasses of `acwm_core.data.formats.DatasetImporter`."""


@hookspec(historic=True)
def register_dataset_exporters(registry: Registry) -> None:
    """Add formats to export; targets are subclasses of `acwm_core.data.formats.DatasetExporter`."""


@hookspec(historic=True)
def register_protocols(registry: Registry) -> None:
    """Add protocols; targets are subclasses of `acwm_core.evaluation.benchmark.Protocol`."""


@hookspec(historic=True)
def register_tables(registry: Registry) -> None:
    """Add published tables; targets return an `acwm_core.evaluation.benchmark.PublishedTable`."""


@hookspec(historic=True)
def register_trained_models(registry: Registry) -> None:
    """Add trained models, or sources of them; targets return the `Path` of a run folder.

    For a request ``NAME://ADDRESS``, the target gets the parameter ``address``.
    """


@hookspec(historic=True)
def register_gymnasium_environments(registry: Registry) -> None:
    """Add ``acwm/NAME-v0``; targets are `gymnasium.Env`s, whose `vector` serves `make_vec`."""


@hookspec(historic=True)
def register_tasks(registry: Registry) -> None:
    """Add tasks to environments of other plugins as ``ENVIRONMENT.TASK``; targets are `Task`s."""


@hookspec(historic=True)
def register_planners(registry: Registry) -> None:
    """Add planners; targets are subclasses of `acwm_core.planning.planner.Planner`."""


@hookspec(historic=True)
def register_costs(registry: Registry) -> None:
    """Add planning costs; targets are subclasses of `acwm_core.planning.planner.Cost`."""


@hookspec(historic=True)
def register_drivers(registry: Registry) -> None:
    """Add who can drive; targets are subclasses of `acwm_core.planning.planner.Driver`."""


@hookspec(historic=True)
def register_commands(registry: Registry) -> None:
    """Add commands of ``acwm``; targets are click commands, whose modules import nothing heavy.

    ``after="evaluate"`` lists a command after that one, and ``after="acwm"`` before all others.
    `acwm experiment` ends with the command named ``report``, as ``report FOLDER --out FILE``.
    """


@hookspec(historic=True)
def register_completions(registry: Registry) -> None:
    """Add shell completions by argument name; targets are functions as click's `shell_complete`."""
