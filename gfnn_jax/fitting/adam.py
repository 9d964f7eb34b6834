"""Minimise a loss by Adam, among them the paper's for S(params, w). The one home of optax.

`Training.of_loss` takes any loss of a batch. The paper's (3) for S is `gradient_loss`.

An epoch is one compiled scan. Its order of the pairs is a function of the key and the epoch's
number alone: the same key gives the same bits.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gfnn_jax.families import Family
from gfnn_jax.phase_space import require_x64


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Recipe of a training.

    batch_size:     pairs per iteration (all of them where there are fewer).
    epochs:         parts of the training; each ends with a validation.
    rate:           Adam's largest rate.
    schedule:       one of ``SCHEDULES``: how the rate goes on from there.
    epoch_length:   iterations of an epoch; None: one pass through the pairs, a rest of less than a
                    batch left out.
    dtype:          of parameters and arithmetic.
    """

    batch_size: int
    epochs: int
    rate: float
    schedule: str
    epoch_length: int | None = None
    dtype: str = "float32"

    def __post_init__(self):
        if self.schedule not in SCHEDULES:
            raise ValueError(
                f"expected a schedule among {', '.join(SCHEDULES)}, got {self.schedule!r}"
            )
        length = 1 if self.epoch_length is None else self.epoch_length
        if min(self.batch_size, self.epochs, length) < 1 or not self.rate > 0:
            raise ValueError(f"expected positive sizes and a positive rate, got {self}")

    def rate_at(self, iteration, num_iterations: int):
        """The rate of iteration 0, 1, ... of ``num_iterations``."""
        return SCHEDULES[self.schedule](self.rate, num_iterations)(iteration)


def _staircase(rate, num_iterations):
    """× 0.95 every 100 iterations: the paper's own code."""
    import optax  # loaded when first used

    del num_iterations
    return optax.exponential_decay(rate, transition_steps=100, decay_rate=0.95, staircase=True)


def _cosine(rate, num_iterations):
    """A rise over the first hundredth, then half a cosine down to a ten-thousandth."""
    import optax

    rise = num_iterations // 100
    return optax.warmup_cosine_decay_schedule(rate * 1e-4, rate, rise, num_iterations, rate * 1e-4)


SCHEDULES: dict[str, Callable] = {"staircase": _staircase, "cosine": _cosine}
# Paper, Experimental Details; for 100,000 pairs, and for the standard map's 1,000,000.
PAPER = Recipe(batch_size=200, epochs=20, rate=0.01, schedule="staircase")
PAPER_STANDARD_MAP = dataclasses.replace(PAPER, batch_size=1000, rate=0.001)


class AdamFit(NamedTuple):
    """params: those of the epoch with the lowest validation error, of the recipe's dtype.

    train_rms, validation_rms: of that epoch, per component of the loss; the first is a mean over
    its batches, while parameters moved. seconds: without compilation. operations: counted, of an
    epoch. stopped_because: "epochs", or words that say that the cap was reached, or where numbers
    ceased to be finite.
    """

    params: Any
    train_rms: float
    validation_rms: float
    epochs: int
    seconds: float
    compile_seconds: float
    operations: float
    stopped_because: str


