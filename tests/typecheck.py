"""The checker that pytest's --jaxtyping-packages applies to every annotated function of the numerical core."""

from beartype import beartype


def checked(function):
    """Check a function's annotations at run time with beartype, but not a constructor's.

    The constructors are those of pytrees. JAX rebuilds them around whatever the leaves become (NumPy arrays, shapes,
    vmap axes, boolean masks, one more axis), none of which the annotations mean.
    """
    return function if function.__name__ == "__init__" else beartype(function)
