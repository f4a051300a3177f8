"""Which folder is which package; all else is in pyproject.toml.

The tasks in envs/ are installed inside of the library, as `jaxlfi.envs`: a distribution should have one top-level name.
"""

from setuptools import find_packages, setup

setup(
    packages=[
        *find_packages(include=["jaxlfi", "jaxlfi.*"]),
        *(f"jaxlfi.{package}" for package in find_packages(include=["envs", "envs.*"])),
    ],
    package_dir={"jaxlfi.envs": "envs"},
)
