"""The DLO whipping task: physics, camera, rules and Real2Sim (section VI).

Needs the extra `whip` (MuJoCo and MJX).
"""


def task(**options):
    """The Real2Sim task, see `envs.whip.real2sim.task`.

    Raises:
        ImportError: where MuJoCo is not installed, with what to install.
    """
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise ImportError("the whipping task needs MuJoCo and MJX: pip install 'jaxlfi[whip]'") from error
    from envs.whip.real2sim import task as make

    return make(**options)
