"""Compiler of this package: without the GIL, and with a cache on disk.

numba checks only the file of a function to decide whether its cached code is still valid, and not the functions that it
calls. Therefore the cache folder is named by a hash of all sources of this package.
"""

import contextlib
import ctypes
import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np

MADV_DONTNEED = 4
F = TypeVar("F", bound=Callable[..., object])

FREE = {"nsz", "arcp", "contract", "reassoc"}
"""Rounding may differ from the order in the source; NaN stays NaN."""
CONFIG: Any = numba.config
HERE = Path(__file__).parent


def _numpys_blas() -> Path | None:
    """Return the BLAS library in numpy's wheel, if it exists and has the functions that `blas` calls."""
    for library in sorted((Path(np.__file__).parents[1] / "numpy.libs").glob("libscipy_openblas64_*.so")):
        loaded = ctypes.CDLL(str(library))  # already open in numpy
        if all(hasattr(loaded, f"scipy_cblas_{name}64_") for name in ("sgemm", "sgemv", "dgemm")):
            return library
    return None


NUMPYS = _numpys_blas()


def _digest() -> str:
    sources = sorted(HERE.glob("*.py"))
    known = [str(NUMPYS).encode(), *(source.read_bytes() for source in sources)]
    return hashlib.sha256(b"".join(known)).hexdigest()[:16]


def _is_own(folder: Path) -> bool:
    """Whether only this user can write code into the folder, because the code will be run. Others may read it."""
    try:
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        status = folder.lstat()  # a link may lead to code of others
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022


def find_folder() -> Path | None:
    """Find the folder of compiled code: `$NUMBA_CACHE_DIR`, beside the sources, or the home or temporary directory.

    Compiled code beside sources that are not writable, as in a read-only image, is copied to the folder. Return None if
    no folder is writable; then everything is compiled at every start.
    """
    name = f"gemuco-{_digest()}"
    beside = HERE / "__pycache__" / name
    own = [Path(CONFIG.CACHE_DIR) / name] if CONFIG.CACHE_DIR else []
    homes = [Path(tempfile.gettempdir()) / f"{name}-{os.getuid()}"]
    with contextlib.suppress(RuntimeError):  # a user without a home
        homes.insert(0, Path.home() / ".cache" / "gemuco" / name)
    folder = next((folder for folder in (*own, beside, *homes) if _is_own(folder)), None)
    if folder is not None and folder != beside and beside.is_dir() and not any(folder.iterdir()):
        with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=folder.parent) as staging:
            shutil.copytree(beside, Path(staging) / name)
            (Path(staging) / name).rename(folder)  # complete, or not at all if another process was faster
    return folder


FOLDER = find_folder()


def jit(function: F) -> F:
    """Compile a function at its first call with each kind of arguments."""
    before = CONFIG.CACHE_DIR
    CONFIG.CACHE_DIR = str(FOLDER or before)  # read when the function is decorated
    try:
        options: dict[str, Any] = {"nogil": True, "cache": FOLDER is not None, "fastmath": FREE, "error_model": "numpy"}
        return numba.njit(**options)(function)
    finally:
        CONFIG.CACHE_DIR = before


def let_compiler_go() -> None:
    """Release the memory of the compiler's code, about 50 MB, after everything is compiled.

    It is the read-only text of a library; the kernel reads it from the file again if something is compiled later.
    """
    libc = ctypes.CDLL(None)
    with contextlib.suppress(OSError):  # a system without /proc
        for line in Path("/proc/self/maps").read_text().splitlines():
            place, rights, *_, name = line.split()
            if rights == "r-xp" and name.endswith("/libllvmlite.so"):
                begin, end = (int(edge, 16) for edge in place.split("-"))
                libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), MADV_DONTNEED)
