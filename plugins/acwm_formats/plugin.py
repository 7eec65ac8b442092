"""Register the importers and exporters of datasets in other formats."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


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
