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
    """Add formats of videos and arrays, robot recordings, rollouts, and the published release."""
    registry.add(
        "videos",
        "acwm_formats.videos:Videos",
        summary="a folder of videos or pictures, with tables of actions; read only",
    )
    registry.add(
        "lerobot",
        "acwm_formats.lerobot:LeRobot",
        summary="a LeRobot dataset of version 3.0 or 2.x; written as 3.0, visually losslessly",
    )
    registry.add(
        "gymnasium",
        "acwm_formats.rollouts:Gymnasium",
        summary="rollouts of a Gymnasium environment; read only",
    )
    registry.add(
        "acwm-phys",
        "acwm_formats.published:Published",
        summary="the layout of the published ACWM-Phys release; written visually losslessly",
    )
    registry.add(
        "hdf5",
        "acwm_formats.hdf5:HDF5",
        summary="robomimic, LIBERO, ACT/ALOHA, any other layout; written losslessly",
        extra="hdf5",
        requires=("h5py",),
    )


@hookimpl(specname="register_formats")
def register_formats_of_arrays(registry: Registry) -> None:
    """Add formats that need a library of their own."""
    registry.add(
        "zarr",
        "acwm_formats.zarr_replay:ZarrReplay",
        summary="a replay buffer as diffusion policy publishes it; read only",
        extra="zarr",
        requires=("zarr",),
    )
    registry.add(
        "minari",
        "acwm_formats.minari_datasets:Minari",
        summary="Minari datasets with images; read only",
        extra="minari",
        requires=("minari", "h5py"),
    )
    registry.add(
        "rlds",
        "acwm_formats.rlds:RLDS",
        summary="RLDS datasets of TensorFlow Datasets, as Open X-Embodiment; read only",
        extra="rlds",
        requires=("google_crc32c", "google.protobuf"),
    )
    registry.add(
        "mcap",
        "acwm_formats.mcap_logs:MCAP",
        summary="logs with images or video and a topic of numbers; read only",
        extra="mcap",
        requires=("mcap", "mcap_ros2", "mcap_protobuf"),
    )


@hookimpl
def register_advisors(registry: Registry) -> None:
    """Add what the recipe `small` asks."""
    registry.add(
        "data_report",
        "acwm_formats.survey.advice:advice_for",
        summary="by what moves in recordings",
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
