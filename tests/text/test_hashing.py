"""Hashed n-grams against exact counts, and the promises of their docstring."""

from collections import Counter

import numpy as np
import pytest

from jaxmotion.text import hashing

TEXTS = [
    "a person turns left",
    "a person turns right",
    "left turns person a",
    "An elderly person doesn't walk, then turns left.",
    "someone jumps twice",
]


def exact_cosines(texts):
    """Inner products of features that are kept apart by name."""
    bags = []
    for text in texts:
        bag = Counter()
        for feature, weight in hashing.features(text):
            bag[feature] += weight
        length = sum(value**2 for value in bag.values()) ** 0.5
        bags.append({feature: value / length for feature, value in bag.items()})
    return np.array(
        [[sum(v * b.get(f, 0) for f, v in a.items()) for b in bags] for a in bags]
    )


def test_features_of_a_sentence():
    found = list(hashing.features("Turn LEFT!"))
    names = [name for name, _ in found]
    assert names == [
        *("word turn", "letters <tu", "letters tur", "letters urn", "letters rn>"),
        *("word left", "letters <le", "letters lef", "letters eft", "letters ft>"),
        *("pair  turn", "pair turn left", "pair left "),
    ]
    assert sum(w**2 for name, w in found if "letters" in name) == pytest.approx(2)
    assert {w for name, w in found if "letters" not in name} == {1.0}


def test_many_components_give_the_exact_cosines():
    found = hashing.encode(TEXTS, dimensions=1 << 20).astype(np.float64)
    wanted = exact_cosines(TEXTS)
    np.testing.assert_allclose(found @ found.T, wanted, atol=1e-5)
    # The order of words is seen, and less of it is lost the nearer two texts are.
    assert wanted[0, 2] < 0.9
    assert wanted[0, 1] > wanted[0, 4]


def test_signs_keep_inner_products_unbiased():
    """Mean error over tables of different sizes: zero; without signs it is positive."""
    wanted = exact_cosines(TEXTS)[0, 4]
    errors = []
    for dimensions in range(101, 501):
        a, b = hashing.encode([TEXTS[0], TEXTS[4]], dimensions=dimensions)
        errors.append(float(a @ b) - wanted)
    z = np.mean(errors) / (np.std(errors) / len(errors) ** 0.5)
    assert abs(z) < 4
    assert 0.01 < np.std(errors) < 0.2


def test_length_one_and_no_dependence_on_case_marks_and_neighbors():
    found = hashing.encode(TEXTS, dimensions=64)
    assert found.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, rtol=1e-6)
    same = hashing.encode(["A Person, turns: LEFT."], dimensions=64)
    np.testing.assert_array_equal(same[0], found[0])


def test_golden_components():
    """From hashlib by hand: caches and trained models stay valid."""
    signs = {15659: 1, 16158: 1, 13702: -1, 4413: 1, 20836: -1, 26397: -1, 50310: -1}
    found = hashing.encode(["left"], dimensions=1 << 16)[0]
    assert {int(i): np.sign(found[i]) for i in np.flatnonzero(found)} == signs


def test_texts_without_words_and_bad_sizes_are_refused():
    with pytest.raises(ValueError, match=r"text 1 has no words to hash: '\?!'"):
        hashing.encode(["left", "?!"], dimensions=16)
    with pytest.raises(ValueError, match="positive, found 0"):
        hashing.encode(["left"], dimensions=0)
