"""Registers the metrics."""

from acwm_core.plugins import Registry, hookimpl

PIXELS = {
    "mse": ("pixel:MSE", "mean squared error of all pixels"),
    "m_mse": ("pixel:MaskedMSE", "squared error weighted by true motion"),
    "psnr": ("pixel:PSNR", "peak signal-to-noise ratio, errors pooled"),
    "psnr_mean": ("pixel:MeanPSNR", "mean of the clips' PSNR values"),
    "ssim": ("pixel:SSIM", "structural similarity, 7×7 windows"),
    "response": ("response:Response", "response to other actions, 1 for the simulator's own"),
}
"""Metrics of pixels: target and summary by name."""

PHYSICS = {
    "position_error": ("pose:PositionError", "distance of bodies from their true places, m"),
    "position_error_px": ("pose:PixelPositionError", "position error in the image, pixels"),
    "orientation_error": (
        "pose:OrientationError",
        "angle between predicted and true orientations, rad",
    ),
    "sharpness": ("sharpness:Sharpness", "gradients within objects, 1 for as sharp as the truth"),
    "colour_error": ("objects:ColourError", "difference of the mean colours of objects"),
    "mask_iou": ("shape:MaskIoU", "overlap of predicted and true masks"),
    "outline_error": ("shape:OutlineError", "distance of outlines of rope, cloth, sand, water"),
    "height_error": ("shape:HeightError", "height error of sand or water, m"),
    "permanence": ("conservation:Permanence", "frames in which every object is there once"),
    "permanence_after_contact": (
        "objects:PermanenceAfterContact",
        "permanence from the first contact on",
    ),
    "object_count_error": ("objects:ObjectCountError", "objects too many or too few"),
    "length_error": ("conservation:LengthError", "relative change of links and ropes"),
    "amount_error": ("conservation:AmountError", "relative change of water or sand"),
    "penetration": ("conservation:Penetration", "how deep solid bodies overlap, m"),
    "violations": ("conservation:Violations", "share of clips with something impossible"),
    "contact_precision": ("contact:ContactPrecision", "share of predicted contacts that are true"),
    "contact_recall": ("contact:ContactRecall", "share of true contacts that are predicted"),
    "contact_timing": ("contact:ContactTiming", "error of when contacts begin, s"),
    "contact_timing_frames": (
        "contact:ContactTimingInFrames",
        "error of when contacts begin, frames",
    ),
}
"""Metrics that read the video with an estimator: target and summary by name."""

DRAWS = {
    "energy_score": ("draws:EnergyScore", "distance of draws to the truth, less to each other"),
    "spread_skill": (
        "draws:SpreadSkill",
        "spread of draws over error of their mean; 1 is right",
    ),
    "coverage_50": ("draws:Coverage50", "share of positions in the 50 % interval of draws"),
    "coverage_80": ("draws:Coverage80", "share of positions in the 80 % interval of draws"),
    "coverage_95": ("draws:Coverage95", "share of positions in the 95 % interval of draws"),
}
"""Metrics that judge several draws of a clip together: target and summary by name."""

PERCEPTUAL = {
    "lpips": ("lpips:LPIPS", "learned perceptual distance; needs weights"),
    "fvd": ("fvd:FVD", "Fréchet distance of sets of videos; needs weights"),
}
"""Metrics whose network weights come from the user: target and summary by name."""

LIBRARIES = {
    "torchmetrics": ("torchmetrics:TorchMetric", "any metric of pictures, by its dotted name"),
}
"""Adapters for the metrics of a library: target and summary by the library's package."""


@hookimpl
def register_metrics(registry: Registry) -> None:
    """Register metrics of pixels, as in ACWM-Phys (arXiv 2605.08567), of physics and of draws."""
    known = PIXELS | PHYSICS | DRAWS | PERCEPTUAL | LIBRARIES
    for name, (target, summary) in known.items():
        registry.add(name, f"acwm_metrics.{target}", summary=summary)
