"""Stub."""

from flax import struct


def hyperparameter(default, *, help, symbol="", low=None, high=None):
    """Stub."""
    return struct.field(default=default)


def option(default, *, help, symbol="", choices=None, low=None, high=None):
    """Stub."""
    return struct.field(default=default, pytree_node=False)


def check_fields(obj):
    """Stub."""
