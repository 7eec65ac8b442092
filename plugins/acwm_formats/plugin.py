"""Register formats of datasets, and the commands `acwm data` and `acwm encode`."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_kinds(registry: Registry) -> None:
    """Add the kind of component that reads and writes other formats."""
    registry.add(
        "format",
        "acwm_formats.format:Format",
        summary="reads and writes datasets in another format",
        check="acwm_formats.checks:check_format",
    )


@hookimpl
def register_formats(registry: Registry) -> None:
    """Add formats of robot recordings, rollouts, the published release, and of every bit."""
    registry.add(
        "lerobot",
        "acwm_formats.lerobot:LeRobot",
        summary="a LeRobot dataset of version 3.0 or 2.x; written as 3.0, visually lossless",
    )
    registry.add(
        "gymnasium",
        "acwm_formats.rollouts:Gymnasium",
        summary="rollouts of a Gymnasium environment; only read",
    )
    registry.add(
        "acwm-phys",
        "acwm_formats.published:Published",
        summary="the layout of the published ACWM-Phys release; written visually lossless",
    )
    registry.add(
        "hdf5",
        "acwm_formats.hdf5:HDF5",
        summary="a file per split with every bit and the ground truth; only written",
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
