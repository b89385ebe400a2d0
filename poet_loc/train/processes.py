"""Training on several processes or machines, as torchrun starts them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor


@contextmanager
def process_group(device: torch.device) -> Iterator[None]:
    """Join the other processes where torchrun started some: nccl on GPUs, gloo on CPUs."""
    several = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if several:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield
    finally:
        if several:
            dist.destroy_process_group()


def rank_and_world() -> tuple[int, int]:
    """Return this process's number and how many there are."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def average_gradients(parameters: Iterable[torch.nn.Parameter]) -> None:
    """Replace each gradient by the mean over the processes; a missing one counts as zero."""
    world = rank_and_world()[1]
    if world == 1:
        return
    chosen = [p for p in parameters if p.requires_grad]
    flat = torch.cat([(torch.zeros_like(p) if p.grad is None else p.grad).reshape(-1) for p in chosen])
    dist.all_reduce(flat)
    flat /= world
    for parameter, part in zip(chosen, flat.split([p.numel() for p in chosen])):
        parameter.grad = part.view_as(parameter).clone()


def share_first(tensors: Iterable[Tensor]) -> None:
    """Give every process the first one's values."""
    if rank_and_world()[1] > 1:
        for tensor in tensors:
            dist.broadcast(tensor.data, src=0)


def total_over_processes(values: Tensor) -> Tensor:
    """Return the sum of a tensor over the processes."""
    if rank_and_world()[1] > 1:
        dist.all_reduce(values)
    return values


def wait_for_all() -> None:
    """Return when every process has come here."""
    if rank_and_world()[1] > 1:
        dist.barrier()
