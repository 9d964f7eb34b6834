"""Operations counted in a program."""

import jax
import jax.numpy as jnp
import pytest

from gfnn_jax.fitting.adam import EACH, LEAST, operations_of


def counted(function, *shapes):
    arrays = [jax.ShapeDtypeStruct(shape, "float32") for shape in shapes]
    return operations_of(jax.make_jaxpr(function)(*arrays).jaxpr)


def test_a_product_counts_two_for_each_that_it_adds_up():
    assert counted(jnp.matmul, (100, 50), (50, 200)) == 2 * 100 * 50 * 200
    batched = counted(jax.vmap(jnp.matmul), (7, 30, 40), (7, 40, 20))
    assert batched == 2 * 7 * 30 * 40 * 20


@pytest.mark.parametrize(("numbers", "count"), [(10**6, EACH * 10**6), (3, LEAST)])
def test_other_operations_count_what_they_make(numbers, count):
    assert counted(jnp.tanh, (numbers,)) == count


def test_a_loop_counts_as_often_as_it_runs():
    def repeated(x, y):
        return jax.lax.scan(lambda c, _: (jax.jit(jnp.matmul)(c, y), None), x, length=9)[0]

    assert counted(repeated, (60, 60), (60, 60)) == 9 * 2 * 60**3
