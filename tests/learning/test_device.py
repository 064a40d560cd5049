"""Computing on one thread."""

import numpy as np
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from swarmtwin.learning.device import one_thread


def threads_of_blas():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_torch_and_numpy_compute_on_one_thread_and_on_as_many_as_before_afterwards():
    np.linalg.eigh(np.eye(2))  # the library is loaded
    before = torch.get_num_threads()
    with threadpool_limits(2, user_api="blas"):
        with one_thread():
            assert threads_of_blas() == [1] * len(threads_of_blas())
            assert torch.get_num_threads() == 1
        assert threads_of_blas()
        assert set(threads_of_blas()) == {2}
    assert torch.get_num_threads() == before
