"""Which layers Scaled-YOLOv4-CSP has, numbered as in its Darknet configuration.

Source: C.-Y. Wang et al., "Scaled-YOLOv4: scaling cross stage partial network" (2021), figure 4 and section 3.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Layer:
    """One numbered layer: what it does and which earlier outputs it reads."""

    kind: str
    """conv, head (a convolution without norm), route (concatenation), add, pool, upsample or yolo."""
    sources: tuple[int, ...]
    channels: int
    """Output channels."""
    size: int = 1
    """Kernel of a convolution or of a pooling window."""
    stride: int = 1


@dataclass
class _Plan:
    """Layers so far; every method appends one and returns its number."""

    layers: list[Layer] = field(default_factory=list)

    @property
    def last(self) -> int:
        return len(self.layers) - 1

    def _append(self, layer: Layer) -> int:
        self.layers.append(layer)
        return self.last

    def conv(self, channels: int, size: int = 1, stride: int = 1) -> int:
        return self._append(Layer("conv", (self.last,), channels, size, stride))

    def route(self, *sources: int) -> int:
        return self._append(Layer("route", sources, sum(self.layers[i].channels for i in sources)))

    def same(self, kind: str, *sources: int, size: int = 1) -> int:
        return self._append(Layer(kind, sources, self.layers[sources[0]].channels, size))

    def stage(self, channels: int, blocks: int) -> int:
        """Halve the map, then two paths side by side: one through residual blocks, one straight."""
        down = self.conv(channels, 3, 2)
        half = channels // 2
        straight = self.conv(half)
        self.route(down)
        self.conv(half)
        for _ in range(blocks):
            begin = self.last
            self.conv(half)
            self.conv(half, 3)
            self.same("add", self.last, begin)
        self.route(self.conv(half), straight)
        return self.conv(channels)

    def merge(self, channels: int) -> int:
        """Two paths side by side, one through four convolutions; both read the layer before."""
        begin = self.conv(channels)
        straight = self.conv(channels)
        self.route(begin)
        for size in (1, 3, 1, 3):
            self.conv(channels, size)
        self.route(self.last, straight)
        return self.conv(channels)

    def pyramid(self, channels: int) -> int:
        """Pool over windows of 5, 9 and 13 beside a straight path."""
        begin = self.last
        straight = self.conv(channels)
        self.route(begin)
        for size in (1, 3, 1):
            self.conv(channels, size)
        middle, pooled = self.last, []
        for size in (5, 9, 13):
            if size > 5:
                self.route(middle)
            pooled.append(self.same("pool", self.last, size=size))
        self.route(*reversed(pooled), middle)
        self.conv(channels)
        self.route(self.conv(channels, 3), straight)
        return self.conv(channels)

    def up_to(self, skip: int, channels: int) -> int:
        """Double the map and join it with an earlier one."""
        self.conv(channels)
        raised = self.same("upsample", self.last)
        self.route(skip)
        self.route(self.conv(channels), raised)
        return self.merge(channels)

    def head(self, channels: int, outputs: int) -> int:
        """A last convolution, whose output the pose network reads, and the detector's own."""
        tap = self.conv(channels, 3)
        self._append(Layer("head", (tap,), outputs))
        self.same("yolo", self.last)
        return tap


def csp_layers(class_count: int) -> tuple[tuple[Layer, ...], tuple[int, int, int]]:
    """Return the 175 layers and the numbers of the three that are read as feature maps (strides 8, 16, 32)."""
    plan = _Plan()
    plan._append(Layer("conv", (-1,), 32, 3))
    begin = plan.conv(64, 3, 2)
    plan.conv(32)
    plan.conv(64, 3)
    plan.same("add", plan.last, begin)
    plan.stage(128, 2)
    stride8 = plan.stage(256, 8)
    stride16 = plan.stage(512, 8)
    plan.stage(1024, 4)
    deep = plan.pyramid(512)
    middle = plan.up_to(stride16, 256)
    fine = plan.up_to(stride8, 128)
    outputs = 3 * (5 + class_count)
    taps, current = [plan.head(256, outputs)], fine
    for skip, channels in ((middle, 256), (deep, 512)):
        plan.route(current)
        plan.route(plan.conv(channels, 3, 2), skip)
        current = plan.merge(channels)
        taps.append(plan.head(2 * channels, outputs))
    return tuple(plan.layers), (taps[0], taps[1], taps[2])
