import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import features


def test_layout_packs_and_unpacks_by_name():
    layout = features.feature_layout(root=3, contact=2, rest=4)
    assert layout.fields == (("root", 0, 3), ("contact", 3, 5), ("rest", 5, 9))
    assert layout.size == 9 and hash(layout) == hash(
        features.feature_layout(root=3, contact=2, rest=4)
    )
    x = jnp.arange(18.0).reshape(2, 9)
    parts = features.unpack(layout, x)
    np.testing.assert_array_equal(parts["contact"], x[:, 3:5])
    np.testing.assert_array_equal(features.pack(layout, parts), x)
    swapped = dict(reversed(list(parts.items())))
    np.testing.assert_array_equal(features.pack(layout, swapped), x)


def test_layout_goes_through_jit_as_a_static_part():
    layout = features.feature_layout(a=1, b=2)
    out = jax.jit(features.unpack)(layout, jnp.arange(3.0))
    np.testing.assert_array_equal(out["b"], [1.0, 2.0])


def test_bad_layouts_and_parts_are_named():
    with pytest.raises(ValueError, match="'b' is 2..3, expected to start at 1"):
        features.FeatureLayout(fields=(("a", 0, 1), ("b", 2, 3)))
    with pytest.raises(ValueError, match="'b' is 1..1, .* hold at least one number"):
        features.feature_layout(a=1, b=0)
    with pytest.raises(ValueError, match="'a' occurs twice"):
        features.FeatureLayout(fields=(("a", 0, 1), ("a", 1, 2)))
    layout = features.feature_layout(a=1, b=2)
    with pytest.raises(ValueError, match=r"parts are \['a'\], expected \['a', 'b'\]"):
        features.pack(layout, {"a": jnp.zeros(1)})
    with pytest.raises(ValueError, match="'b' has 1 numbers, expected 2"):
        features.pack(layout, {"a": jnp.zeros(1), "b": jnp.zeros(1)})
    with pytest.raises(ValueError, match="have 4 numbers, expected 3"):
        features.unpack(layout, jnp.zeros(4))
