"""PoET: 6D poses of detected objects from multi-scale features (T. Jantos et al., "PoET", CoRL 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from poet_loc.core.input_error import InputError
from poet_loc.model.backbone import Backbone, Features, ImageBatch, mask_of_level
from poet_loc.model.heads import heads_per_layer, pick_class, rotation_from_6d, rotation_matrices
from poet_loc.model.options import NetworkOptions
from poet_loc.model.position_encoding import LearnedPositionEncoding, SinePositionEncoding, box_code
from poet_loc.model.queries import DUMMY_CODE, QueryBoxes, queries_from_detections, real_queries
from poet_loc.model.refiner import Estimates, PoseRefiner
from poet_loc.model.transformer import DeformableTransformer, Tokens


@dataclass(frozen=True)
class PoseOutput:
    """Poses T_cam_obj of every query, dummies included; `queries` says which are real."""

    translation: Tensor
    """(B, Q, 3) m in camera axes."""
    rotation: Tensor
    """(B, Q, 3, 3) matrices, or (B, Q, 4) unit quaternions w, x, y, z."""
    queries: QueryBoxes
    translation_uncertainty: Tensor | None = None
    """(B, Q, 3) log variances (m^2) per camera axis, or (B, Q, 6) Cholesky numbers."""
    rotation_uncertainty: Tensor | None = None
    """The same for the rotation vector e_r of R_predicted = Exp(e_r) R_true (rad^2), camera axes."""
    auxiliary: tuple[PoseOutput, ...] = ()
    """What the earlier decoder layers say, in order; in training only."""


@dataclass(frozen=True)
class QueryContext:
    """What a pose decoder may use besides the heads' numbers."""

    boxes: Tensor
    """(B, Q, 4) cx, cy, w, h in shares of the image."""
    classes: Tensor
    """(B, Q)."""
    image_size: tuple[int, int]
    """(H, W) px."""
    intrinsics: Tensor | None
    """(B, 4) fx, fy, cx, cy px."""


