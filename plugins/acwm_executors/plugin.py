"""Register the executors for clusters."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_executors(registry: Registry) -> None:
    """Add Ray and SLURM."""
    registry.add(
        "ray",
        "acwm_executors.ray_cluster:RayExecutor",
        summary="a Ray cluster: executor.address=auto or HOST:PORT; else Ray is started here",
        extra="ray",
        requires=("ray",),
    )
    registry.add(
        "slurm",
        "acwm_executors.slurm:SlurmExecutor",
        summary="SLURM jobs: executor.sbatch='--partition=cpu --time=2:00:00'",
        extra="slurm",
        requires=("submitit",),
    )
