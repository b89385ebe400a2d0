"""The same network for inference on a CPU: what training needs is left out, and what nobody reads is not computed.

Exact but for rounding:
- sampling reads offsets and weights as the projection wrote them, and keeps sums in registers (`fused_sampler`);
- offsets and weights come from one matrix product, the feed-forward part runs on rows that fit the cache;
- cross-attention interpolates the memory before it projects it, so 6,380 value projections become a few hundred
  (both are linear; what is padded or outside counts as zero, its bias included);
- the last encoder layer is computed for those tokens alone that the decoder reads;
- heads of earlier decoder layers are skipped, position codes are kept from image to image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from poet_loc.model.backbone import Features, ImageBatch
from poet_loc.model.deformable_attention import DeformableAttention, Shapes
from poet_loc.model.fused_sampler import corner_rows, level_table, run_in_threads, sum_rows
from poet_loc.model.poet import PoET, PoseOutput, QueryContext
from poet_loc.model.queries import QueryBoxes
from poet_loc.model.transformer import DecoderLayer, EncoderLayer, Tokens, encoder_references

Floats = NDArray[np.float32]
Precision = Literal["float32", "bfloat16"]
_ROWS = 512  # of the feed-forward part at a time
_FAST = {"contract", "nsz", "arcp", "reassoc"}


@numba.njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def _attend(value, levels, reference, offsets, weights, keep, out, width, first, last):  # type: ignore[no-untyped-def]
    """Sample projected values (S M D,) for the queries first..last into out (Q M D,).

    levels (3, K), reference (Q, L, 4), offsets (Q, 2 M K), weights (Q, M, K).  A sample lies at the reference's x, y
    (cells) plus offset times its w, h (cells).  `keep` (S,) is 0 for padded tokens, or empty.
    """
    _, heads, samples = weights.shape
    points = samples // reference.shape[1]
    depth = len(width)
    stride = np.int32(heads * depth)
    index = np.empty(4 * samples, np.int32)
    weight = np.empty(4 * samples, np.float32)
    seen = np.empty((4, samples), np.float32)
    for query in range(first, last):
        for i in range(samples):
            for k in range(4):
                seen[k, i] = reference[query, i // points, k]
        for head in range(heads):
            offset = np.int32(head * depth)
            column = 2 * head * samples
            for i in range(samples):
                x = seen[0, i] + offsets[query, column + 2 * i] * seen[2, i]
                y = seen[1, i] + offsets[query, column + 2 * i + 1] * seen[3, i]
                share = weights[query, head, i]
                corner_rows(x, y, share, levels[0, i], levels[1, i], levels[2, i], stride, offset, index, weight, 4 * i)
            if len(keep):
                for i in range(4 * samples):
                    weight[i] *= keep[index[i] // stride]
            sum_rows(out, query * heads * depth + offset, value, index, weight, samples, width)  # type: ignore[call-arg]


@numba.njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def _corner_table(levels, reference, offsets, weights, keep, rows, shares):  # type: ignore[no-untyped-def]
    """Write the token (Q, M, 4 K) and weight of every corner that cross-attention reads."""
    queries, heads, samples = weights.shape
    points = samples // reference.shape[1]
    index = np.empty(4, np.int32)
    weight = np.empty(4, np.float32)
    for query in range(queries):
        for head in range(heads):
            column = 2 * head * samples
            for i in range(samples):
                level = i // points
                x = reference[query, level, 0] + offsets[query, column + 2 * i] * reference[query, level, 2]
                y = reference[query, level, 1] + offsets[query, column + 2 * i + 1] * reference[query, level, 3]
                share = weights[query, head, i]
                corner_rows(x, y, share, levels[0, i], levels[1, i], levels[2, i], 1, 0, index, weight, 0)
                for corner in range(4):
                    row = index[corner]
                    rows[query, head, 4 * i + corner] = row
                    shares[query, head, 4 * i + corner] = weight[corner] * (keep[row] if len(keep) else np.float32(1))


@numba.njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def _gather(memory, rows, shares, out, totals):  # type: ignore[no-untyped-def]
    """Sum memory (S, d) over each head's corners -> out (Q, M, d), and the corners' weights -> totals (Q, M)."""
    queries, heads, corners = rows.shape
    width = memory.shape[1]
    for query in range(queries):
        for head in range(heads):
            total = out[query, head]
            total[:] = 0
            for i in range(corners):
                share = shares[query, head, i]
                if share != 0:
                    source = memory[rows[query, head, i]]
                    for c in range(width):
                        total[c] += share * source[c]
                    totals[query, head] += share


@dataclass(frozen=True)
class _Part:
    """Tokens that pass through the encoder, of one image."""

    positions: Tensor
    """(S, d)."""
    reference: Floats
    """(S, L, 4) x, y in cells of every level, and the unit of the offsets there."""
    keep: Floats
    """(S,) 0 where padded; empty where nothing is."""
    shapes: Shapes


class _Layer:
    """The weights of an encoder layer as the fast path wants them."""

    def __init__(self, layer: EncoderLayer, dtype: torch.dtype) -> None:
        attention = layer.self_attn
        self.heads, self.samples = attention.heads, attention.levels * attention.points
        self.points = attention.points
        self.value = _cast(attention.value_proj, dtype)
        self.where = _cast(_joined(attention), dtype)
        self.output = _cast(attention.output_proj, dtype)
        self.linear1, self.linear2 = _cast(layer.linear1, dtype), _cast(layer.linear2, dtype)
        self.norm1, self.norm2 = layer.norm1, layer.norm2
        self.dtype = dtype

    def values(self, x: Tensor) -> Tensor:
        """Project tokens (S, d) to what is sampled, float32."""
        return F.linear(x.to(self.dtype), *self.value).float()

    def refine(self, x: Tensor, positions: Tensor, reference: Floats, value: Tensor, part: _Part) -> Tensor:
        """Return tokens x (R, d) after the layer; `value` holds the projections of all tokens."""
        raw = F.linear((x + positions).to(self.dtype), *self.where).float()
        offsets, weights = _split(raw, self.heads, self.samples)
        sampled = torch.empty_like(x)
        width = (0,) * (x.shape[1] // self.heads)
        levels = level_table(tuple(part.shapes), self.points)
        arrays = (
            value.view(-1).numpy(),
            levels,
            reference,
            offsets,
            weights,
            part.keep,
            sampled.view(-1).numpy(),
            width,
        )
        run_in_threads(partial(_attend, *arrays), len(x), 64)
        x = self.norm1(x + F.linear(sampled.to(self.dtype), *self.output).float())
        out = torch.empty_like(x)
        for start in range(0, len(x), _ROWS):
            rows = x[start : start + _ROWS]
            hidden = F.linear(rows.to(self.dtype), *self.linear1).relu_()
            out[start : start + _ROWS] = self.norm2(rows + F.linear(hidden, *self.linear2).float())
        return out


class FastPoses:
    """`PoET.poses` in evaluation mode on a CPU; it holds the weights that the network had when it was made."""

    def __init__(self, network: PoET, precision: Precision = "float32") -> None:
        self.network = network.eval()
        self.dtype = {"float32": torch.float32, "bfloat16": torch.bfloat16}[precision]
        encoder = [layer for layer in network.transformer.encoder.layers if isinstance(layer, EncoderLayer)]
        self.layers = [_Layer(layer, self.dtype) for layer in encoder]
        self._positions: dict[tuple[tuple[int, int], ...], tuple[Tensor, Tensor]] = {}

    @torch.inference_mode()
    def __call__(self, batch: ImageBatch, queries: QueryBoxes | None = None) -> PoseOutput:
        """Do what the network does with a batch."""
        features = self.network.extract(batch)
        if queries is None:
            queries = self.network.detected_queries(features)
        return self.network.refined(batch, self.poses(features, batch.mask, queries, batch.intrinsics))

    @torch.inference_mode()
    def poses(
        self, features: Features, image_mask: Tensor, queries: QueryBoxes, intrinsics: Tensor | None = None
    ) -> PoseOutput:
        """Estimate the poses of boxes in feature maps."""
        network = self.network
        tokens = self.tokens(features, image_mask)
        position, content = network.query_codes(queries)
        if network.options.query_features == "roi":
            content = content + network.roi_features(features.maps, queries)
        references = network.transformer.references(position, queries.boxes, tokens.valid_ratios)
        states = [
            self._one_image(tokens, image, content[image], position[image], references[image])
            for image in range(len(content))
        ]
        context = QueryContext(queries.boxes, queries.classes, features.image_size, intrinsics)
        return network.read_last(torch.stack(states), queries, context)

    def tokens(self, features: Features, image_mask: Tensor) -> Tokens:
        """Return the tokens; position codes of images without padding are computed once."""
        if bool(image_mask.any()):
            return self.network.tokens(features.maps, image_mask)
        maps = self.network.project(features.maps)
        shapes = tuple((int(m.shape[-2]), int(m.shape[-1])) for m in maps)
        if shapes not in self._positions:
            tokens = self.network.tokens(features.maps, image_mask)
            self._positions[shapes] = tokens.positions[:1], tokens.valid_ratios[:1]
        positions, ratios = (known.expand(len(image_mask), *known.shape[1:]) for known in self._positions[shapes])
        values = torch.cat([m.flatten(2).transpose(1, 2) for m in maps], dim=1)
        return Tokens(values, positions, None, shapes, ratios)

    def _one_image(self, tokens: Tokens, image: int, content: Tensor, position: Tensor, references: Tensor) -> Tensor:
        """Return the last decoder state (Q, d) of one image."""
        memory = _Memory(self, tokens, image)
        cells = _in_cells(references[None], tokens.shapes, self.network.options.decoder_points)[0]
        x = content
        for layer in self.network.transformer.decoder.layers:
            assert isinstance(layer, DecoderLayer)
            x = layer.attend_to_queries(x[None], position[None])[0]
            x = layer.finish(x, memory.read(layer.cross_attn, x + position, cells))
        return x


class _Memory:
    """The encoder's output, of which the last layer is computed where it is read."""

    def __init__(self, fast: FastPoses, tokens: Tokens, image: int) -> None:
        self.shapes, self.keep = tokens.shapes, _kept(tokens, image)
        values = tokens.values[image].contiguous()
        chosen = fast.network.options.encoder_maps
        if not fast.layers or chosen == ():
            self.output, self.pending = values, np.zeros(len(values), bool)
            return
        whole, index = (tokens, None) if chosen is None else tokens.of_levels(chosen)
        cells = _in_cells(encoder_references(whole.shapes, whole.valid_ratios[image : image + 1]), whole.shapes, 0)[0]
        self.part = _Part(whole.positions[image], cells, _kept(whole, image), whole.shapes)
        x = whole.values[image].contiguous()
        for layer in fast.layers[:-1]:
            x = layer.refine(x, self.part.positions, cells, layer.values(x), self.part)
        self.last, self.before = fast.layers[-1], x
        self.value = self.last.values(x)
        self.output = values
        self.place = np.full(len(values), -1, np.int64)  # of each token in the encoder, -1: it does not pass through
        self.place[slice(None) if index is None else index.numpy()] = np.arange(len(x))
        self.pending = self.place >= 0

    def read(self, attention: DeformableAttention, query: Tensor, cells: Floats) -> Tensor:
        """Return what queries (Q, d) with reference cells (Q, L, 4) attend to, (Q, d)."""
        heads, samples = attention.heads, attention.levels * attention.points
        offsets, weights = _split(F.linear(query, *_joined(attention)), heads, samples)
        rows = np.empty((len(query), heads, 4 * samples), np.int64)
        shares = np.empty(rows.shape, np.float32)
        levels = level_table(tuple(self.shapes), attention.points)
        _corner_table(levels, cells, offsets, weights, self.keep, rows, shares)
        self._complete(np.unique(rows[shares != 0]))
        gathered = np.empty((len(query), heads, query.shape[1]), np.float32)
        totals = np.zeros((len(query), heads), np.float32)
        _gather(self.output.numpy(), rows, shares, gathered, totals)
        kernel = attention.value_proj.weight.unflatten(0, (heads, -1))  # (M, D, d)
        bias = attention.value_proj.bias.unflatten(0, (heads, -1))
        value = torch.einsum("qmd,mcd->qmc", torch.from_numpy(gathered), kernel)
        value = value + torch.from_numpy(totals)[..., None] * bias
        return attention.output_proj(value.flatten(1))

    def _complete(self, rows: NDArray[np.int64]) -> None:
        rows = rows[self.pending[rows]]
        if len(rows) == 0:
            return
        self.pending[rows] = False
        place = self.place[rows]
        at = torch.from_numpy(place)
        reference = np.ascontiguousarray(self.part.reference[place])
        refined = self.last.refine(self.before[at], self.part.positions[at], reference, self.value, self.part)
        self.output[torch.from_numpy(rows)] = refined