class PoET(nn.Module):
    """The pose network, with a detector as its first part or fed with feature maps and boxes.

    The state dict has the official names; `backbone.0` is the detector, `backbone.1` the position encoding.
    """

    def __init__(
        self, options: NetworkOptions, detector: Backbone | None = None, refiner: PoseRefiner | None = None
    ) -> None:
        super().__init__()
        self.options = options
        self.refiner = refiner
        dim = options.hidden_dim
        encoding = SinePositionEncoding if options.position_encoding == "sine" else LearnedPositionEncoding
        if detector is not None:
            detector.requires_grad_(False)
        self.backbone = nn.ModuleList([nn.Identity() if detector is None else detector, encoding(dim)])
        self.input_proj = _input_projections(options)
        self.transformer = DeformableTransformer(options)
        if options.query_embedding == "learned":
            self.query_embed = nn.Embedding(options.queries, 2 * dim)
        layers, slots = options.decoder_layers, options.slots
        self.translation_head = heads_per_layer(dim, 3 * slots, layers)
        self.rotation_head = heads_per_layer(dim, options.rotation_dim * slots, layers)
        if options.uncertainty == "aleatoric":
            self.translation_head_aleatoric = heads_per_layer(dim, 3 * slots, layers)
            self.rotation_head_aleatoric = heads_per_layer(dim, 3 * slots, layers)
        elif options.uncertainty == "full":
            self.translation_head_covariance = heads_per_layer(dim, 6 * slots, layers)
            self.rotation_head_covariance = heads_per_layer(dim, 6 * slots, layers)
        if options.query_features == "roi":
            from poet_loc.model.variants import RoiQueryFeatures

            self.roi_features = RoiQueryFeatures(options)

    @property
    def detector(self) -> Backbone:
        """The detector under the network.  Raises ValueError where there is none."""
        detector = self.backbone[0]
        if not isinstance(detector, Backbone):
            raise ValueError("this network has no detector: give it features and boxes")
        return detector

    def train(self, mode: bool = True) -> PoET:
        """Switch dropout; the detector stays in evaluation mode."""
        super().train(mode)
        self.backbone[0].eval()
        return self

    def forward(self, batch: ImageBatch, queries: QueryBoxes | None = None) -> PoseOutput:
        """Find objects in a batch and estimate their poses; with queries, the boxes are taken from there."""
        features = self.extract(batch)
        if queries is None:
            with torch.no_grad():
                queries = self.detected_queries(features)
        output = self.poses(features, batch.mask, queries, batch.intrinsics)
        return output if self.training else self.refined(batch, output)

    def refined(self, batch: ImageBatch, output: PoseOutput) -> PoseOutput:
        """Return the poses after the refiner's rounds of comparing them with the images; without one as they are."""
        if self.refiner is None:
            return output
        if batch.intrinsics is None:
            raise ValueError("a refiner needs intrinsics")
        real = real_queries(output.queries)
        rotation = rotation_matrices(output.rotation).clone()
        start = Estimates(
            torch.nonzero(real)[:, 0], output.queries.classes[real], output.translation[real], rotation[real]
        )
        end = self.refiner(batch.images, batch.intrinsics, start)
        translation, log_variance = output.translation.clone(), torch.zeros(*real.shape, 6, device=real.device)
        translation[real], rotation[real], log_variance[real] = end.translation, end.rotation, end.log_variance
        return PoseOutput(translation, rotation, output.queries, log_variance[..., :3], log_variance[..., 3:])

    def refine_in(self, rounds: int | None) -> None:
        """Set the refiner's rounds; 0: no refiner, None: as it was made.  Raises InputError where there is none."""
        if rounds == 0:
            self.refiner = None
        elif rounds is not None:
            if self.refiner is None:
                raise InputError("this network has no refiner", fix="leave out --rounds")
            self.refiner.options = replace(self.refiner.options, rounds=rounds)

    def extract(self, batch: ImageBatch) -> Features:
        """Return the detector's feature maps; without gradients unless the detector has trainable parameters."""
        trains = torch.is_grad_enabled() and any(p.requires_grad for p in self.detector.parameters())
        with torch.set_grad_enabled(trains):
            return self.detector.extract(batch)

    def detected_queries(self, features: Features) -> QueryBoxes:
        """Return the detector's boxes as queries."""
        device = features.maps[0].device
        return queries_from_detections(
            self.detector.detect(features), features.image_size, self.options.queries, device
        )

    def poses(
        self, features: Features, image_mask: Tensor, queries: QueryBoxes, intrinsics: Tensor | None = None
    ) -> PoseOutput:
        """Estimate the poses of boxes in feature maps; image_mask (B, H, W) is True where padded."""
        tokens = self.tokens(features.maps, image_mask)
        memory = self.transformer.encode(tokens)
        position, content = self.query_codes(queries)
        if self.options.query_features == "roi":
            content = content + self.roi_features(features.maps, queries)
        states = self.transformer.decode(memory, tokens, content, position, queries.boxes)
        context = QueryContext(queries.boxes, queries.classes, features.image_size, intrinsics)
        return self.read_out(states, queries, context)

    def tokens(self, maps: Sequence[Tensor], image_mask: Tensor) -> Tokens:
        """Project feature maps to the network's width, add the extra levels, and lay them out as tokens."""
        projected = self.project(maps)
        masks = [mask_of_level(image_mask, level_map.shape[-2:]) for level_map in projected]
        return self.transformer.tokens(projected, masks, [self.backbone[1](mask) for mask in masks])

    def project(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Return every level (B, d, h, w): the first extra one reads the raw last map, later ones the level before."""
        projected: list[Tensor] = []
        for level, projection in enumerate(self.input_proj):
            extra = maps[-1] if level == len(maps) else projected[-1] if projected else maps[-1]
            projected.append(projection(maps[level] if level < len(maps) else extra))
        return projected

    def query_codes(self, queries: QueryBoxes) -> tuple[Tensor, Tensor]:
        """Return position and content (B, Q, d) of the queries."""
        if self.options.query_embedding == "learned":
            count = queries.boxes.shape[1]
            if count != self.options.queries:
                raise InputError(f"{count} boxes in an image for {self.options.queries} learned queries")
            table = self.query_embed.weight[None].expand(len(queries.boxes), -1, -1)
            position, content = table.chunk(2, dim=-1)
            return position, content
        code = box_code(queries.boxes, self.options.hidden_dim, self.options.box_octaves)
        code = torch.where(real_queries(queries)[..., None], code, torch.full_like(code, DUMMY_CODE))
        return code, code

    def read_last(self, state: Tensor, queries: QueryBoxes, context: QueryContext) -> PoseOutput:
        """Turn the last decoder state (B, Q, d) into poses."""
        return self._read_layer(len(self.translation_head) - 1, state, queries, context)

    def read_out(self, states: Tensor, queries: QueryBoxes, context: QueryContext) -> PoseOutput:
        """Turn decoder states (layers, B, Q, d) into poses: of all layers in training, else of the last.

        Always in float32: bfloat16 has three digits, a pose needs more.
        """
        last = len(states) - 1
        with torch.autocast(states.device.type, enabled=False):
            states = states.float()
            final = self._read_layer(last, states[last], queries, context)
            if not self.training:
                return final
            earlier = tuple(self._read_layer(i, states[i], queries, context) for i in range(last))
            return replace(final, auxiliary=earlier)

    def _read_layer(self, layer: int, state: Tensor, queries: QueryBoxes, context: QueryContext) -> PoseOutput:
        def read(heads: nn.ModuleList) -> Tensor:
            return pick_class(heads[layer](state), queries.classes, self.options.slots)

        translation, rotation = self._decode_pose(read(self.translation_head), read(self.rotation_head), context)
        kind = {"none": None, "aleatoric": "aleatoric", "full": "covariance"}[self.options.uncertainty]
        if kind is None:
            return PoseOutput(translation, rotation, queries)
        uncertainties = [read(getattr(self, f"{quantity}_head_{kind}")) for quantity in ("translation", "rotation")]
        return PoseOutput(translation, rotation, queries, uncertainties[0], uncertainties[1])

    def _decode_pose(self, raw_t: Tensor, raw_r: Tensor, context: QueryContext) -> tuple[Tensor, Tensor]:
        if self.options.rotation == "6d":
            rotation = rotation_from_6d(raw_r)
        else:
            rotation = nn.functional.normalize(raw_r, p=2.0, dim=-1)
        translation = raw_t
        if self.options.translation == "ray":
            from poet_loc.model.variants import translation_along_ray

            translation = translation_along_ray(raw_t, context)
        if self.options.rotation_frame == "allocentric":
            from poet_loc.model.variants import egocentric_rotation

            rotation = egocentric_rotation(rotation, translation)
        return translation, rotation


def _input_projections(options: NetworkOptions) -> nn.ModuleList:
    dim, channels = options.hidden_dim, options.map_channels
    projections = []
    for level in range(options.levels):
        if level < len(channels):
            conv = nn.Conv2d(channels[level], dim, kernel_size=1)
        else:
            inputs = channels[-1] if level == len(channels) else dim
            conv = nn.Conv2d(inputs, dim, kernel_size=3, stride=2, padding=1)
        nn.init.xavier_uniform_(conv.weight)
        nn.init.zeros_(conv.bias)  # type: ignore[arg-type]
        projections.append(nn.Sequential(conv, nn.GroupNorm(32, dim)))
    return nn.ModuleList(projections)
