"""Registers the metrics."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_metrics(registry: Registry) -> None:
    """The pixel metrics of ACWM-Phys (arXiv 2605.08567), and a second pooling of PSNR."""
    registry.add("mse", "acwm_metrics.pixel:MSE", summary="mean squared error of all pixels")
    registry.add(
        "m_mse", "acwm_metrics.pixel:MaskedMSE", summary="squared error weighted by true motion"
    )
    registry.add(
        "psnr", "acwm_metrics.pixel:PSNR", summary="peak signal-to-noise ratio, errors pooled"
    )
    registry.add(
        "psnr_mean", "acwm_metrics.pixel:MeanPSNR", summary="mean of the clips' PSNR values"
    )
    registry.add("ssim", "acwm_metrics.ssim:SSIM", summary="structural similarity, 7×7 windows")
    registry.add(
        "response",
        "acwm_metrics.response:Response",
        summary="answers to other actions, 1 for the simulator's own",
    )
