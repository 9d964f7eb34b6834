"""The training step of the paper's network in PyTorch, to compare with. Needs torch, which is in no
extra."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import torch

WARM_UP = 20


def _network(widths: tuple[int, ...]) -> torch.nn.Sequential:
    layers: list[torch.nn.Module] = []
    for fan_in, width in pairwise(widths):
        layers += [torch.nn.Linear(fan_in, width), torch.nn.Tanh()]
    return torch.nn.Sequential(*layers[:-1])


def _seconds(
    batches: Iterator,
    widths: tuple[int, ...],
    weight: float,
    runs: int,
    length: int,
    *,
    fused: bool,
) -> float:
    """Seconds per step of Adam on mean ‖weight · (∇S(w) − target_gradient)‖², in the fastest of so
    many runs of so many steps; ∇S by one backward pass, its slope in the weights by a second."""
    network = _network(widths)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01, fused=fused)

    def run(steps: int) -> float:
        started = time.perf_counter()
        for _ in range(steps):
            w, target_gradient = next(batches)
            w.requires_grad_()
            (gradient,) = torch.autograd.grad(network(w).sum(), w, create_graph=True)
            loss = ((weight * (gradient - target_gradient)) ** 2).sum(dim=-1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return time.perf_counter() - started

    run(WARM_UP)
    return min(run(length) for _ in range(runs)) / length


def _loaded(w, target_gradient, batch_size: int) -> Iterator:
    """Batches as the paper's own code makes them."""
    rows = torch.utils.data.TensorDataset(w, target_gradient)
    loader = torch.utils.data.DataLoader(rows, batch_size=batch_size, shuffle=True)
    while True:
        yield from loader


def _indexed(w, target_gradient, batch_size: int) -> Iterator:
    """Batches by one permutation and an index each."""
    while True:
        for rows in torch.randperm(len(w)).split(batch_size):
            yield w[rows], target_gradient[rows]


def measure(
    w,
    target_gradient,
    widths: tuple[int, ...],
    weight: float,
    batch_size: int,
    runs: int,
    length: int,
    threads: int,
) -> dict[str, float | int | str]:
    """Microseconds per step of both loops, in float32, on so many threads.

    w, target_gradient: NumPy arrays (N, 2d). widths: of the network, inputs and output included.
    runs, length: the fastest of so many runs of so many steps counts.
    """
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    rows = [torch.tensor(a, dtype=torch.float32) for a in (w, target_gradient)]
    loops: dict[str, tuple[Callable, bool]] = {
        "original": (_loaded, False),
        "careful": (_indexed, True),
    }
    microseconds = {
        name: 1e6 * _seconds(batches(*rows, batch_size), widths, weight, runs, length, fused=fused)
        for name, (batches, fused) in loops.items()
    }
    return {**microseconds, "threads": threads, "version": torch.__version__}
