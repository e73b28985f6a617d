"""Matrix products for compiled code: three of float32 and one of float64.

They call the BLAS in the wheels of numpy. numba itself calls the BLAS of scipy, whose wheels are one release behind: on
the few rows of a search it takes two to three times as long (4 x 200 times 200 x 200: 26 us instead of 10 us;
`python -m studies.speed.solvers` measures the effect on a search), and it takes 17 MB of memory. It is used only with a
numpy that is not a wheel of PyPI.
"""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from llvmlite import binding
from numba import types

from gemuco.compiled.jit import NUMPYS, jit

_ROWS, _PLAIN, _TURNED = 101, 111, 112


def _is_loaded(library: Path | None) -> bool:
    if library is None:
        return False
    binding.load_library_permanently(str(library))
    return True


HAS_NUMPYS = _is_loaded(NUMPYS)
if not HAS_NUMPYS and find_spec("scipy") is None:
    raise ImportError(
        "This numpy has no BLAS that compiled code can call, because it is not a wheel of PyPI. "
        "Install scipy beside it, or numpy by pip."
    )


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS to one thread in the whole process, for products that run in parallel.

    Otherwise the threads of BLAS would wait for each other. Without numpy's BLAS nothing changes.
    """
    if not HAS_NUMPYS:
        yield
        return
    library = ctypes.CDLL(str(NUMPYS))
    before = library.scipy_openblas_get_num_threads64_()
    library.scipy_openblas_set_num_threads64_(1)
    try:
        yield
    finally:
        library.scipy_openblas_set_num_threads64_(before)


_i, _n, _f, _d, _p = types.int32, types.int64, types.float32, types.float64, types.voidptr
_sgemm = types.ExternalFunction(
    "scipy_cblas_sgemm64_", types.void(_i, _i, _i, _n, _n, _n, _f, _p, _n, _p, _n, _f, _p, _n)
)
_dgemm = types.ExternalFunction(
    "scipy_cblas_dgemm64_", types.void(_i, _i, _i, _n, _n, _n, _d, _p, _n, _p, _n, _d, _p, _n)
)
_sgemv = types.ExternalFunction("scipy_cblas_sgemv64_", types.void(_i, _i, _n, _n, _f, _p, _n, _p, _n, _f, _p, _n))

if HAS_NUMPYS:

    @jit
    def times(a, b, out):
        """Write the product a b into `out`, shapes (m, k), (k, n) and (m, n), all in C order."""
        m, k, n = a.shape[0], a.shape[1], b.shape[1]
        if m == 1:
            _sgemv(_ROWS, _TURNED, k, n, 1.0, b.ctypes.data, n, a.ctypes.data, 1, 0.0, out.ctypes.data, 1)
        else:
            x, y, z = a.ctypes.data, b.ctypes.data, out.ctypes.data
            _sgemm(_ROWS, _PLAIN, _PLAIN, m, n, k, 1.0, x, k, y, n, 0.0, z, n)

    @jit
    def times_turned(a, b, out):
        """Write the product a b^T into `out`, shapes (m, k), (n, k) and (m, n)."""
        m, k, n = a.shape[0], a.shape[1], b.shape[0]
        if m == 1:
            _sgemv(_ROWS, _PLAIN, n, k, 1.0, b.ctypes.data, k, a.ctypes.data, 1, 0.0, out.ctypes.data, 1)
        else:
            x, y, z = a.ctypes.data, b.ctypes.data, out.ctypes.data
            _sgemm(_ROWS, _PLAIN, _TURNED, m, n, k, 1.0, x, k, y, k, 0.0, z, n)

    @jit
    def turned_times(a, b, out):
        """Write the product a^T b into `out`, shapes (m, k), (m, n) and (k, n)."""
        m, k, n = a.shape[0], a.shape[1], b.shape[1]
        x, y, z = a.ctypes.data, b.ctypes.data, out.ctypes.data
        _sgemm(_ROWS, _TURNED, _PLAIN, k, n, m, 1.0, x, k, y, n, 0.0, z, n)

    @jit
    def times_turned_double(a, b, out):
        """Write the product a b^T of float64 into `out`, shapes (m, k), (n, k) and (m, n)."""
        m, k, n = a.shape[0], a.shape[1], b.shape[0]
        x, y, z = a.ctypes.data, b.ctypes.data, out.ctypes.data
        _dgemm(_ROWS, _PLAIN, _TURNED, m, n, k, 1.0, x, k, y, k, 0.0, z, n)

else:

    @jit
    def times(a, b, out):
        """Write the product a b into `out`, shapes (m, k), (k, n) and (m, n), all in C order."""
        np.dot(a, b, out)

    @jit
    def times_turned(a, b, out):
        """Write the product a b^T into `out`, shapes (m, k), (n, k) and (m, n)."""
        np.dot(a, b.T, out)

    @jit
    def turned_times(a, b, out):
        """Write the product a^T b into `out`, shapes (m, k), (m, n) and (k, n)."""
        np.dot(a.T, b, out)

    @jit
    def times_turned_double(a, b, out):
        """Write the product a b^T of float64 into `out`, shapes (m, k), (n, k) and (m, n)."""
        np.dot(a, b.T, out)
