"""Fixtures of the whole suite; one thread, because tests measure nothing and batches are small."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def project_root(pytestconfig: pytest.Config):
    """The repository's root folder."""
    return pytestconfig.rootpath