@dataclasses.dataclass(frozen=True, eq=False)
class Training:
    """A training by Adam: its recipe, and what is called along it.

    key:        a ``jax.random.key``; decides the order of the rows.
    on_epoch:   called with (epochs done, train_rms, validation_rms) after each epoch.
    cap:        operations of the training, counted: the epochs are as many as it allows, one or
                more, and the rate goes through its whole schedule in them.

    What is compiled serves the next training with the same loss and data of the same shapes.
    """

    recipe: Recipe
    key: Any
    on_epoch: Callable[[int, float, float], Any] | None = None
    cap: float | None = None

    def of_loss(
        self, loss: Callable, params: Any, train: tuple, validation: tuple, components: int
    ) -> AdamFit:
        """Minimise ``loss(params, *batch)``, a mean over the rows of a batch, over all rows of
        train.

        train, validation: tuples of arrays that agree in their first axis, the rows. components:
        what a row's loss is a sum of: the errors reported are √(loss / components).

        Raises ValueError where the loss is not finite at the start, RuntimeError where float64 is
        asked for and JAX's x64 mode is off. Where numbers cease to be finite later, the fit stops
        and says so.
        """
        recipe, cap = self.recipe, self.cap
        if recipe.dtype == "float64":
            require_x64("training in float64")
        params, train, validation = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a, recipe.dtype)), (params, train, validation)
        )
        num_rows, batch_size = len(train[0]), min(recipe.batch_size, len(train[0]))
        length = recipe.epoch_length or num_rows // batch_size

        def rates(epoch):
            """The rate of each iteration of an epoch: (length,)."""
            first = round(epoch / epochs * recipe.epochs * length)
            return _rates(first, recipe=recipe, length=length)

        def order(epoch):
            """The rows of each batch (length, batch_size): permutations in a row that fill the
            epoch. By NumPy: XLA permutes by sorting, which takes a CPU as long as a small network's
            epoch."""
            random = np.random.default_rng(np.asarray(_seed(self.key, epoch)))
            in_pass = num_rows // batch_size
            passes = [
                random.permutation(num_rows)[: in_pass * batch_size].reshape(in_pass, batch_size)
                for _ in range(-(-length // in_pass))
            ]
            return np.concatenate(passes)[:length].astype(np.int32)

        started = time.perf_counter()
        carry, epochs = _first_carry(params), recipe.epochs
        program = _run_epoch.trace(carry, order(0), rates(0), train, loss=loss)
        operations = operations_of(program.jaxpr)
        if cap is not None:
            epochs = min(epochs, max(1, int(cap / operations)))
        program.lower().compile()
        _validate.lower(params, validation, loss=loss).compile()
        compile_seconds = time.perf_counter() - started

        def rms(value):
            return math.sqrt(float(value) / components)

        start = rms(_validate(params, validation, loss=loss))
        if not math.isfinite(start):
            raise ValueError("the loss is not finite on the validation rows at the start")
        epoch, seconds = 0, 0.0
        best = {"params": _copied(params), "train_rms": math.nan, "validation_rms": start}
        capped = epochs < recipe.epochs
        stopped_because = f"the cap of {cap:.3g} operations" if capped else "epochs"
        while epoch < epochs:
            started = time.perf_counter()
            carry, value = _run_epoch(carry, order(epoch), rates(epoch), train, loss=loss)
            epoch += 1
            held = _validate(carry[0], validation, loss=loss)
            now = {"train_rms": rms(value), "validation_rms": rms(held)}
            seconds += time.perf_counter() - started
            if not all(map(math.isfinite, now.values())):
                stopped_because = f"not finite in epoch {epoch}: try a lower rate"
                break
            if now["validation_rms"] < best["validation_rms"]:
                best = {"params": _copied(carry[0]), **now}
            if self.on_epoch is not None:
                self.on_epoch(epoch, now["train_rms"], now["validation_rms"])
        return AdamFit(
            **{**best, "params": jax.tree.map(jnp.asarray, best["params"])},
            epochs=epoch,
            seconds=seconds,
            compile_seconds=compile_seconds,
            operations=operations,
            stopped_because=stopped_because,
        )


def gradient_loss(family: Family, weight: Any) -> Callable:
    """The paper's loss (3) of rows (w, target_gradient), each (N, 2d), with a weight (2d,) for the
    size of each coordinate:

        L(θ) = mean of ‖weight · (∇S(θ, w) − target_gradient)‖²

    ``weight = h`` in all entries is the paper's; ``h / scale`` of the conjugate coordinate makes L
    independent of the units of q and p.
    """

    def loss(params, w, target_gradient):
        factors = jnp.broadcast_to(jnp.asarray(weight, w.dtype), w.shape)
        error = factors * (family.gradient(params, w) - target_gradient)
        return jnp.mean(jnp.sum(error**2, axis=-1))

    return loss


@partial(jax.jit, static_argnames="loss", donate_argnames="carry")
def _run_epoch(carry, batches, rates, rows, *, loss):
    """(carry, mean loss) after an iteration with each of the batches (length, batch_size)."""
    import optax

    optimizer = optax.scale_by_adam()

    def iterate(carry, chosen):
        (params, state), (batch, rate) = carry, chosen
        value, slope = jax.value_and_grad(loss)(params, *(array[batch] for array in rows))
        with jax.numpy_dtype_promotion("standard"):  # optax counts in int32
            direction, state = optimizer.update(slope, state, params)
        updates = jax.tree.map(lambda a: -rate * a, direction)
        return (optax.apply_updates(params, updates), state), value

    carry, values = jax.lax.scan(iterate, carry, (batches, rates))
    return carry, jnp.mean(values)


@partial(jax.jit, static_argnames="loss")
def _validate(params, rows, *, loss):
    return loss(params, *rows)


@jax.jit
def _first_carry(params):
    import optax

    return jax.tree.map(jnp.copy, params), optax.scale_by_adam().init(params)


@partial(jax.jit, static_argnames=("recipe", "length"))
def _rates(first, *, recipe, length):
    """The rate of ``length`` iterations from ``first`` on: (length,)."""
    with jax.numpy_dtype_promotion("standard"):
        rates = recipe.rate_at(first + jnp.arange(length), recipe.epochs * length)
        return rates.astype(recipe.dtype)


@jax.jit
def _seed(key, epoch):
    return jax.random.key_data(jax.random.fold_in(key, epoch))


def _copied(tree):
    """NumPy copies: the next epoch reuses the memory of its carry."""
    return jax.tree.map(np.array, tree)


# A number that is no sum of products takes as long as so many of these, memory and transcendental
# functions included; an operation on arrays at least as long as so many. With both, trainings of
# eight kinds of networks count 3e10 to 6e10 in a second of one core.
EACH, LEAST = 10.0, 5_000.0


def operations_of(jaxpr: Any) -> float:
    """Operations of a run of this program: two for each product that a contraction adds up, EACH
    for every number that another operation makes, LEAST at least; those of a scan as often as it
    runs. Of a while loop, whose length the data decide, one turn is counted."""
    return sum(_of_equation(equation) for equation in jaxpr.eqns)


def _of_equation(equation: Any) -> float:
    inner = sum(map(operations_of, _inner(equation)))
    if inner:
        return inner * equation.params.get("length", 1)
    made = sum(math.prod(variable.aval.shape) for variable in equation.outvars)
    if equation.primitive.name == "dot_general":
        (contracted, _), _ = equation.params["dimension_numbers"]
        shape = equation.invars[0].aval.shape
        return max(2.0 * made * math.prod(shape[axis] for axis in contracted), LEAST)
    return max(EACH * made, LEAST)


def _inner(equation: Any) -> Iterator[Any]:
    """Programs that an operation runs: the body of a scan, a jitted function."""
    for value in equation.params.values():
        for part in value if isinstance(value, (tuple, list)) else (value,):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield part
