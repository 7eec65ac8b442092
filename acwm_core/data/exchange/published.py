"""The layout of the published ACWM-Phys release (arXiv:2605.08567): names and places.

ROOT/CATEGORY/ENVIRONMENT/{ind_train,ind_test,ood_test}/episode_{i}.mp4
                                                        metadata.pt
"""

from __future__ import annotations

from acwm_core.episode import Split

CITATION = "ACWM-Phys, arXiv:2605.08567"
METADATA = "metadata.pt"
PARTS = "metadata_part_*.pt"

FOLDERS: dict[str, Split] = {
    "ind_train": "train",
    "ind_test": "ind_test",
    "ood_test": "ood_test",
}
"""The folder of each split."""

PLACES = {
    "push_cube": ("rigid_dynamics", "push_block"),
    "push_cube_two_pushers": ("rigid_dynamics", "pushcube_2"),
    "stack_cube": ("rigid_dynamics", "stack_cube"),
    "push_rope": ("deformable", "push_rope"),
    "cloth_move": ("deformable", "clothmove"),
    "push_sand": ("particle", "push_sand"),
    "pour_water": ("particle", "pour_water"),
    "robot_arm": ("kinematics", "robot_arm_64"),
    "reacher": ("kinematics", "reacher"),
}
"""Category and folder of an environment, by the name under which acwm knows it."""

ENVIRONMENTS = {folder: name for name, (_, folder) in PLACES.items()}
"""The name of an environment by its folder."""
