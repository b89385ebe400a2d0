"""The checkpoint that comes with the package."""

from __future__ import annotations

from pathlib import Path

from poet_loc.core.input_error import InputError
from poet_loc.model.checkpoint import ModelConfig, load_model
from poet_loc.model.poet import PoET

EMBEDDED_WEIGHTS = Path(__file__).resolve().parents[1] / "weights" / "embedded.safetensors"
"""Small detector and pose network of the ten rendered household objects; embedded.md beside it is its model card."""


def load_embedded() -> tuple[PoET, ModelConfig]:
    """Return the embedded network and its configuration.  Raises InputError where the package came without it."""
    if not EMBEDDED_WEIGHTS.exists():
        raise InputError(
            "this installation has no embedded weights", fix="give --weights, or train the preset embedded"
        )
    return load_model(EMBEDDED_WEIGHTS)
