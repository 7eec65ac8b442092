"""Register formats of datasets, and the commands `acwm data` and `acwm encode`."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_kinds(registry: Registry) -> None:
    """Add the kinds of component that read and write other formats."""
    registry.add(
        "dataset_importer",
        "acwm_core.data.formats:DatasetImporter",
        summary="reads datasets in another format",
        check="acwm_formats.checks:check_dataset_importer",
    )
    registry.add(
        "dataset_exporter",
        "acwm_core.data.formats:DatasetExporter",
        summary="writes datasets in another format",
        check="acwm_formats.checks:check_dataset_exporter",
    )


@hookimpl
def register_dataset_importers(registry: Registry) -> None:
    """Add importers for robot recordings, rollouts and the published release."""
    registry.add(
        "lerobot",
        "acwm_formats.lerobot_import:LeRobot",
        summary="a LeRobot dataset of version 3.0 or 2.x",
    )
    registry.add(
        "gymnasium",
        "acwm_formats.rollouts:Gymnasium",
        summary="rollouts of a Gymnasium environment",
    )
    registry.add(
        "acwm-phys",
        "acwm_formats.published:Published",
        summary="the published ACWM-Phys release, or anything in its layout",
    )


@hookimpl
def register_dataset_exporters(registry: Registry) -> None:
    """Add two exporters with visually lossless video, and one that is bit-exact."""
    registry.add(
        "lerobot",
        "acwm_formats.lerobot_export:LeRobotExporter",
        summary="a LeRobot dataset of version 3.0, visually lossless",
    )
    registry.add(
        "acwm-phys",
        "acwm_formats.published:PublishedExporter",
        summary="the layout of the published release, visually lossless",
    )
    registry.add(
        "hdf5",
        "acwm_formats.hdf5:HDF5Exporter",
        summary="a file per split with every bit and the ground truth",
        extra="hdf5",
        requires=("h5py",),
    )


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the commands, after `generate`."""
    registry.add(
        "data",
        "acwm_formats.commands:data",
        summary="inspect, check, import and export datasets",
        after="generate",
    )
    registry.add(
        "encode",
        "acwm_formats.encoding:encode",
        summary="encode the clips of a dataset as latents",
        after="data",
    )
