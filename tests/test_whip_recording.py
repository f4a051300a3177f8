"""Recorded rollouts: what is written is read, resampled as motion says, and refused where it does not fit."""

import dataclasses
import json

import numpy as np
import pytest

from envs.whip import recording as recordings
from envs.whip.camera import side_camera
from envs.whip.exploration import exploratory_actions
from envs.whip.parameters import median
from envs.whip.recording import ORDER, Recording, filled, hit_flags, read, resample, trajectory, write
from envs.whip.rules import WORKSPACE
from envs.whip.scene_constants import START  # replaced below
