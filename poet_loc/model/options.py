"""What a pose network is made of: one frozen record, saved beside its weights.

The defaults are the published setting (5 + 5 layers, 16 heads); the ablations of the paper are `ABLATIONS`.
The variants that the faithful network does not have are the last group of fields; their defaults switch them off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args, get_origin, get_type_hints

from poet_loc.core.input_error import InputError, at_least

Rotation = Literal["6d", "quat", "silho_quat"]
Uncertainty = Literal["none", "aleatoric", "full"]


@dataclass(frozen=True)
class NetworkOptions:
    """Everything that the weights of a pose network depend on."""

    hidden_dim: int = 256
    """Width d of every token; a multiple of 32 and of `heads`."""
    heads: int = 16
    """Attention heads M; not recoverable from the weights."""
    encoder_layers: int = 5
    decoder_layers: int = 5
    feedforward_dim: int = 1024
    levels: int = 4
    """Feature levels L; those beyond the backbone's maps are 3x3, stride-2 convolutions of its last one."""
    encoder_points: int = 4
    """Samples per head and level in the encoder."""
    decoder_points: int = 4
    dropout: float = 0.1
    queries: int = 10
    """Object queries per image; dummies fill the rest and take part in self-attention, so it changes results."""
    map_channels: tuple[int, ...] = (256, 512, 1024)
    """Channels of the backbone's maps."""
    map_strides: tuple[int, ...] = (8, 16, 32)
    """Pixels per cell of the backbone's maps; for the record, the network does not read them."""
    class_count: int = 21
    """Object classes, without the background slot 0."""
    class_mode: Literal["specific", "agnostic"] = "specific"
    """specific: heads have one output slot per class, and slot 0."""
    rotation: Rotation = "6d"
    """Two columns (Zhou et al. 2019), or a unit quaternion w, x, y, z with one of two losses."""
    query_embedding: Literal["bbox", "learned"] = "bbox"
    """Queries from the encoded box, or a learned table (ablation Q)."""
    reference_points: Literal["bbox", "learned"] = "bbox"
    """Box centres, or a learned projection of the query (ablation RP)."""
    position_encoding: Literal["sine", "learned"] = "sine"
    """learned has 50 rows and 50 columns and refuses larger maps."""
    uncertainty: Uncertainty = "none"
    """aleatoric: log variance per camera axis (official); full: Cholesky factor of a 3x3 covariance each."""

    encoder_maps: tuple[int, ...] | None = None
    """Levels that pass through the encoder; the others go projected to the decoder. None: all."""
    query_features: Literal["none", "roi"] = "none"
    """roi: features aligned to the box are added to the query's content."""
    box_octaves: int | None = None
    """Frequencies of the box code that are kept, from the lowest; None: all. The upper ones change with the last digit
    of a box, so they are noise wherever boxes are."""
    reference_spread: Literal["point", "box"] = "point"
    """box: sampling offsets are in units of the box size instead of cells."""
    translation: Literal["direct", "ray"] = "direct"
    """ray: shift from the box centre's ray and a depth scaled by box size and focal length; needs intrinsics."""
    rotation_frame: Literal["camera", "allocentric"] = "camera"
    """allocentric: rotation seen along the ray to the object; needs intrinsics."""

    def __post_init__(self) -> None:
        at_least(0, self, "encoder_layers", "dropout")
        sizes = ("heads", "decoder_layers", "feedforward_dim", "levels", "encoder_points", "decoder_points")
        at_least(1, self, "hidden_dim", "queries", "class_count", *sizes)
        for name, kind in get_type_hints(type(self)).items():
            if get_origin(kind) is Literal and getattr(self, name) not in get_args(kind):
                raise InputError(f"{name} is {getattr(self, name)!r}", fix=f"one of {', '.join(get_args(kind))}")
        if self.hidden_dim % 32 or self.hidden_dim % self.heads:
            raise InputError(f"hidden_dim {self.hidden_dim} must be a multiple of 32 and of heads ({self.heads})")
        if self.uncertainty != "none" and self.rotation != "6d":
            raise InputError(f"uncertainty {self.uncertainty} is defined for rotation 6d, not {self.rotation}")
        if len(self.map_channels) != len(self.map_strides):
            raise InputError(f"{len(self.map_channels)} map_channels for {len(self.map_strides)} map_strides")
        if self.levels < len(self.map_channels):
            raise InputError(f"{len(self.map_channels)} backbone maps for {self.levels} levels")
        if self.encoder_maps is not None and not set(self.encoder_maps) <= set(range(self.levels)):
            raise InputError(f"encoder_maps {self.encoder_maps} names a level beyond {self.levels - 1}")

    @property
    def slots(self) -> int:
        """Output slots of a head: one per class and the background's, or one."""
        return self.class_count + 1 if self.class_mode == "specific" else 1

    @property
    def rotation_dim(self) -> int:
        """Numbers per rotation: 6, or 4 for quaternions."""
        return 6 if self.rotation == "6d" else 4

    @property
    def needs_intrinsics(self) -> bool:
        """Whether poses are decoded with the camera's focal lengths and centre."""
        return self.translation == "ray" or self.rotation_frame == "allocentric"


PUBLISHED = NetworkOptions()
ABLATIONS: dict[str, NetworkOptions] = {
    "PoET": PUBLISHED,
    "RP": replace(PUBLISHED, reference_points="learned"),
    "Q": replace(PUBLISHED, query_embedding="learned"),
    "RP + Q": replace(PUBLISHED, reference_points="learned", query_embedding="learned"),
    "Small": replace(PUBLISHED, encoder_layers=3, decoder_layers=3, heads=8),
    "Agnostic": replace(PUBLISHED, class_mode="agnostic"),
    "Quaternion": replace(PUBLISHED, rotation="quat"),
    "Silhouette quaternion": replace(PUBLISHED, rotation="silho_quat"),
}
"""The paper's ablations by name (Jantos et al., CoRL 2022, section 4.3), each as the options that make it.

The sizes of Small, 3 + 3 layers and 8 heads, are ours: published checkpoints tell their own.
"""
