"""Two monitors to either side of a known stretch: momenta in their own unit, a map per place."""

import warnings

import jax
import numpy as np
import pytest

import gfnn_jax as gfnn

LENGTH, KICK, NOISE = 2.0, 0.4, 1e-3
# A turn of both planes, of tunes 0.23 and 0.31 and beta functions 5 and 3 metres, at a sextupole.
ANGLE, BETA = 2 * np.pi * np.array([0.23, 0.31]), np.array([5.0, 3.0])
PLACES = [("x1", "y1"), ("x2", "y2")]


def drifted(z, length):
    return np.concatenate([z[:, :2] + length * z[:, 2:], z[:, 2:]], axis=1)


def rest_of_a_turn(z):
    """From behind the drift to its begin: a thin sextupole, then a linear turn."""
    x, y = z[:, 0], z[:, 1]
    q = z[:, :2]
    p = z[:, 2:] - KICK * np.stack([x**2 - y**2, -2 * x * y], axis=1)
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    z = np.concatenate([c * q + BETA * s * p, -s / BETA * q + c * p], axis=1)
    return drifted(z, -LENGTH)


def read(particles, turns, seed):
    """States before and behind the drift, (particles, turns, 4) each."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(-1, 1, (particles, 4)) * np.array([0.05, 0.05, 0.01, 0.015])
    first, second = [], []
    for _ in range(turns):
        first.append(z)
        second.append(drifted(z, LENGTH))
        z = rest_of_a_turn(second[-1])
    return np.stack(first, 1), np.stack(second, 1)


def recorded(first, second):
    particles, turns = first.shape[:2]
    run, turn = np.indices((particles, turns))
    table = {"run": run.ravel(), "t": 1.0 * turn.ravel()}
    for place, z in ((1, first), (2, second)):
        table |= {f"{n}{place}": z[..., i].ravel() for i, n in enumerate("xy")}
    return gfnn.Recording(table, positions=["x1", "y1", "x2", "y2"])


@pytest.fixture(scope="module")
def ring():
    recording = recorded(*read(40, 20, 0))
    return gfnn.fit_monitors(recording, PLACES, [LENGTH, None], tolerance=1e-10)


@pytest.mark.slow
def test_two_monitors_across_a_drift_tell_momenta_and_their_scale(ring):
    first, second = read(5, 6, 1)
    recording = recorded(first, second)
    for place, true in enumerate((first, second)):
        found = np.stack(list(ring.states(recording, place).values()))
        assert np.abs(found - true).max() < 1e-14


@pytest.mark.slow
def test_a_map_for_each_place_and_their_composition(ring):
    first, second = read(50, 3, 1)
    assert ring.fits[0] is None
    assert ring.fits[1].met
    ends = ((first[:, 0], second[:, 0]), (second[:, 0], first[:, 1]))
    for map_, (before, after) in zip(ring.maps, ends, strict=True):
        assert np.abs(np.asarray(map_.step(before)[0]) - after).max() < 1e-10
    for place, states in enumerate((first, second)):
        turn = ring.turn(place)
        found, info = turn.rollout(states[:, 0], num_steps=2)
        assert (np.asarray(info.status) <= 1).all()
        assert np.abs(np.asarray(found) - states).max() < 1e-9
        assert np.max(np.asarray(turn.defect(states[:, 0]))) < 1e-13
    assert abs(float(np.asarray(ring.turn().dt)) - 1) < 1e-15


@pytest.mark.slow
def test_one_monitor_tells_momenta_but_for_their_scale(ring):
    """What the drift adds: S of positions alone fixes p by its mixed term, and is off by a
    factor."""
    first, _ = read(40, 20, 0)
    run, turn = np.indices(first.shape[:2])
    table = {"run": run.ravel(), "t": 1.0 * turn.ravel()}
    table |= {n: first[..., i].ravel() for i, n in enumerate("xy")}
    alone = gfnn.fit(gfnn.Recording(table, positions=["x", "y"]), learn="map", tolerance=1e-4)
    true, _ = read(50, 2, 1)
    p = np.asarray(alone.map.from_positions(true[:, 0, :2], true[:, 1, :2]))[:, 2:]
    factor = np.sum(p * true[:, 0, 2:]) / np.sum(true[:, 0, 2:] ** 2)
    assert abs(factor - 1) > 0.1


@pytest.fixture(scope="module")
def noisy():
    """Readings of 1 mm noise, of orbits of some 35 mm: momenta as they are read have 0.7 mrad of
    it, of some 6 mrad."""
    rng = np.random.default_rng(5)
    states = [z.copy() for z in read(50, 30, 0)]
    for z in states:
        z[..., :2] += NOISE * rng.normal(size=z[..., :2].shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", gfnn.FitWarning)
        return gfnn.fit_monitors(recorded(*states), PLACES, [LENGTH, None], tolerance=1e-3)


@pytest.mark.slow
def test_the_noise_of_both_monitors_is_told(noisy):
    assert np.abs(np.array(noisy.noise) / NOISE - 1).max() < 0.06


@pytest.mark.slow
def test_latent_readings_tell_more_than_momenta_as_they_are_read(noisy):
    first, second = read(200, 2, 1)
    as_read, latent = (
        np.asarray(map_.step(second[:, 0])[0]) - first[:, 1]
        for map_ in (noisy.fits[1].map, noisy.maps[1])
    )
    unit = np.std(first[:, 1], axis=0)
    as_read, latent = (np.sqrt(np.mean((error / unit) ** 2)) for error in (as_read, latent))
    assert latent < as_read
    assert latent < 0.3 * np.sqrt(np.mean((NOISE / unit[:2]) ** 2))
    assert np.max(np.asarray(noisy.turn().defect(first[:, 0]))) < 1e-13


@pytest.mark.slow
def test_its_posterior_is_as_wide_as_its_errors(noisy):
    """A bias by noise, of which more turns take nothing, would stand out of it."""
    first, second = read(100, 2, 1)
    states, info = noisy.maps[1].rollout(
        second[:, 0], num_steps=1, samples=40, key=jax.random.key(0)
    )
    error = np.asarray(states)[:, 1] - first[:, 1]
    std = np.asarray(info.bands.std)[:, 1]
    ratio = np.sqrt(np.mean((error / std) ** 2, axis=0))
    assert ((ratio > 0.4) & (ratio < 2)).all()  # a few coefficients make the errors of all states


def test_what_does_not_fit_is_refused():
    recording = recorded(*read(3, 5, 0))
    refused = [
        (PLACES, [np.diag([2.0, 2.0, 1.0, 1.0]), None], "expected symplectic matrices"),
        ([("x1", "y1"), ("x3", "y2")], [LENGTH, None], "expected columns x3"),
    ]
    for places, between, words in refused:
        with pytest.raises(gfnn.InputError, match=words):
            gfnn.fit_monitors(recording, places, between)
