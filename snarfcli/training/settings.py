"""Training configuration."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING

__all__ = ["TrainingConfig"]


@dataclass
class TrainingConfig:
    name: str = MISSING
    """Name of the preset."""
    steps: int = MISSING
    """Number of optimiser steps."""
    poses_per_step: int = MISSING
    """Number of frames per step."""
    uniform_points: int = MISSING
    """Number of points per frame from the uniform half of its samples."""
    surface_points: int = MISSING
    """Number of points per frame from the near-surface half of its samples."""
    far_points: int = MISSING
    """Number of points per frame drawn in the canonical cells; if posed outside the sampling cube, they count as outside."""
    agreement_weight: float = MISSING
    """Weight of the loss that keeps the canonical shape in made-up poses like that in training poses, where these agree."""
    agreement_points: int = MISSING
    """Number of canonical points for that loss."""
    agreement_every: int = MISSING
    """Steps from one with that loss to the next."""
    fresh_points: bool = MISSING
    """Whether every step draws and labels new points from the stored meshes, instead of choosing among the stored points."""
    workers: int | None = MISSING
    """Number of processes that make fresh points ahead of time; null: by the number of cores. Does not change the avatar."""
    graph: str = MISSING
    """Whether steps have fixed shapes and run as CUDA graphs: auto (on CUDA devices), on (fixed shapes on every device) or off.
    Does not change the avatar beyond rounding and other random numbers."""
    learning_rate: float = MISSING
    """Maximum learning rate of Adam."""
    feature_rate: float = MISSING
    """Learning rate of feature grids, as a multiple of that of the networks."""
    final_learning_rate: float = MISSING
    """Learning rate at the end as a share of the maximum, reached along a cosine; 1 keeps it constant."""
    warmup_steps: int = MISSING
    """Number of first steps in which the learning rate rises from zero."""
    average_decay: float = MISSING
    """Decay per step of the exponential moving average of the weights, which becomes the avatar; 0 uses the last weights."""
    bootstrap_steps: int = MISSING
    """Number of first steps with the two bootstrapping losses (one epoch in the papers; SNARF Sec. 3.3)."""
    bone_occupancy_weight: float = MISSING
    """Weight of the loss that fills the bones."""
    bone_points: int = MISSING
    """Number of points per bone for that loss."""
    joint_weight: float = MISSING
    """Weight of the loss on the skinning weights at the joints."""
    joint_target: str = MISSING
    """Target weights at a joint: halves (own bone and parent, SNARF), parent (Fast-SNARF) or own (the released code)."""
    refresh_cells_every: int = MISSING
    """Steps between two updates of the searched cells from the learned shape; 0 keeps the first cells."""
    extend_weights_every: int = MISSING
    """Steps between two replacements of the skinning weights at nodes away from the surface by harmonic ones; 0 never. Only for
    skinning=voxel."""
    refine_poses: bool = MISSING
    """Whether to correct the joint angles and the place of every frame while training, for poses that are only nearly right."""
    precision: str = MISSING
    """Arithmetic of the shape network: highest, high, medium or bfloat16; the search is always in full float32."""
    validate_every: int = MISSING
    """Steps between two validations."""
    validation_frames: int = MISSING
    """Number of held-back frames per validation."""
    validation_ood_frames: int = 0
    """Number of out-of-distribution frames that a validation measures too, for curves; nothing depends on them."""
    checkpoint_every: int = MISSING
    """Steps between two checkpoints."""