def _joined(attention: DeformableAttention) -> tuple[Tensor, Tensor]:
    """Offsets and weights as one projection."""
    parts = attention.sampling_offsets, attention.attention_weights
    return torch.cat([p.weight for p in parts]), torch.cat([p.bias for p in parts])


def _split(raw: Tensor, heads: int, samples: int) -> tuple[Floats, Floats]:
    """Return offsets (Q, 2 M K) and normalised weights (Q, M, K) of the joint projection (Q, 3 M K)."""
    weights = raw[:, 2 * heads * samples :].unflatten(1, (heads, samples)).softmax(-1)
    return raw[:, : 2 * heads * samples].numpy(), weights.numpy()


def _cast(layer: nn.Linear | tuple[Tensor, Tensor], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    weight, bias = (layer.weight, layer.bias) if isinstance(layer, nn.Linear) else layer
    return weight.detach().to(dtype), bias.detach().to(dtype)


def _kept(tokens: Tokens, image: int) -> Floats:
    if tokens.padding is None or not bool(tokens.padding[image].any()):
        return np.empty(0, np.float32)
    return (~tokens.padding[image]).float().numpy()


def _in_cells(references: Tensor, shapes: Shapes, points: int) -> Floats:
    """Turn references (B, Q, L, 2 or 4) in shares into x, y and the unit of the offsets, in cells: (B, Q, L, 4)."""
    cells = torch.tensor([[w, h] for h, w in shapes], dtype=torch.float32)
    centre = references[..., :2] * cells - 0.5
    unit = references[..., 2:] * cells * (0.5 / points) if references.shape[-1] == 4 else torch.ones_like(centre)
    return torch.cat([centre, unit], dim=-1).numpy()
