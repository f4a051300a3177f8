"""The checker that pytest's --jaxtyping-packages applies to every annotated function of the numerical core."""

import typing

import jax
from beartype import beartype


def checked(function):
    """Check a function's annotations at run time with beartype, but not a constructor's.

    The constructors are those of pytrees, which JAX rebuilds around whatever the leaves become (NumPy arrays, shapes,
    vmap axes, boolean masks, one more axis); the annotations describe none of these. `Self` is known only if a whole
    class is checked. Counts, keys and choices are not checked here: the library refuses wrong ones with a ValueError,
    which is tested.
    """
    if function.__name__ == "__init__" or typing.Self in function.__annotations__.values():
        return function
    kept = {
        name: kind
        for name, kind in function.__annotations__.items()
        if kind not in (int, jax.Array) and typing.get_origin(kind) is not typing.Literal
    }
    function.__annotations__ = kept
    return beartype(function)
