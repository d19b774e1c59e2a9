"""What can be chosen about training."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING

__all__ = ["TrainingConfig"]


@dataclass
class TrainingConfig:
    name: str = MISSING
    """Name of the preset."""
    steps: int = MISSING
    """Optimiser steps."""
    poses_per_step: int = MISSING
    """Frames in one step."""
    uniform_points: int = MISSING
    """Points of a frame from the uniform half of its samples."""
    surface_points: int = MISSING
    """Points of a frame from the near-surface half of its samples."""
    far_points: int = MISSING
    """Points of a frame drawn in the canonical cells; those that it moves out of the cube of its samples are outside."""
    fresh_points: bool = MISSING
    """Draw and label new points in every step, from the meshes in the store, instead of choosing among the stored points."""
    workers: int | None = MISSING
    """Processes that make fresh points ahead of time; null: as the cores allow; 0: none. The avatar does not depend on it."""
    learning_rate: float = MISSING
    """Highest learning rate of Adam."""
    final_learning_rate: float = MISSING
    """Learning rate at the end, as a share of the highest; reached along a cosine, 1 keeps it constant."""
    warmup_steps: int = MISSING
    """Steps in which the learning rate rises from zero."""
    average_decay: float = MISSING
    """Decay a step of the exponential moving average of the weights that becomes the avatar; 0 takes the last weights."""
    bootstrap_steps: int = MISSING
    """First steps with the two bootstrapping losses (one epoch in the papers; SNARF Sec. 3.3)."""
    bone_occupancy_weight: float = MISSING
    """Weight of the loss that fills the bones."""
    bone_points: int = MISSING
    """Points on every bone for that loss."""
    joint_weight: float = MISSING
    """Weight of the loss on the skinning weights at the joints."""
    joint_target: str = MISSING
    """Wanted weights at a joint: halves (own bone and parent, SNARF), parent (Fast-SNARF) or own (the released code)."""
    refresh_cells_every: int = MISSING
    """Steps between two looks at where the learned shape is and so which cells are searched; 0 stays with the first ones."""
    precision: str = MISSING
    """Arithmetic of the shape network: highest, high, medium or bfloat16; the search is always in full float32."""
    validate_every: int = MISSING
    """Steps between two validations."""
    validation_frames: int = MISSING
    """Held-back frames in one validation."""
    checkpoint_every: int = MISSING
    """Steps between two checkpoints."""
