"""Scans are alike by what they have in common, not by how they look on the whole."""

from __future__ import annotations

import numpy as np

from utopic_cli.multiway.vocabulary import LENGTH, WORDS, shorten, word_frequencies


def places(rng: np.random.Generator, count: int) -> np.ndarray:
    """What surfaces look like in so many places: (count, 64) unit descriptors."""
    drawn = rng.standard_normal((count, 64))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def scan_of(rng: np.random.Generator, *parts: np.ndarray) -> np.ndarray:
    """A noisy scan that sees each place of its parts five times."""
    seen = np.repeat(np.concatenate(parts), 5, axis=0)
    return shorten(seen + 0.02 * rng.standard_normal(seen.shape))


def test_scans_that_share_a_part_are_nearest_even_if_their_means_are_not() -> None:
    rng = np.random.default_rng(0)
    common, front, back = (places(rng, 30) for _ in range(3))
    front[:, 0] += 2.0  # the sides of a plate: each quite unlike the other, on the whole
    back[:, 0] -= 2.0
    front, back = (side / np.linalg.norm(side, axis=1, keepdims=True) for side in (front, back))
    stranger = places(rng, 60)
    stranger -= stranger.mean(axis=0)
    stranger += np.concatenate([common, front]).mean(axis=0)  # the first one's mean, none of its places
    scans = {
        4: scan_of(rng, common, front),
        7: scan_of(rng, common, back),
        9: scan_of(rng, stranger / np.linalg.norm(stranger, axis=1, keepdims=True)),
    }
    means = {scan: descriptors.mean(axis=0) for scan, descriptors in scans.items()}
    assert np.linalg.norm(means[4] - means[9]) < np.linalg.norm(means[4] - means[7])
    looks = word_frequencies(scans)
    assert np.linalg.norm(looks[4] - looks[7]) < 0.9 * np.linalg.norm(looks[4] - looks[9])
    assert np.linalg.norm(looks[4] - looks[7]) < 0.9 * np.linalg.norm(looks[7] - looks[9])


def test_frequencies_are_roots_of_shares_and_know_no_order() -> None:
    rng = np.random.default_rng(1)
    scans = {number: shorten(places(rng, 40 + number)) for number in (3, 1, 2)}
    looks = word_frequencies(scans)
    for number, look in looks.items():
        assert look.shape == (WORDS,)
        np.testing.assert_allclose(np.square(look).sum(), 1.0)
        again = word_frequencies({n: scans[n] for n in (2, 3, 1)})
        assert np.array_equal(again[number], look)
    assert word_frequencies({}) == {}


def test_short_descriptors_keep_who_is_near_whom() -> None:
    rng = np.random.default_rng(2)
    places_seen = places(rng, 200)
    short = shorten(places_seen)
    assert short.dtype == np.int8
    assert short.shape == (200, LENGTH)
    seen_again = shorten(places_seen + 0.02 * rng.standard_normal(places_seen.shape)).astype(float)
    nearest = np.argmin(((seen_again[:, None] - short[None].astype(float)) ** 2).sum(axis=2), axis=1)
    assert (nearest == np.arange(200)).mean() > 0.95
    narrow = shorten(places(rng, 5)[:, :8] / 2.0)  # a network with narrower descriptors than that
    assert narrow.shape == (5, LENGTH)
